"""Flights of a robot that walks along a straight path at 0.5 m/s, to be changed by the tests of explanations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from edge.core.geometry import SE2
from edge.flightlog.explain.flight import Flight, Truth
from edge.flightlog.part import LogPart, PartFile
from edge.flightlog.replay.records import RecordedGeneration, RecordedTick
from edge.reasoning.decoding_rules import DecodingContext
from tests.edge.flightlog.test_log_schemas import SAMPLES
from tests.support.runner import synthetic_run

START_NS = 10_000_000_000
TICK_NS = 100_000_000
SPEED_MPS = 0.5
GENERATION_S = 2.0
STRAIGHT = "waypoints: (1.5, 0.0) (3.0, 0.0) (4.5, 0.0)"
TEXT = f"Situation: in a corridor.\nObjects: none.\nMotion: nobody near.\nPlan: stop in 9 m.\n{STRAIGHT}"
TURN_LEFT = "waypoints: (1.5, 0.2) (1.8, 2.5) (1.8, 4.0)"
MOUNT = {"hfov_deg": 100.0, "height_m": 0.35, "pitch_deg": 2.0, "forward_m": 0.3}


def at(second: float) -> int:
    """An instant of the flight, ns."""
    return START_NS + round(second * 1e9)


def tick(second: float, **changes: Any) -> RecordedTick:
    """A tick that drives as planned."""
    number = round(second * 10)
    generation = int(second // GENERATION_S)
    age_s = second - generation * GENERATION_S + 1.0
    rows = np.array([[0.5, 0.0, 0.0], [1.0, 0.0, 0.0], [1.5, 0.0, 0.0]])
    told = RecordedTick(
        number=number,
        now_ns=at(second),
        acted_ns=at(second),
        frame_ns=at(second),
        generation=generation,
        delay_s=age_s,
        delay_given_s=age_s,
        offset=SE2(SPEED_MPS * age_s, 0.0, 0.0),
        pose=SE2(SPEED_MPS * second, 0.0, 0.0),
        state=(SPEED_MPS, 0.0, 0.0),
        rows=rows,
        command=(SPEED_MPS, 0.0, 0.0),
        reason="ok",
        speed_scale=1.0,
    )
    return replace(told, **changes)


def generation(number: int, text: str = TEXT) -> RecordedGeneration:
    """A generation whose picture was taken 1 s before its release."""
    anchor_s = number * GENERATION_S - 1.0
    pose = SE2(SPEED_MPS * anchor_s, 0.0, 0.0)
    return RecordedGeneration(
        number, at(number * GENERATION_S), None, (at(anchor_s),), (pose,), pose, (), DecodingContext(), 64, text
    )


def truth(second: float, **changes: Any) -> Truth:
    """The true state: where odometry says, the goal straight ahead."""
    route_m = 30.0 - SPEED_MPS * second
    return replace(Truth(at(second), SE2(SPEED_MPS * second, 0.0, 0.0), (), (), route_m, 0.0), **changes)


def flight(
    seconds: float = 20.0,
    *,
    ticks: Callable[[float], RecordedTick] = tick,
    texts: Callable[[int], str] = lambda number: TEXT,
    truths: Callable[[float], Truth] | None = truth,
    **changes: Any,
) -> Flight:
    """A flight whose ticks, texts and truths may be replaced, each a function of its second or its number."""
    times = [number / 10 for number in range(round(seconds * 10))]
    generations = {n: generation(n, texts(n)) for n in range(int(seconds // GENERATION_S) + 1)}
    known = [] if truths is None else [truths(second) for second in (-1.0, -0.5, *times)]
    whole = Flight("walk on", [ticks(second) for second in times], generations, (), known, frames_ns=[at(0.0)])
    return replace(whole, **changes)


def write(path: Path, seconds: float = 12.0, *, touch_s: float | None = None, end: str = "timeout") -> None:
    """A flight log of 5 s of driving and a stop, with pictures and truth, as a simulator writes it."""
    part = LogPart(PartFile(path, new=False), 1)
    part.add("/run", START_NS, {**SAMPLES["/run"], "started_ns": START_NS, "mount": MOUNT})
    part.add("/semantic", at(0.0), {**SAMPLES["/semantic"], **_semantic()})
    for number in range(round(seconds * 10)):
        second = number / 10
        way_m, driving = SPEED_MPS * min(second, 5.0), second < 5.0
        record = {
            **SAMPLES["/tick"], "tick": number, "now_ns": at(second), "frame_ns": at(second), "generation": 0,
            "delay_s": second + 1.0, "delay_given_s": second + 1.0, "offset": [way_m, 0.0, 0.0],
            "pose": [way_m, 0.0, 0.0], "state": [SPEED_MPS * driving, 0.0, 0.0],
            "trajectory": [[0.5 * k, 0.0, 0.0] for k in (1, 2, 3)], "command": [SPEED_MPS * driving, 0.0, 0.0],
            "reason": "ok" if driving else "camera-frozen",
        }  # fmt: skip
        part.add("/camera", at(second), synthetic_run.jpeg(second))
        part.add("/tick", at(second), record)
        touching = ["plant"] if touch_s is not None and 0 <= second - touch_s < 0.5 else []
        part.add("/truth", at(second), {"pose": [way_m, 0.0, 0.0], "people": [], "touching": touching})
    part.add("/result", at(seconds), {"end": end, "ne_m": 7.0})
    part.finish()
    part.file.close()


def _semantic() -> dict[str, Any]:
    first = {"anchor_ns": at(0.0), "ready_ns": at(0.0), "frames_ns": [at(0.0)], "anchor_pose": [0.0, 0.0, 0.0]}
    return {**first, "generation": 0, "text": TEXT, "waypoints": [[1.5, 0.0], [3.0, 0.0], [4.5, 0.0]]}
