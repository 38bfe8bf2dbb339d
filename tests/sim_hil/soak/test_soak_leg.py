"""A leg while a runner drives: what becomes of a task that the runner does not take at once. On a clock of its own."""

from __future__ import annotations

import itertools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from edge.run.say import SayError
from sim_hil.realtime.stack import StackOptions
from sim_hil.realtime.truth import TruePose
from sim_hil.soak.drive import leg as soak_leg
from sim_hil.soak.drive.journey import SoakTask
from sim_hil.soak.drive.leg import Leg, LegOptions

S = 1_000_000_000
TASK = SoakTask(1, "go on", (0.0, 0.0, 0.0), (9.0, 9.0), "door 1", 12.7, 3.0)


class Clock:
    """Stands in for `time`: a sleep takes no time but this clock's."""

    now_ns = 0

    def monotonic_ns(self) -> int:
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        self.now_ns += round(seconds * S)


def test_a_runner_that_is_too_busy_to_answer_is_told_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock, tries, noted = Clock(), [], []

    def say(_path: Path, _instruction: str) -> str:
        tries.append(clock.now_ns)
        if len(tries) <= 3:
            raise SayError("no answer")
        return "accepted"

    stack: Any = SimpleNamespace(
        runner=SimpleNamespace(running=True), bridge=SimpleNamespace(running=True), robot=SimpleNamespace(running=True),
        trace=tmp_path / "t", instructions=tmp_path / "say", runs=1, processes=dict,
    )  # fmt: skip
    monkeypatch.setattr(soak_leg, "time", clock)
    monkeypatch.setattr(soak_leg, "say", say)
    monkeypatch.setattr(soak_leg, "Stack", lambda *_: stack)
    options = StackOptions(tmp_path, tmp_path, "office", (0.0, 0.0, 0.0), 0, 0, 1)
    journey: Any = SimpleNamespace(next=lambda _at: TASK)
    leg = Leg(LegOptions(1, 0, 15.0, 0.8, options), journey, None, stopped=lambda: False, show_status=lambda _: None)
    leg._truth = SimpleNamespace(  # type: ignore[assignment]
        newest=TruePose(0, 0, 0, 0, ()), update=lambda: [TruePose(clock.now_ns, 0, 0, 0, ())]
    )
    leg._events, leg._samples = SimpleNamespace(add=noted.append), SimpleNamespace(add=lambda _: None)  # type: ignore[assignment]
    leg._driven_ns = 0
    leg._begin_task(TASK)
    assert leg._drive() == "duration"
    kinds = [event["kind"] for event in noted]
    assert kinds[:6] == ["task_begin", "task_end", "not_told", "not_told", "not_told", "task_begin"]
    assert all(b - a >= S for a, b in itertools.pairwise(tries[:4]))
