"""The reasoning loop: one generation at a time, from the newest frames, published whole with its own anchor."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

from edge.inference.generation_task import GenerationTask
from edge.reasoning.decoding_rules import DecodingContext
from edge.reasoning.generation_cycle import ReasoningBudget
from edge.run.reasoning_loop import ReasoningLoop
from edge.state.semantic import SemanticState
from edge.state.switches import Decoding
from tests.support.runner.reasoning_bench import TEXT, Bench, Clock, FakeRun


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def bench(clock: Clock) -> Bench:
    return Bench(clock=clock)


# A semantic state


def test_delay_at_release_counts_from_the_capture_of_the_newest_frame(bench: Bench, clock: Clock) -> None:
    def think(_run: FakeRun) -> None:
        clock.s += 1.5

    bench.language.during_finish = think
    bench.frame(99.8)
    bench.loop.step()
    assert bench.loop.times.anchor_to_ready_ms.newest == pytest.approx(1700.0)
    assert bench.slot.state is not None and bench.slot.state.ready_ns == clock()


def test_the_recorded_state_is_the_published_one(bench: Bench) -> None:
    bench.frame(2.0)
    bench.loop.step()
    [record] = bench.records
    assert (record["anchor_ns"], record["frames_ns"], record["new_tokens"]) == (2_000_000_000, [2_000_000_000], 3)
    times = bench.loop.times
    assert {len(each) for each in (times.generation_ms, times.anchor_to_ready_ms, times.late_anchor_ms)} == {1}


def test_the_record_says_when_the_control_thread_could_read_it(
    bench: Bench, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish = GenerationTask.publish

    def wait_for_a_core(*args: Any, **kwargs: Any) -> SemanticState:
        clock.s += 0.03
        return publish(*args, **kwargs)

    monkeypatch.setattr(GenerationTask, "publish", wait_for_a_core)
    bench.frame(2.0)
    bench.loop.step()
    [record] = bench.records
    assert record["published_ns"] - record["ready_ns"] == pytest.approx(30e6, abs=1e3)


# The thread


def test_the_thread_takes_its_real_time_priority_before_its_first_generation(monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[tuple[int, int]] = []
    monkeypatch.setattr(os, "sched_setscheduler", lambda thread, _, param: taken.append((thread, param.sched_priority)))
    with Bench(priority=30) as bench:
        bench.language.during_finish = lambda _run: taken.append((0, 0))
        bench.frame(2.0)
        bench.wait_for(lambda: bench.slot.state is not None)
    assert taken[:2] == [(0, 30), (0, 0)]


# Release delay


def test_a_stop_ends_a_generation_that_is_held_back() -> None:
    with Bench(delay_s=30.0) as bench:
        bench.frame(2.0)
        bench.wait_for(lambda: len(bench.language.prompts) == 1)
    assert bench.slot.state is None
    assert bench.cycle.cancelled == 0


# The queue of one


def test_a_new_instruction_ends_the_generation_under_way_and_is_followed_next(bench: Bench) -> None:
    def change(run: FakeRun) -> None:
        bench.language.during_finish = lambda _run: None
        bench.loop.submit("left")
        bench.loop.submit("right")
        assert run.interrupt.is_set

    bench.language.during_finish = change
    bench.frame(2.0)
    assert not bench.loop.step()
    bench.frame(2.1)
    assert bench.loop.step()
    assert (bench.cycle.cancelled, bench.language.instructions) == (1, ["right"])


def test_a_cancelled_generation_begins_again_with_the_newest_frames(bench: Bench) -> None:
    def cancel(_run: FakeRun) -> None:
        bench.language.during_finish = lambda _run: None
        bench.frame(9.0)
        bench.loop.cancel()

    bench.language.during_finish = cancel
    bench.frame(2.0)
    assert not bench.loop.step()
    assert bench.loop.step()
    assert (bench.language.prompts, bench.language.instructions) == ([[9.0]], ["go"])


def test_a_new_instruction_is_decoded_as_freely_as_the_first(clock: Clock) -> None:
    bench = Bench(clock=clock, decoding=Decoding.FREE)
    bench.loop.submit("left")
    bench.language.text = "Progress: turn 2 of 3, passed 0.\n" + TEXT
    for second in (2.0, 3.0):
        bench.frame(second)
        assert bench.loop.step()
    context = bench.language.contexts[-1]
    assert context.before is not None and context == DecodingContext(context.before)


# Budget and failures


@pytest.mark.parametrize(("cap", "tokens"), [(None, 4), (9, 4), (2, 2), (0, 0)])
def test_the_budget_permits_a_generation_and_caps_its_tokens(bench: Bench, cap: int | None, tokens: int) -> None:
    bench.frame(2.0)
    bench.budget = ReasoningBudget(allowed=False)
    assert not bench.loop.step()
    bench.budget = ReasoningBudget(max_new_tokens=cap)
    assert bench.loop.step()
    assert bench.language.caps == [tokens]


# Late anchor


def test_older_frames_are_prefilled_before_the_newest_is_captured(bench: Bench, clock: Clock) -> None:
    """The second generation knows from the first how long that takes, and plans the spacing of 3 s for it."""

    def prefill() -> None:
        clock.s += 0.4
        bench.frame(clock.s)

    bench.language.during_feed = prefill
    for tenth in range(960, 1001):
        bench.frame(tenth / 10)
    bench.loop.step()
    for tenth in range(1005, 1010):
        bench.frame(tenth / 10)
    clock.s = 100.9
    bench.loop.step()
    assert bench.language.prompts[1] == pytest.approx([98.3, 101.3])
    assert bench.loop.times.late_anchor_ms.newest == pytest.approx(400.0)


def test_frames_from_before_the_instruction_are_no_part_of_its_prompt(bench: Bench, clock: Clock) -> None:
    for tenth in range(900, 1001):
        bench.frame(tenth / 10)
    bench.loop.submit("go to the bench")
    for tenth in range(1001, 1041):
        bench.frame(tenth / 10)
    clock.s = 104.0
    bench.loop.step()
    assert bench.language.prompts[0] == pytest.approx([101.0, 104.0])


def test_the_newest_frame_is_waited_for_until_its_planned_instant() -> None:
    with Bench() as bench:
        for tenth in range(70, 101):
            bench.frame(tenth / 10)
        bench.language.during_feed = lambda: time.sleep(0.3)
        bench.wait_for(lambda: bench.cycle.published == 1)
        bench.language.during_feed = lambda: None
        bench.frame(10.1)
        time.sleep(0.1)
        assert bench.cycle.published == 1
        bench.frame(10.4)
        bench.wait_for(lambda: bench.cycle.published == 2)
        assert bench.language.prompts[1][-1] == pytest.approx(10.4)


def test_one_slow_prefill_does_not_make_the_next_generation_wait(bench: Bench, clock: Clock) -> None:
    for tenth in range(960, 1001):
        bench.frame(tenth / 10)
    for took_s in (0.2, 0.2, 0.2, 1.5, 0.2):

        def prefill(took_s: float = took_s) -> None:
            for _ in range(round(took_s * 10)):
                clock.s += 0.1
                bench.frame(clock.s)

        clock.s += 0.1
        bench.frame(clock.s)
        bench.language.during_feed = prefill
        assert bench.loop.step()
    assert bench.loop.times.late_anchor_ms.newest == pytest.approx(200.0)


def test_a_generation_is_given_up_when_no_frame_was_captured_around_the_planned_instant(
    bench: Bench, clock: Clock
) -> None:
    def prefill() -> None:
        clock.s += 2.0

    bench.language.during_feed = prefill
    for tenth in range(960, 1021):
        bench.frame(tenth / 10)
    bench.loop.step()
    bench.frame(102.1)
    bench.language.during_feed = lambda: bench.frame(120.0)
    assert not bench.loop.step()
    assert (len(bench.language.prompts), bench.cycle.missed_frames) == (1, 1)
    assert bench.cycle.failed == 0


# What a supervisor sees


def test_a_call_that_hangs_makes_no_progress(bench: Bench, clock: Clock) -> None:
    seen: list[int] = []

    def hang(_run: FakeRun) -> None:
        before = clock()
        clock.s += 60.0
        seen.append(bench.loop.last_progress_ns - before)

    bench.language.during_finish = hang
    bench.frame(2.0)
    bench.loop.step()
    assert seen == [0]


class Waiting:
    """Gives way for half a second before every call."""

    def __init__(self, clock: Clock) -> None:
        self.clock, self.waited_ns, self.busy_ns = clock, 0, -1
        self.loop: ReasoningLoop | None = None

    def gap_ns(self) -> float:
        return 0.0

    def wait(self, needs_ns: int, cancelled: Callable[[], bool]) -> None:
        assert self.loop is not None
        self.clock.s += 0.5
        self.waited_ns += 500_000_000
        self.busy_ns = self.loop.busy_ns
        assert self.loop.busy, "a generation is under way all the same"


def test_giving_way_to_ticks_is_not_computing(clock: Clock) -> None:
    way = Waiting(clock)
    bench = Bench(clock=clock, give_way=way)
    way.loop = bench.loop
    bench.language.during_finish = lambda _run: setattr(clock, "s", clock.s + 0.7)
    bench.frame(2.0)
    assert bench.loop.step()
    assert (way.busy_ns, bench.loop.busy_ns, bench.loop.busy) == (700_000_000, 700_000_000, False)
    assert bench.loop.gave_way_ns == 500_000_000


class Ticking(threading.Event):
    """A stop that is never asked for; waiting for it lets the time pass."""

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self.clock = clock

    def wait(self, timeout: float | None = None) -> bool:
        self.clock.s += timeout or 0.0
        return False


def camera_stops(clock: Clock) -> Bench:
    """The older frames of the second generation take 2 s, and no newer frame comes."""
    bench = Bench(clock=clock, stop=Ticking(clock))

    def prefill() -> None:
        clock.s += 2.0

    bench.language.during_feed = prefill
    bench.frame(97.0)
    bench.frame(100.0)
    assert bench.loop.step()
    bench.frame(102.0)
    bench.frame(103.0)
    return bench


def test_a_frame_that_never_comes_is_not_waited_for_for_ever(clock: Clock) -> None:
    bench = camera_stops(clock)
    started_s = clock.s
    assert not bench.loop.step()
    assert bench.cycle.missed_frames == 1
    assert clock.s - started_s == pytest.approx(2.0 + 2.0 + 0.5 + 1.0, abs=0.1)
    assert not bench.loop.step(), "nothing to do until there is another frame"
    assert bench.cycle.missed_frames == 1


def test_waiting_for_a_frame_is_not_computing(clock: Clock) -> None:
    bench = camera_stops(clock)
    before_ns = bench.loop.busy_ns
    bench.loop.step()
    assert bench.loop.busy_ns - before_ns == pytest.approx(2e9, abs=1e6)
