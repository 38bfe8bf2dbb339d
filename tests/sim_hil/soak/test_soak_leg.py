"""A leg while a runner drives, on a clock of its own and without processes."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from edge.run.say import SayError
from sim_hil.realtime.children import StepError
from sim_hil.realtime.stack import StackOptions
from sim_hil.realtime.truth import TruePose, read_lines
from sim_hil.soak import leg as soak_leg
from sim_hil.soak.faults import FaultMenu, SoakFault
from sim_hil.soak.leg import CONTACT, EVENTS, SAMPLES, Leg, LegOptions, explained_end
from sim_hil.soak.tasks import SoakTask

S = 1_000_000_000
TASK = SoakTask(1, "go on", (0.0, 0.0, 0.0), (9.0, 9.0), "door 1", 12.7, 3.0)


class Clock:
    """Replacement of the module `time`: a sleep advances only this clock."""

    now_ns = S

    def monotonic_ns(self) -> int:
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        self.now_ns += round(seconds * S)


class Planner:
    """Executor whose work is done a while later on this clock."""

    def __init__(self, clock: Clock, takes_s: float) -> None:
        self._clock, self._takes_ns = clock, round(takes_s * S)

    def __enter__(self) -> None: ...

    def __exit__(self, *_: object) -> None: ...

    def submit(self, work: Callable[..., Any], *arguments: Any) -> SimpleNamespace:
        done_ns = self._clock.now_ns + self._takes_ns
        return SimpleNamespace(done=lambda: self._clock.now_ns >= done_ns, result=partial(work, *arguments))


MakeLeg = Callable[..., Leg]


@pytest.fixture
def make_leg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> MakeLeg:
    """Return a function that makes a leg of a stack whose processes run for ever and whose robot stands."""

    def nothing(*_: object, **__: object) -> int:
        return 0

    def make(
        clock: Clock, duration_s: float, *, menu: FaultMenu | None = None, end_s: float = math.inf, plan_s: float = 0.0
    ) -> Leg:
        truth = SimpleNamespace(newest=pose, update=lambda: [TruePose(clock.now_ns, 0, 0, 0, ())])
        monkeypatch.setattr(soak_leg, "time", clock)
        monkeypatch.setattr(soak_leg, "ThreadPoolExecutor", lambda _: Planner(clock, plan_s))
        monkeypatch.setattr(soak_leg, "Stack", lambda _: stack)
        monkeypatch.setattr(soak_leg, "TruthTail", lambda _: truth)
        options = LegOptions(
            1, 0, duration_s, 0.8, StackOptions(tmp_path, tmp_path, "office", (0.0, 0.0, 0.0), 0, 0, 1)
        )
        journey: Any = SimpleNamespace(next=lambda _at: TASK)
        return Leg(options, journey, menu, stopped=lambda: clock.now_ns > end_s * S, show_status=lambda _: None)

    calls = ("watch_stalls", "start_robot", "start_bridge", "start_runner", "end", "__exit__")
    running = {name: SimpleNamespace(running=True) for name in ("robot", "bridge", "runner")}
    values: dict[str, Any] = {"trace": tmp_path / "t", "instructions": tmp_path / "say", "runs": 1}
    values["faults"] = SimpleNamespace(answers=tuple, ask=nothing)
    stack = type("Stack", (), {**dict.fromkeys(calls, nothing), "__enter__": nothing, "armed": lambda _: True})()
    for name, value in {**running, **values, "processes": dict}.items():
        setattr(stack, name, value)
    pose = TruePose(0, 0, 0, 0, ())
    return make


@pytest.mark.parametrize(
    ("codes", "stops"),
    [
        ({}, {}),
        ({"runner": 130, "robot": 130}, {}),
        ({"runner": -9}, {"the runner ended with code -9 at the end of the leg": ""}),
        ({"bridge": -11, "robot": 1}, {
            "the bridge ended with code -11 at the end of the leg": "",
            "the robot ended with code 1 at the end of the leg": "",
        }),
    ],
)  # fmt: skip
def test_a_process_that_does_not_end_well_with_its_leg_is_an_unexplained_stop(
    tmp_path: Path, make_leg: MakeLeg, codes: dict[str, int], stops: dict[str, str]
) -> None:
    leg = make_leg(Clock(), 1.0)
    leg._stack.end = lambda name: codes.get(name, 0)  # type: ignore[method-assign]
    leg._stack.result = lambda name: tmp_path / name  # type: ignore[method-assign]
    assert leg.run() == "duration"
    events = [event for event in read_lines(tmp_path / EVENTS) if event["kind"] == "life_end"]
    ends = {event["cause"]: event["explained"] for event in events}
    clean = {} if "runner" in codes and codes["runner"] != 130 else {"leg": "leg"}
    assert ends == clean | stops and leg.stops == len(stops)


def test_a_leg_whose_robot_dies_says_so_in_its_events(tmp_path: Path, make_leg: MakeLeg) -> None:
    leg = make_leg(Clock(), 60.0)
    process: Any = SimpleNamespace(running=False, process=SimpleNamespace(returncode=1), log=tmp_path / "hil.log")
    leg._stack.robot = process
    with pytest.raises(StepError):
        leg.run()
    *_, last = read_lines(tmp_path / EVENTS)
    assert last["kind"] == "leg_end"
    assert last["why"].startswith("failed: the robot's side ended with exit code 1")


def test_an_instruction_is_sent_again_to_a_runner_too_busy_to_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make_leg: MakeLeg
) -> None:
    clock, sent_ns = Clock(), list[int]()

    def say(_path: Path, _instruction: str) -> str:
        sent_ns.append(clock.now_ns)
        if len(sent_ns) <= 3:
            raise SayError("no answer")
        return "accepted"

    monkeypatch.setattr(soak_leg, "say", say)

    assert make_leg(clock, 15.0).run() == "duration"

    kinds = [event["kind"] for event in read_lines(tmp_path / EVENTS) if event["kind"].startswith(("task", "not"))]
    assert kinds[:6] == ["task_begin", "task_end", "not_told", "not_told", "not_told", "task_begin"]
    assert all(b - a >= S for a, b in itertools.pairwise(sent_ns[:4]))


def test_faults_and_samples_do_not_wait_for_the_plan_of_the_next_task(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make_leg: MakeLeg
) -> None:
    monkeypatch.setattr(soak_leg, "say", lambda *_: "accepted")
    menu = FaultMenu((1.0, 2.0), (SoakFault("camera stops", "camera-stop", (1.0, 1.0), 1.0, "", "zero"),))

    assert make_leg(Clock(), 60.0, menu=menu, plan_s=20.0).run() == "duration"

    events = list(read_lines(tmp_path / EVENTS))
    ended_ns = next(event["t_ns"] for event in events if event["kind"] == "task_end")
    begun_ns = next(e["t_ns"] for e in events if e["kind"] == "task_begin" and e["t_ns"] > ended_ns)
    assert begun_ns - ended_ns >= 20 * S
    faults = [e["t_ns"] for e in events if e["kind"].startswith("fault_o") and ended_ns < e["t_ns"] < begun_ns]
    assert len(faults) > 10 and max(b - a for a, b in itertools.pairwise(faults)) < 2.2 * S
    samples = [sample["t_ns"] for sample in read_lines(tmp_path / SAMPLES)]
    assert max(b - a for a, b in itertools.pairwise(samples)) < 1.2 * S


@pytest.mark.parametrize(("duration_s", "injected"), [(600.0, True), (7200.0, False)])
def test_a_leg_long_enough_to_judge_growth_has_no_fault_that_ends_the_run_at_its_begin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make_leg: MakeLeg, duration_s: float, injected: bool
) -> None:
    monkeypatch.setattr(soak_leg, "say", lambda *_: "accepted")
    menu = FaultMenu((20.0, 30.0), (SoakFault("robot reports an error", "error-code", (1.0, 1.0), 1.0, "", "stop"),))

    assert make_leg(Clock(), duration_s, menu=menu, end_s=60.0).run() == "stopped"

    kinds = [event["kind"] for event in read_lines(tmp_path / EVENTS)]
    assert ("fault_on" in kinds) == injected


@pytest.mark.parametrize(
    ("explained", "before", "raised", "refused", "expected"),
    [
        (CONTACT, "", {"tipped-over", "frames-late"}, False, CONTACT),
        (CONTACT, "", set(), False, ""),
        (CONTACT, "", {"deadman"}, False, ""),
        (CONTACT, "", set(), True, CONTACT),  # it leans on what it fell onto: it must not be armed
        ("", CONTACT, set(), True, CONTACT),  # it lies where it fell, and the person whom it touched has gone on
        ("", "", set(), True, ""),
        ("", CONTACT, {"tipped-over"}, False, ""),
        ("half of the states lost", "", set(), False, "half of the states lost"),
    ],
)
def test_a_contact_explains_a_fall_and_the_refusals_to_arm_after_it_but_no_other_end(
    explained: str, before: str, raised: set[str], refused: bool, expected: str
) -> None:
    assert explained_end(explained, before, raised, refused=refused) == expected
