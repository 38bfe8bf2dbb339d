"""Roles of the two threads from target and machine, refusals that are only told, and reasoning that gives way."""

from __future__ import annotations

import errno
import os
import resource
import threading
from collections.abc import Collection

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.artifacts.manifest import Artifacts
from edge.inference import scheduling
from edge.inference.scheduling import (
    GAP_NS,
    GiveWay,
    Role,
    Schedule,
    ThreadCalls,
    TickActivity,
    enter,
    lock_memory,
    make_schedule,
    prepare_process,
    run_as,
    schedule_for,
)

MS = 1_000_000
PERIOD_NS = 100 * MS


def schedule(
    allowed: Collection[int],
    *,
    control: tuple[int, ...] = (),
    reasoning: tuple[int, ...] = (),
    threads: tuple[int, int] = (1, 1),
    one_device: bool = False,
    priority: int | None = 50,
) -> Schedule:
    return make_schedule(
        control_cores=control,
        reasoning_cores=reasoning,
        control_priority=priority,
        allowed=allowed,
        control_threads=threads[0],
        reasoning_threads=threads[1],
        one_device=one_device,
    )


# Which cores


def test_the_targets_cores_are_used_where_they_exist() -> None:
    made = schedule(range(8), control=(7,), reasoning=(4, 5, 6))
    assert (made.control.cores, made.reasoning.cores, made.shared, made.notes) == ((7,), (4, 5, 6), False, ())


def test_cores_that_this_process_may_not_use_are_reported_and_not_required() -> None:
    made = schedule({0, 1}, control=(7,))
    assert made.control.cores == ()
    assert made.notes == ("the target gives control cores 7, this process may use 0, 1: it runs on any of them",)


def test_reasoning_leaves_the_control_cores_alone() -> None:
    assert schedule(range(4), control=(0, 3)).reasoning.cores == (1, 2)


def test_without_cores_in_the_target_reasoning_leaves_control_its_own_if_there_are_some_to_spare() -> None:
    made = schedule({2, 3, 5, 9}, threads=(1, 2))
    assert (made.control.cores, made.reasoning.cores, made.shared) == ((), (2, 3, 5), False)


def test_with_no_core_to_spare_both_may_run_anywhere_and_reasoning_gives_way() -> None:
    made = schedule({0, 1})
    assert (made.control.cores, made.reasoning.cores, made.shared) == ((), (), True)


def test_on_one_accelerator_reasoning_gives_way_for_any_cores() -> None:
    assert schedule(range(8), control=(7,), reasoning=(4, 5, 6), one_device=True).shared


@given(
    st.sets(st.integers(0, 15), min_size=1),
    st.sets(st.integers(0, 15), max_size=4),
    st.sets(st.integers(0, 15), max_size=4),
    st.integers(1, 4),
    st.integers(1, 4),
)
def test_every_role_gets_only_cores_that_are_allowed(
    allowed: set[int], control: set[int], reasoning: set[int], a: int, b: int
) -> None:
    reasoning -= control
    made = schedule(allowed, control=tuple(sorted(control)), reasoning=tuple(sorted(reasoning)), threads=(a, b))
    assert allowed.issuperset(made.control.cores) and allowed.issuperset(made.reasoning.cores)
    free = set(made.control.cores or allowed) - set(made.reasoning.cores or allowed)
    assert made.shared == (len(free) < a)


# How urgently


class Calls(ThreadCalls):
    """Records what is asked for; refuses some of it."""

    def __init__(self, *refused: str) -> None:
        self.refused = refused
        self.done: list[tuple[str, object]] = []

    def _do(self, name: str, value: object) -> None:
        if name in self.refused:
            raise PermissionError(errno.EPERM, "Operation not permitted")
        self.done.append((name, value))

    def set_cores(self, cores: Collection[int]) -> None:
        self._do("cores", tuple(cores))

    def set_fifo(self, priority: int) -> None:
        self._do("fifo", priority)

    def set_niceness(self, niceness: int) -> None:
        self._do("niceness", niceness)


CONTROL = Role("control", (3,), 50, -10)


def test_where_real_time_priority_is_refused_niceness_is_tried_and_reported_once() -> None:
    machine = Calls("fifo")
    [line] = enter(CONTROL, machine)
    assert "LimitRTPRIO=50" in line
    assert machine.done == [("cores", (3,)), ("niceness", -10)]


def test_threads_started_in_a_role_inherit_its_urgency() -> None:
    """As ONNX Runtime's workers do."""

    def body() -> int:
        found: list[int] = []
        worker = threading.Thread(
            target=lambda: found.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))
        )
        worker.start()
        worker.join()
        return found[0]

    before = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    assert run_as(Role("reasoning", niceness=19), body) == 19
    assert os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) == before


@pytest.mark.parametrize("wrong", [{"priority": 0}, {"priority": 100}, {"niceness": 20}])
def test_a_role_that_cannot_be_is_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="must be"):
        Role("control", **wrong)  # type: ignore[arg-type]


# Memory


class Policies:
    """Records the calling of `os.sched_setscheduler`: (thread, policy, priority)."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, refused: bool = False) -> None:
        self.set: list[tuple[int, int, int]] = []
        self.refused = refused
        monkeypatch.setattr(os, "sched_setscheduler", self)

    def __call__(self, thread: int, policy: int, param: os.sched_param) -> None:
        self.set.append((thread, policy, param.sched_priority))
        if self.refused:
            raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))


FIFO = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK


class TestInterpreter:
    """Who takes the interpreter's lock must not wait for other programs: the control thread would wait with it."""

    @pytest.mark.parametrize(
        ("priority", "others"),
        [
            (None, [None, None, None]),
            (50, [40, 31, 30]),
            (21, [11, 2, 1]),
            (20, [10, None, None]),
            (11, [1, None, None]),
            (10, [None, None, None]),
        ],
    )
    def test_reasoning_is_below_all_and_its_graphs_threads_above_it(
        self, priority: int | None, others: list[int | None]
    ) -> None:
        made = schedule(range(4), priority=priority)
        assert made.late_command.priority == priority
        assert [role.priority for role in (made.inputs, made.workers, made.reasoning)] == others

    @pytest.mark.parametrize(("priority", "control"), [(None, None), (59, 58), (50, 49), (2, 1), (1, 1)])
    def test_the_late_command_thread_is_above_control_and_has_the_services_highest_priority(
        self, priority: int | None, control: int | None
    ) -> None:
        """The unit's LimitRTPRIO is the target's control_priority, and the bridge's is above it."""
        made = schedule(range(4), control=(3,), priority=priority)
        assert (made.control.priority, made.late_command.priority) == (control, priority)

    def test_the_late_command_thread_is_not_bound_to_the_core_of_the_tick_that_it_covers(self) -> None:
        made = schedule(range(4), control=(3,))
        assert (made.control.cores, made.late_command.cores) == ((3,), ())

    def test_without_cores_of_its_own_reasoning_fills_one_core_at_most(self) -> None:
        made = schedule(range(2))
        assert (made.reasoning.cores, made.reasoning.priority, made.workers.priority) == ((), 30, None)

    def test_where_controls_priority_is_refused_no_thread_has_one_and_a_line_says_so(
        self, artifacts: Artifacts, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        Policies(monkeypatch, refused=True)
        made = schedule_for(artifacts)
        roles = (made.control, made.late_command, made.inputs, made.workers, made.reasoning)
        assert [role.priority for role in roles] == [None] * 5
        assert "LimitRTPRIO=50" in made.notes[-1]

    def test_where_it_is_permitted_nothing_is_said(self, artifacts: Artifacts, monkeypatch: pytest.MonkeyPatch) -> None:
        policies = Policies(monkeypatch)
        assert schedule_for(artifacts).late_command.priority == 50 and not schedule_for(artifacts).notes
        assert {(policy, priority) for _, policy, priority in policies.set} == {(os.SCHED_FIFO, 50)}

    def test_preparing_gives_all_python_threads_a_priority_that_their_processes_do_not_inherit(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        policies, ended = prepared(monkeypatch), threading.Event()
        thread = threading.Thread(target=ended.wait)
        thread.start()
        try:
            assert prepare_process(Role("inputs", priority=40)) == []
            alive = {one.native_id for one in threading.enumerate()}
        finally:
            ended.set()
            thread.join()
        assert {native_id for native_id, _, _ in policies.set} == alive and thread.native_id in alive
        assert {(policy, priority) for _, policy, priority in policies.set} == {(FIFO, 40)}

    def test_preparing_without_a_priority_changes_none(self, monkeypatch: pytest.MonkeyPatch) -> None:
        policies = prepared(monkeypatch)
        assert prepare_process(Role("inputs")) == [] and policies.set == []

    def test_a_refusal_while_preparing_is_no_error(self, monkeypatch: pytest.MonkeyPatch) -> None:
        policies = prepared(monkeypatch, refused=True)
        assert prepare_process(Role("inputs", priority=40)) == [] and policies.set


def prepared(monkeypatch: pytest.MonkeyPatch, *, refused: bool = False) -> Policies:
    """Leave out what preparing does beside priorities, and record those."""
    monkeypatch.setattr(scheduling, "lock_memory", lambda: None)
    monkeypatch.setattr(scheduling, "freeze_garbage", lambda: None)
    return Policies(monkeypatch, refused=refused)


def test_memory_is_not_locked_under_a_limit_that_later_allocations_would_break() -> None:
    def never(_flags: int) -> int:
        raise AssertionError("locked")

    line = lock_memory(limit_bytes=8 << 20, mlockall=never, euid=1000)
    assert line is not None and "LimitMEMLOCK=infinity" in line


@pytest.mark.parametrize(("limit", "euid"), [(resource.RLIM_INFINITY, 1000), (8 << 20, 0)])
def test_memory_is_locked_where_that_is_permitted(limit: int, euid: int) -> None:
    asked: list[int] = []
    assert lock_memory(limit_bytes=limit, mlockall=lambda flags: asked.append(flags) or 0, euid=euid) is None
    assert len(asked) == 1


def test_a_refused_lock_is_a_line_and_no_error() -> None:
    line = lock_memory(limit_bytes=8 << 20, mlockall=lambda _flags: errno.ENOMEM, euid=0)
    assert line is not None and os.strerror(errno.ENOMEM) in line


# Giving way


def ticked(started_ns: int = 0, encoded_ms: int = 10, acted_ms: int = 20) -> TickActivity:
    """A tick of 20 ms whose two calls have run."""
    activity = TickActivity(PERIOD_NS)
    activity.begin(started_ns)
    activity.end(started_ns + encoded_ms * MS)
    activity.begin(started_ns + encoded_ms * MS)
    activity.end(started_ns + acted_ms * MS)
    return activity


def test_no_call_starts_while_a_tick_is_under_way() -> None:
    activity = TickActivity(PERIOD_NS)
    activity.begin(0)
    assert activity.hold_ns(5 * MS, MS) > 0


def test_between_the_two_calls_of_a_tick_no_call_starts_either() -> None:
    activity = TickActivity(PERIOD_NS)
    activity.begin(0)
    activity.end(10 * MS)
    assert activity.hold_ns(10 * MS + GAP_NS - 1, MS) > 0


def test_after_a_tick_a_call_that_fits_before_the_next_starts_at_once() -> None:
    assert ticked().hold_ns(30 * MS, 69 * MS) == 0


def test_a_call_that_would_run_into_the_next_tick_waits_until_that_is_over() -> None:
    activity = ticked()
    assert activity.hold_ns(80 * MS, 30 * MS) == 20 * MS
    assert activity.hold_ns(101 * MS, 30 * MS) > 0
    activity.begin(101 * MS)
    activity.end(121 * MS)
    assert activity.hold_ns(121 * MS + GAP_NS, 30 * MS) == 0


def test_a_call_longer_than_any_gap_starts_early_in_one() -> None:
    activity = ticked()
    assert activity.hold_ns(23 * MS, 500 * MS) == 0
    assert activity.hold_ns(90 * MS, 500 * MS) > 0


@pytest.mark.parametrize("now_ms", [201, 10_000])
def test_ticks_that_have_stopped_are_not_waited_for(now_ms: int) -> None:
    hung = TickActivity(PERIOD_NS)
    hung.begin(0)
    assert hung.hold_ns(now_ms * MS, MS) == 0
    assert ticked().hold_ns(now_ms * MS, MS) == 0
    assert TickActivity(PERIOD_NS).hold_ns(now_ms * MS, MS) == 0


@given(st.integers(0, 1000), st.integers(0, 300), st.integers(1, 95))
def test_a_call_of_any_length_starts_within_two_periods(at_ms: int, needs_ms: int, tick_ms: int) -> None:
    """Ticks go on for ever; nobody starves."""
    now, activity, next_tick, tick_end = at_ms * MS, TickActivity(PERIOD_NS), 0, None
    time_ns = 0
    while time_ns <= now + 2 * PERIOD_NS + 5 * MS:
        if tick_end is not None and time_ns >= tick_end:
            activity.end(tick_end)
            tick_end = None
        if time_ns >= next_tick:
            activity.begin(next_tick)
            tick_end, next_tick = next_tick + tick_ms * MS, next_tick + PERIOD_NS
        if time_ns >= now and activity.hold_ns(time_ns, needs_ms * MS) == 0:
            return
        time_ns += MS
    raise AssertionError(f"held back from {at_ms} ms for more than two periods")


class FakeTime:
    def __init__(self) -> None:
        self.now_ns = 30 * MS
        self.slept: list[float] = []

    def clock(self) -> int:
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now_ns += round(seconds * 1e9)


def test_giving_way_waits_the_requested_time_and_counts_it() -> None:
    time, activity = FakeTime(), TickActivity(PERIOD_NS)
    activity.begin(0)
    way = GiveWay(activity, clock=time.clock, sleep=time.sleep)
    way.wait(MS, lambda: time.now_ns >= 50 * MS)
    assert way.waited_ns == 20 * MS
    way.wait(MS, lambda: True)
    assert way.waited_ns == 20 * MS
