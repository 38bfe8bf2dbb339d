"""Rules of one run that need neither graphs nor a robot: when it began, what it waits for, in which order it ends."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from edge.core.deadline import Deadline
from edge.flightlog.recorder import Recorder
from edge.run import assembly
from edge.run import session as module
from edge.run.arming import RefusedError, StoppedEarlyError
from edge.run.reasoning_loop import Mode
from edge.run.session import RunSession
from firmware_bridge.client import BridgeUnavailable
from firmware_bridge.core.config import load_robot_config
from tests.support.processes import GO2_SIM

ROBOT = load_robot_config(GO2_SIM)


class Reporter:
    """What the service manager would be told."""

    def __init__(self) -> None:
        self.waited: list[str] = []
        self.said: list[str] = []

    def on_wait(self, text: str) -> None:
        self.waited.append(text)

    def stopping(self, text: str) -> None:
        self.said.append(text)


@pytest.fixture
def session() -> Any:
    """A session whose graphs were never opened."""
    bare: Any = RunSession.__new__(RunSession)
    bare._print = lambda line: None
    bare._lines = deque()
    bare._robot = ROBOT
    bare._reporter = Reporter()
    bare._stop, bare._finished = threading.Event(), threading.Event()
    bare._stop_requested = bare._began = False
    bare._faults = []
    return bare


# The flight log


def recorded(folder: Path) -> Recorder:
    return Recorder(folder / "flight.mcap")


def test_the_log_of_a_run_that_broke_off_after_it_began_is_kept(session: Any, tmp_path: Path) -> None:
    recorder = recorded(tmp_path)
    session._began = True
    recorder.put("/run", 1, {"instruction": "go"})
    session._close_recorder(recorder, None, Deadline(5.0))
    assert recorder.path.exists() and recorder.path.stat().st_size > 0


def test_a_run_that_never_began_leaves_no_log(session: Any, tmp_path: Path) -> None:
    recorder = recorded(tmp_path)
    session._close_recorder(recorder, None, Deadline(5.0))
    assert not recorder.path.exists()


# Waiting for the robot


class Boot:
    """A robot that is switched on after so many looks; every wait is over at once, on a clock that the test turns."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, after_s: float, then: Callable[[], None] | None = None) -> None:
        self.now_ns, self.after_s, self.then = 0, after_s, then
        self.camera = SimpleNamespace(last_error="")
        self.history = SimpleNamespace(newest=lambda: None)
        monkeypatch.setattr(module, "Deadline", lambda seconds: Deadline(seconds, clock=lambda: self.now_ns))
        monkeypatch.setattr(module.time, "sleep", self._sleep)

    def _sleep(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)
        if self.then is not None and self.now_ns >= 5e9:
            self.then()

    def poll(self) -> None:
        """As the bridge."""

    @property
    def ready(self) -> bool:
        return self.now_ns >= self.after_s * 1e9


def asks_operator(session: Any) -> Any:
    session._robot = replace(ROBOT, safety=replace(ROBOT.safety, operator_arm=True))
    return session


def test_a_robot_that_boots_in_five_minutes_is_waited_for_where_an_operator_arms_it(
    session: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    boot = Boot(monkeypatch, after_s=300.0)
    asks_operator(session)._await_inputs(boot, boot)
    assert set(session._reporter.waited) == {"waiting for the robot: no state yet"}


def test_without_an_operator_it_is_a_refusal_after_ten_seconds(session: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    boot = Boot(monkeypatch, after_s=300.0)
    with pytest.raises(RefusedError, match="no state from the robot in 10 s"):
        session._await_inputs(boot, boot)


def test_a_stop_ends_the_waiting_for_the_robot(session: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    boot = Boot(monkeypatch, after_s=300.0, then=session.request_stop)
    with pytest.raises(StoppedEarlyError):
        asks_operator(session)._await_inputs(boot, boot)


def test_a_thread_that_dies_while_the_robot_is_waited_for_is_a_refusal(
    session: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    boot = Boot(monkeypatch, after_s=300.0, then=lambda: session._end_by("camera thread died: OSError: gone"))
    with pytest.raises(RefusedError, match="camera thread died"):
        asks_operator(session)._await_inputs(boot, boot)


# The end


@pytest.mark.parametrize(
    ("error", "fault"),
    [(BridgeUnavailable("gone"), "bridge lost: gone"), (OSError("no"), "control thread died: OSError: no")],
)
def test_when_a_thread_dies_the_robot_is_stopped_with_the_fault_known_and_before_the_end(
    session: Any, error: Exception, fault: str
) -> None:
    seen: list[tuple[list[str], bool]] = []

    def body() -> None:
        raise error

    session._guard("control", body, lambda: seen.append((list(session._faults), session._finished.is_set())))()
    assert seen == [([fault], False)]
    assert session._finished.is_set()


def test_an_input_thread_that_dies_ends_the_run(session: Any) -> None:
    session._end_by("camera thread died: OSError: gone")
    assert session._finished.is_set() and session._faults == ["camera thread died: OSError: gone"]


# What the monitors are told


@pytest.mark.parametrize(("planned_s", "trained_s"), [(4.0, 4.0), (float("inf"), 10.0)])
def test_an_answer_may_be_as_old_as_the_plan_says(
    monkeypatch: pytest.MonkeyPatch, planned_s: float, trained_s: float
) -> None:
    monkeypatch.setattr(assembly, "read_power_plan", lambda artifacts: SimpleNamespace(max_delay_s=planned_s))
    artifacts: Any = SimpleNamespace(trained=True)
    assert assembly.semantic_config(artifacts, Mode.ASYNC).trained_delay_s == trained_s
