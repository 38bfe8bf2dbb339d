"""Rules of one run that need neither graphs nor a robot: when it began, what it waits for, in which order it ends."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from edge.core.deadline import Deadline
from edge.inference.release import ReleaseDelay
from edge.inference.scheduling import Role
from edge.inference.warm_up import WarmUp
from edge.reasoning.generation_cycle import Mode
from edge.robot.arming import RefusedError, StoppedEarlyError
from edge.run import assembly
from edge.run import session as module
from edge.run.assembly import Loops, RunOptions, StopEvents
from edge.run.session import RunSession
from edge.safety.watchdog import Hang
from edge.state.switches import Switches
from firmware_bridge.client import BridgeUnavailable
from firmware_bridge.core.config import load_robot_config
from tests.support.processes import GO2_SIM

ROBOT = load_robot_config(GO2_SIM)
OPERATOR_ROBOT = replace(ROBOT, safety=replace(ROBOT.safety, operator_arm=True))
STOPPED: Any = SimpleNamespace(state="stopped", zero_after_stop=True)


class ArmedError(Exception):
    """The session has begun to arm: the test is over."""


class Rig:
    """A session around fakes: its graphs, its robot, its bridge and its loops.

    The robot is ready after `ready_s` on a clock that every sleep advances; `at_5_s` is called from then on.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, ready_s: float = 0.0, priority: int | None = None) -> None:
        self.now_ns, self.ready_s, self.priority = 0, ready_s, priority
        self.at_5_s: Callable[[], None] = lambda: None
        self.on_arm: Callable[[], int] = self._arm
        self.control: Callable[[], None] = lambda: None
        self.events: list[str] = []
        self.waited: set[str] = set()
        self.on_death: Callable[[str], None] = lambda _why: None
        self.session: RunSession
        self.stop_flag: StopEvents
        fakes: dict[str, Any] = {
            "open_proven": lambda *_args, **_named: SimpleNamespace(
                policy=None,
                language=SimpleNamespace(check_instruction=lambda *_: None),
                tested="",
                guard=SimpleNamespace(stage=lambda *_: nullcontext()),
            ),
            "schedule_for": lambda _artifacts: SimpleNamespace(
                notes=(),
                inputs=Role("inputs", priority=self.priority),
                control=Role("control"),
                late_command=Role("late-command"),
            ),
            "warm_up": lambda *_: WarmUp(1.0, ()),
            "check_tick": lambda *_: None,
            "ServiceReporter": lambda *_args, **_named: self,
            "BridgeClient": lambda _path: self,
            "check_bridge": lambda *_: None,
            "RobotInputs": self._inputs,
            "assemble": self._assemble,
            "arm": lambda *_args, **_named: self.on_arm(),
            "enter": lambda _schedule: (),
            "prepare_process": lambda _control: (),
            "run_record": lambda *_: {"instruction": "go"},
            "run_result": lambda *_args, faults, **_named: {"faults": faults},
            "Deadline": lambda seconds: Deadline(seconds, clock=lambda: self.now_ns),
            "time": SimpleNamespace(sleep=self._sleep, monotonic_ns=time.monotonic_ns),
        }
        for name, fake in fakes.items():
            monkeypatch.setattr(module, name, fake)

    def run(
        self, robot: Any = ROBOT, record: Path | None = None, say: Callable[[str], None] = lambda _line: None
    ) -> dict[str, Any]:
        runtime = SimpleNamespace(tick_period_ms=100, image_px=32, frame_offsets_s=(1.0, 0.0), switches=Switches())
        artifacts: Any = SimpleNamespace(runtime=runtime, guided_by_waypoints=False, directory=Path("a"))
        options = RunOptions("go", Mode.ASYNC, None, ReleaseDelay(0.0, 0.0, 0), record)
        self.session = RunSession(artifacts, robot, options, say)
        return self.session.run()

    # The bridge

    def poll(self) -> Any:
        return STOPPED

    def stop(self) -> None:
        self.events.append("robot stopped")

    def close(self) -> None:
        self.events.append("bridge closed")

    # The service manager

    def starting(self, _text: str, _limit_s: float) -> None:
        pass

    def on_wait(self, text: str) -> None:
        self.waited.add(text)

    def on_tick(self, *_: object) -> None:
        pass

    def stopping(self, text: str) -> None:
        self.events.append(f"stopping: {text}")

    # The session's parts

    def _sleep(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)
        if self.now_ns >= 5e9:
            self.at_5_s()

    def _arm(self) -> int:
        raise ArmedError

    def _inputs(self, *_args: object, on_death: Callable[[str], None], **_named: object) -> Any:
        rig, self.on_death = self, on_death

        class Inputs:
            camera = SimpleNamespace(last_error="", start=lambda: None, align=lambda _ns: None)
            history = SimpleNamespace(newest=lambda: None)
            findings = SimpleNamespace(put=lambda _found: None)
            recorder: object = None

            @property
            def ready(self) -> bool:
                return rig.now_ns >= rig.ready_s * 1e9

            def why_missing(self, _status: object) -> str:
                return " (CAN interface can0 is down)"

            def close(self) -> None:
                pass

        return Inputs()

    def _assemble(self, *_args: object, stop: StopEvents, **_named: object) -> Any:
        self.stop_flag = stop
        power = SimpleNamespace(start=lambda: None, close=lambda: None, statistics=dict)
        supervision = SimpleNamespace(message="", active=(), state=SimpleNamespace(value="ok"))
        control = SimpleNamespace(run=lambda *_: self.control(), supervision=supervision, ended_by="test")
        reasoning = SimpleNamespace(
            run=lambda: stop.reasoning.wait(20),
            cancel=lambda: None,
            last_progress_ns=time.monotonic_ns(),
            times=SimpleNamespace(generation_ms=SimpleNamespace(quantile=lambda _share: 0.0)),
            generations=0,
        )
        return Loops(power, control, reasoning, SimpleNamespace(blocking_fault=lambda: ""))  # type: ignore[arg-type]


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Rig:
    return Rig(monkeypatch)


# The flight log


def test_the_log_of_a_run_that_broke_off_after_it_began_is_kept(rig: Rig, tmp_path: Path) -> None:
    def fail() -> None:
        raise OSError("no")

    rig.on_arm, rig.control = lambda: 7, fail
    assert rig.run(record=tmp_path / "flight.mcap")["faults"] == ["control thread died: OSError: no"]
    assert (tmp_path / "flight.mcap").stat().st_size > 0


def test_a_run_that_never_began_leaves_no_log(rig: Rig, tmp_path: Path) -> None:
    with pytest.raises(ArmedError):
        rig.run(record=tmp_path / "flight.mcap")
    assert list(tmp_path.iterdir()) == []


def test_a_runner_that_waited_spares_a_log_that_another_began_under_its_name(rig: Rig, tmp_path: Path) -> None:
    (tmp_path / "flight.mcap").write_bytes(b"another's")
    with pytest.raises(RefusedError, match="File exists"):
        rig.run(record=tmp_path / "flight.mcap")
    assert (tmp_path / "flight.mcap").read_bytes() == b"another's"


# The threads


def test_what_reads_the_robot_has_a_priority_that_its_librarys_threads_inherit(monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[tuple[int, int, int]] = []
    rig = Rig(monkeypatch, priority=40)
    monkeypatch.setattr(
        os,
        "sched_setscheduler",
        lambda thread, policy, param: taken.append((threading.get_native_id(), policy, param.sched_priority)),
    )
    opened_in: list[int] = []
    build = module.RobotInputs
    monkeypatch.setattr(
        module, "RobotInputs", lambda *a, **named: (opened_in.append(threading.get_native_id()), build(*a, **named))[1]
    )
    with pytest.raises(ArmedError):
        rig.run()
    assert taken == [(opened_in[0], os.SCHED_FIFO, 40)]


def test_a_late_command_is_covered_by_a_thread_above_the_control_thread(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    roles: dict[str, Role] = {}
    entered = threading.Event()

    def enter(role: Role) -> list[str]:
        roles[threading.current_thread().name] = role
        if "late-command" in roles:
            entered.set()
        return []

    monkeypatch.setattr(module, "enter", enter)
    rig.on_arm, rig.control = lambda: 7, lambda: assert_set(entered)
    assert rig.run()["faults"] == []
    assert {thread: role.name for thread, role in roles.items()} == {
        "control": "control",
        "late-command": "late-command",
    }


def assert_set(event: threading.Event) -> None:
    assert event.wait(20)


# Waiting for the robot


class FakeViews:
    """Views of a run that note when they open; a poll of the live one calls `on_poll`."""

    ros2 = None

    def __init__(self, order: list[str], on_poll: Callable[[], None] = lambda: None) -> None:
        self._order = order
        self.live = SimpleNamespace(poll=on_poll, put=lambda *_: None)

    def open(self, *_: object) -> None:
        self._order.append("views")

    def watch(self, *_: object) -> None:
        pass

    def close(self) -> None:
        pass


def test_views_open_before_the_wait_from_which_on_the_watchdog_counts(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []
    monkeypatch.setattr(module, "Views", lambda: FakeViews(order))
    monkeypatch.setattr(module, "open_channels", lambda *_: None)
    monkeypatch.setattr(rig, "on_wait", order.append)
    rig.ready_s = 300.0
    with pytest.raises(ArmedError):
        rig.run(OPERATOR_ROBOT)
    assert order[0] == "views" and len(order) > 1 and "views" not in order[1:]


def test_the_live_views_stop_ends_the_waiting_for_the_robot(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "Views", lambda: FakeViews([], lambda: rig.session.request_stop()))
    rig.ready_s = 300.0
    with pytest.raises(StoppedEarlyError):
        rig.run(OPERATOR_ROBOT)


def test_a_robot_that_boots_in_five_minutes_is_waited_for_where_an_operator_arms_it(rig: Rig) -> None:
    rig.ready_s = 300.0
    with pytest.raises(ArmedError):
        rig.run(OPERATOR_ROBOT)
    assert rig.waited == {"waiting for the robot: no state yet"}


def test_without_an_operator_it_is_a_refusal_after_ten_seconds(rig: Rig) -> None:
    rig.ready_s = 300.0
    with pytest.raises(
        RefusedError, match=r"no state from the robot in 10 s on .* \(CAN interface can0 is down\): is it on"
    ):
        rig.run()


def test_the_bridge_of_another_robot_is_left_before_anything_is_opened(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise RefusedError("the bridge serves another robot")

    monkeypatch.setattr(module, "check_bridge", refuse)
    monkeypatch.setattr(module, "RobotInputs", None)
    with pytest.raises(RefusedError, match="another robot"):
        rig.run()
    assert rig.events == ["bridge closed"]


def test_while_it_waits_to_be_armed_it_takes_the_newest_instruction(rig: Rig) -> None:
    said: list[str] = []

    def arm_later() -> int:
        channel: Any = SimpleNamespace(poll=lambda: "go to the lift", stopped=False)
        loops: Any = SimpleNamespace(reasoning=SimpleNamespace(submit=said.append))
        rig.session._take_instructions(channel, loops)
        return 1

    rig.on_arm = arm_later
    rig.run(say=said.append)
    assert said[0] == "go to the lift" and "armed and driving go2: go to the lift" in said


def test_a_stop_ends_the_waiting_for_the_robot(rig: Rig) -> None:
    rig.ready_s, rig.at_5_s = 300.0, lambda: rig.session.request_stop()
    with pytest.raises(StoppedEarlyError):
        rig.run(OPERATOR_ROBOT)


def test_a_thread_that_dies_while_the_robot_is_waited_for_is_a_refusal(rig: Rig) -> None:
    rig.ready_s, rig.at_5_s = 300.0, lambda: rig.on_death("camera thread died: OSError: gone")
    with pytest.raises(RefusedError, match="camera thread died"):
        rig.run(OPERATOR_ROBOT)


# The end


@pytest.mark.parametrize(
    ("error", "fault"),
    [(BridgeUnavailable("gone"), "bridge lost: gone"), (OSError("no"), "control thread died: OSError: no")],
)
def test_when_a_thread_dies_the_robot_is_stopped_with_the_fault_before_the_end(
    rig: Rig, error: Exception, fault: str
) -> None:
    def fail() -> None:
        raise error

    rig.on_arm, rig.control = lambda: 7, fail
    assert rig.run()["faults"] == [fault]
    assert rig.events == ["robot stopped", f"stopping: {fault}", "bridge closed"]


def test_an_input_thread_that_dies_ends_the_run(rig: Rig) -> None:
    stopped: list[bool] = []

    def die() -> None:
        rig.on_death("camera thread died: OSError: gone")
        stopped.append(rig.stop_flag.control.wait(20))

    rig.on_arm, rig.control = lambda: 7, die
    assert rig.run()["faults"] == ["camera thread died: OSError: gone"]
    assert stopped == [True]


@pytest.fixture
def released() -> Iterator[threading.Event]:
    """What a thread that hangs waits for."""
    event = threading.Event()
    yield event
    event.set()


def test_a_requested_stop_ends_the_run_although_the_control_thread_hangs(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, released: threading.Event
) -> None:
    def hang() -> None:
        rig.session.request_stop()
        released.wait(20)

    monkeypatch.setattr(module, "JOIN_S", 0.1)
    rig.on_arm, rig.control = lambda: 7, hang
    assert rig.run()["faults"] == ["the control thread did not end within 0.1 s"]
    assert rig.session.hung, "only SIGKILL ends the process"


def test_a_run_whose_two_threads_hang_ends(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, released: threading.Event
) -> None:
    """Nobody requests a stop: the reasoning thread was given up, and the control thread does not answer to that."""
    watch = SimpleNamespace(step=lambda *_: Hang.GIVE_UP, hung_s=30.0)
    monkeypatch.setattr(module, "ReasoningWatch", lambda: watch)
    monkeypatch.setattr(module, "JOIN_S", 0.0)
    rig.on_arm, rig.control = lambda: 7, lambda: assert_set(released)
    assert "the control thread did not end within 0 s" in rig.run()["faults"]
    assert rig.session.hung


# What the monitors are told


@pytest.mark.parametrize(("planned_s", "trained_s"), [(4.0, 4.0), (float("inf"), 10.0)])
def test_the_age_limit_of_an_answer_follows_the_plan(
    monkeypatch: pytest.MonkeyPatch, planned_s: float, trained_s: float
) -> None:
    monkeypatch.setattr(assembly, "read_power_plan", lambda artifacts: SimpleNamespace(max_delay_s=planned_s))
    artifacts: Any = SimpleNamespace(trained=True)
    assert assembly.semantic_config(artifacts, Mode.ASYNC).trained_delay_s == trained_s
