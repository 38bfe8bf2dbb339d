"""Explanation of every event of a flight: the chain from picture to motion, the verdict and the pictures to show."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from edge.core.geometry import SE2
from edge.flightlog.explain.chain import drift, generation_of, people_ahead
from edge.flightlog.explain.events import COLLISION, FALL, TIMEOUT, Event, find_events
from edge.flightlog.explain.flight import Flight
from edge.flightlog.explain.verdict import Verdict, decisive, judge, window
from edge.flightlog.replay.records import RecordedTick
from edge.state.reasoning_text import parse_waypoints

_SHOWN_TICKS = 10
"""Ticks of a generation over which the robot's motion is stated: a second."""


@dataclass(frozen=True)
class Explanation:
    """One event with its verdict; `steps`: question and answer along the chain; stamps of the two pictures, ns."""

    event: Event
    verdict: Verdict
    refers: bool
    """Whether the verdict is that of another event in the list."""
    at_s: float
    steps: tuple[tuple[str, str], ...]
    text: str
    generation: int | None
    """Number of the generation of `text`."""
    anchor_frame_ns: int | None
    event_frame_ns: int | None

    def as_json(self) -> dict[str, Any]:
        """Return the explanation as JSON values."""
        return {
            "event": self.event.kind,
            "at_s": round(self.at_s, 1),
            "duration_s": round(self.event.seconds, 1),
            "detail": self.event.detail,
            "cause": self.verdict.cause,
            "because": self.verdict.because,
            "refers": self.refers,
            "evidence": list(self.verdict.evidence),
            "steps": dict(self.steps),
            "text": self.text,
        }


def explain(flight: Flight) -> list[Explanation]:
    """Return the explanations of all events in the order of time."""
    events = find_events(flight)
    return [_explained(flight, event, _cause_of(flight, event, events)) for event in events]


def deciding(flight: Flight, found: Sequence[Explanation]) -> Explanation | None:
    """Return the explanation of the event that cost the run its goal; None for a run without one."""
    event = decisive(flight, [each.event for each in found])
    return next((each for each in found if each.event == event), None)


def _cause_of(flight: Flight, event: Event, events: Sequence[Event]) -> Event:
    """Return the event that explains another: for the end of a run, the one that cost most time."""
    if event.kind not in (TIMEOUT, FALL):
        return event
    return (decisive(flight, events) or event) if event.kind == TIMEOUT else event


def _explained(flight: Flight, event: Event, cause: Event) -> Explanation:
    verdict = judge(flight, cause)
    if cause != event:
        at_s = flight.seconds(cause.begin_ns)
        lost = "the run was lost with the stop" if cause.final else f"most time went to the {cause.kind}"
        if cause.kind == COLLISION:
            lost = "no stop or detour came before it; the first collision,"
        because = f"{lost} at {at_s:.0f} s ({cause.detail}): {verdict.because}"
        verdict = Verdict(verdict.cause, because, verdict.evidence, verdict.generation)
    ticks = flight.ticks_between(*window(cause)) or flight.ticks[-1:]
    if verdict.generation is not None:
        driven = [tick for tick in flight.ticks if tick.generation == verdict.generation]
        ticks = driven[:_SHOWN_TICKS] or ticks
    generation = generation_of(flight, ticks[-1])
    return Explanation(
        event,
        verdict,
        cause != event,
        flight.seconds(event.begin_ns),
        _steps(flight, ticks),
        "" if generation is None else generation.text,
        None if generation is None else generation.number,
        None if generation is None else generation.frames_ns[-1],
        flight.frame_at(cause.begin_ns),
    )


def _steps(flight: Flight, ticks: Sequence[RecordedTick]) -> tuple[tuple[str, str], ...]:
    """Return the six questions and their answers at the end of a span."""
    tick = ticks[-1]
    generation = generation_of(flight, tick)
    if generation is None:
        nothing = "nothing: no generation had been released"
        saw, claimed, waypoints = "no picture was used yet", nothing, nothing
    else:
        anchor_ns = generation.frames_ns[-1]
        age = f"{tick.delay_s:.1f} s old at {flight.seconds(tick.now_ns):.1f} s"
        saw = f"picture of {flight.seconds(anchor_ns):.1f} s, {age}{_scene(flight, anchor_ns)}"
        claimed = " ".join(generation.text.splitlines()[:-1]) or "nothing"
        points = parse_waypoints(generation.text)
        waypoints = "none" if points is None else " ".join(f"({x:.1f}, {y:.1f})" for x, y in points)
    return (
        ("The camera saw", saw),
        ("The text claimed", claimed),
        ("Its waypoints, m at 3, 6, 9 s", waypoints),
        ("The action expert planned", _plan(tick)),
        ("Commanded", _command(flight, tick)),
        ("The robot did", _did(flight, ticks)),
    )


def _scene(flight: Flight, at_ns: int) -> str:
    truth = flight.truth_at(at_ns)
    if truth is None:
        return ""
    people = people_ahead(truth, 6.0)
    count = "1 person" if len(people) == 1 else f"{len(people)} people"
    hidden = ", possibly hidden" if truth.seen is None else ""
    nearest = f"{hidden}, the nearest at {people[0][0]:.1f} m" if people else ""
    route = flight.route_at(at_ns)
    way = ""
    if route is not None and route.route_bearing_rad is not None:
        way = f"; the path to the goal, {route.route_m or 0:.0f} m, leads {math.degrees(route.route_bearing_rad):+.0f}°"
    return f"; in truth {count} within 6 m ahead{nearest}{way}"


def _plan(tick: RecordedTick) -> str:
    if tick.rows is None:
        return "nothing"
    rows = [f"({x:.2f}, {y:.2f}) m {math.degrees(theta):+.0f}°" for x, y, theta in tick.rows]
    return f"after 1, 2, 3 s: {', '.join(rows)}"


def _command(flight: Flight, tick: RecordedTick) -> str:
    vx, vy, wz = tick.command
    faults = ", ".join(flight.faults_at(tick.now_ns))
    limit = "" if tick.speed_scale >= 1 else f", limit {tick.speed_scale:.0%}"
    named = f"; faults: {faults}" if faults else ""
    return f"{vx:+.2f} m/s, {vy:+.2f} m/s left, {wz:+.2f} rad/s ({tick.reason}{limit}){named}"


def _did(flight: Flight, ticks: Sequence[RecordedTick]) -> str:
    first, last = ticks[0], ticks[-1]
    if first.pose is None or last.pose is None:
        return "unknown: no odometry"
    span_s = (last.now_ns - first.now_ns) / 1e9
    said = f"in {span_s:.1f} s by odometry {_moved(first.pose.inverse() @ last.pose)}"
    then, now = flight.truth_at(first.now_ns), flight.truth_at(last.now_ns)
    if then is None or now is None:
        return said
    error = drift(flight, last)
    off = "" if error is None else f"; odometry {error[0]:.2f} m off since the anchor"
    return f"{said}, in truth {_moved(then.T_world_base.inverse() @ now.T_world_base)}{off}"


def _moved(step: SE2) -> str:
    return f"{math.hypot(step.x_m, step.y_m):.2f} m, {math.degrees(step.theta_rad):+.0f}°"
