"""A flight log as the rules of `edge.flightlog.explain.verdict` read it: ticks, generations, faults and truth."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from edge.core.geometry import SE2
from edge.flightlog.reader import Damage, RecordingError, damage_notice, read_messages
from edge.flightlog.replay.records import NO_TICK, RecordedGeneration, RecordedTick, read_events, read_run
from edge.flightlog.standard_messages import Mount
from edge.reasoning.told_turn import split_turn
from edge.safety.faults.row import Action

_ROUTE_NEAR_NS = 600_000_000
"""Largest distance in time of a shortest path from the instant that it is used for, ns."""
ASPECTS: Final = (1 / 8, 8.0)
"""Least and largest width by height of a camera's picture: drawn in another shape it would be empty or fill memory."""
_MOST_NS: Final = 2**63
"""Stamps are below it: monotonic ns in 64 bits. A larger one cannot be converted to s."""
_MISSHAPEN: Final = (LookupError, TypeError, ValueError, AttributeError, OverflowError)


@dataclass(frozen=True)
class Truth:
    """State of a simulated world at one instant."""

    stamp_ns: int
    T_world_base: SE2
    people: tuple[tuple[float, float], ...] = ()
    """Places of the people near the robot, m, in the world."""
    touching: tuple[str, ...] = ()
    route_m: float | None = None
    """Length of the shortest path to the goal."""
    route_bearing_rad: float | None = None
    """Direction of that path 3 m ahead, seen from the robot, left positive."""
    seen: tuple[bool, ...] | None = None
    """Whether no solid hides each of `people` from the camera; None where that is unknown."""

    @staticmethod
    def of_record(stamp_ns: int, record: Mapping[str, Any]) -> Truth:
        """Read a `/truth` record. Raises LookupError, TypeError, ValueError or OverflowError."""
        people = tuple((float(row[0]), float(row[1])) for row in record["people"])
        seen = None if record.get("people_seen") is None else tuple(bool(each) for each in record["people_seen"])
        if seen is not None and len(seen) != len(people):
            raise ValueError(f"people_seen: expected {len(people)} values, found {len(seen)}")
        return Truth(
            stamp_ns,
            SE2(*(float(value) for value in record["pose"])),
            people,
            tuple(str(label) for label in record["touching"]),
            _number_or_none(record.get("route_m")),
            _number_or_none(record.get("route_bearing_rad")),
            seen,
        )


@dataclass(frozen=True)
class FaultSpan:
    """A fault and when it was present, ns; `end_ns` is infinite (2**63) for one that was never cleared."""

    name: str
    detail: str
    begin_ns: int
    end_ns: int
    stops: bool = False
    """Whether it stops the robot until a new arming."""


@dataclass(frozen=True)
class Flight:
    """One run in the order of time; raises ValueError without a tick."""

    instruction: str
    ticks: Sequence[RecordedTick]
    generations: Mapping[int, RecordedGeneration]
    faults: Sequence[FaultSpan] = ()
    truths: Sequence[Truth] = ()
    """Empty for a robot without a simulator."""
    result: Mapping[str, Any] = field(default_factory=dict)
    mount: Mount | None = None
    frames_ns: Sequence[int] = ()
    damages: Sequence[Damage] = ()
    """Places of the log that could not be read."""

    def __post_init__(self) -> None:
        if not self.ticks:
            raise ValueError("a flight needs at least one tick")

    @property
    def start_ns(self) -> int:
        """Instant of the first tick: zero of all times in s."""
        return self.ticks[0].now_ns

    @property
    def last_tick_ns(self) -> int:
        """Instant of the last tick."""
        return self.ticks[-1].now_ns

    @property
    def end_ns(self) -> int:
        """Instant of the last tick or truth: an episode goes on without ticks after a stop until a new arming."""
        return max(self.last_tick_ns, self.truths[-1].stamp_ns if self.truths else self.last_tick_ns)

    @property
    def stop_fault(self) -> FaultSpan | None:
        """The first fault that stopped the robot until a new arming; None without one."""
        return min((fault for fault in self.faults if fault.stops), key=lambda fault: fault.begin_ns, default=None)

    @property
    def result_faults(self) -> tuple[str, ...]:
        """The result's lines on what ended or invalidated the run."""
        lines = self.result.get("faults")
        return tuple(map(str, lines)) if isinstance(lines, list) else ()

    @property
    def new_instructions(self) -> list[tuple[int, str]]:
        """Instructions given during the run, each with the release of its first text, ns."""
        found: list[tuple[int, str]] = []
        now = self.instruction
        first = (now, split_turn(now)[1])  # the model is not given a turn that control has made
        for each in sorted(self.generations.values(), key=lambda each: each.ready_ns):
            if each.instruction is not None and each.instruction != now:
                now = each.instruction
                if found or now not in first:
                    found.append((each.ready_ns, now))
        return found

    @property
    def notice(self) -> str | None:
        """One line for the user about damage of the log; None for a log without."""
        return damage_notice(self.damages, self.start_ns) if self.damages else None

    def seconds(self, at_ns: int) -> float:
        """Return an instant as s since the first tick."""
        return (at_ns - self.start_ns) / 1e9

    def ticks_between(self, begin_ns: int, end_ns: int) -> Sequence[RecordedTick]:
        """Return the ticks of a span of time, both ends included."""
        first = bisect_left(self.ticks, begin_ns, key=lambda tick: tick.now_ns)
        return self.ticks[first : bisect_right(self.ticks, end_ns, key=lambda tick: tick.now_ns)]

    def truth_at(self, at_ns: int) -> Truth | None:
        """Return the newest truth at an instant; None before the first one or without a simulator."""
        index = bisect_right(self.truths, at_ns, key=lambda truth: truth.stamp_ns)
        return self.truths[index - 1] if index else None

    def route_at(self, at_ns: int) -> Truth | None:
        """Return the truth nearest to an instant that has a shortest path; None farther than 0.6 s from it."""
        low = bisect_left(self.truths, at_ns - _ROUTE_NEAR_NS, key=lambda truth: truth.stamp_ns)
        high = bisect_right(self.truths, at_ns + _ROUTE_NEAR_NS, key=lambda truth: truth.stamp_ns)
        near = [truth for truth in self.truths[low:high] if truth.route_bearing_rad is not None]
        return min(near, key=lambda truth: abs(truth.stamp_ns - at_ns), default=None)

    def faults_at(self, at_ns: int) -> list[str]:
        """Return the names of the faults present at an instant, each once."""
        return list(dict.fromkeys(fault.name for fault in self.faults if fault.begin_ns <= at_ns <= fault.end_ns))

    def frame_at(self, at_ns: int) -> int | None:
        """Return the stamp of the newest recorded picture at an instant, ns."""
        index = bisect_right(self.frames_ns, at_ns)
        return self.frames_ns[index - 1] if index else None


def read_flight(path: Path) -> Flight:
    """Read a flight log. Raises RecordingError for one without a run or a tick or with a malformed record, OSError."""
    run, ticks, generations, frames_ns = read_run(path), [], {}, []
    damages: list[Damage] = []
    for event in read_events(path, damages):
        if isinstance(event, RecordedTick):
            _check_stamps(path, "/tick", event.now_ns)
            ticks.append(event)
        elif isinstance(event, RecordedGeneration):
            _check_stamps(path, "/semantic", event.ready_ns, *event.frames_ns)
            generations[event.number] = event
        else:
            frames_ns.append(event.stamp_ns)
    if not ticks:
        raise RecordingError(f"{path}: {NO_TICK}")
    truths: list[Truth] = []
    faults: list[FaultSpan] = []
    result: Mapping[str, Any] = {}
    mount: Mount | None = None
    for topic, stamp_ns, payload in read_messages(path):
        try:
            if topic == "/truth":
                truths.append(Truth.of_record(stamp_ns, payload))
            elif topic == "/fault":
                _add_fault(faults, stamp_ns, payload)
            elif topic == "/result":
                result = _result(payload)
            elif topic == "/run" and payload.get("mount") is not None:
                mount = _mount(payload["mount"])
        except _MISSHAPEN as error:
            raise RecordingError(f"{path}: a {topic} record lacks or misshapes a field ({error!r})") from error
    truths.sort(key=lambda truth: truth.stamp_ns)
    return Flight(run.instruction, ticks, generations, faults, truths, result, mount, sorted(frames_ns), damages)


def _check_stamps(path: Path, topic: str, *stamps_ns: int) -> None:
    """Raise RecordingError for a stamp that cannot be one."""
    if not all(-_MOST_NS < stamp_ns < _MOST_NS for stamp_ns in stamps_ns):
        raise RecordingError(f"{path}: a {topic} record has a stamp of more than 64 bits; expected monotonic ns")


def _result(record: Any) -> dict[str, Any]:
    """Return a `/result` record with a checked distance to the goal. Raises TypeError, ValueError or OverflowError."""
    if not isinstance(record, dict):
        raise TypeError(f"expected an object, found {type(record).__name__}")
    return {**record, "ne_m": _number_or_none(record.get("ne_m"))}


def _mount(record: Mapping[str, Any]) -> Mount:
    """Read the camera's mount, one of a picture that can be drawn. Raises one of _MISSHAPEN."""
    mount = Mount.of_record(record)
    if mount.aspect is not None and not ASPECTS[0] <= mount.aspect <= ASPECTS[1]:
        raise ValueError(f"mount.aspect: expected {ASPECTS[0]:g}..{ASPECTS[1]:g}, found {mount.aspect:g}")
    return mount


def _number_or_none(value: Any) -> float | None:
    return None if value is None else float(value)


def _add_fault(faults: list[FaultSpan], stamp_ns: int, record: Mapping[str, Any]) -> None:
    name = str(record["name"])
    if record["change"] == "raised":
        stops = record.get("action") == Action.STOP.name
        faults.append(FaultSpan(name, str(record["detail"]), stamp_ns, 2**63, stops))
        return
    for index in range(len(faults) - 1, -1, -1):
        fault = faults[index]
        if fault.name == name and fault.end_ns == 2**63:
            faults[index] = replace(fault, end_ns=stamp_ns)
            return


def bearing_rad(point: tuple[float, float]) -> float:
    """Return the direction of a point in the robot's frame, left positive."""
    return math.atan2(point[1], point[0])
