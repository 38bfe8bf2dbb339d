"""Events that ask for an explanation: stops, collisions, detours and the end of a run that did not reach its goal."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from edge.flightlog.explain.flight import Flight
from edge.flightlog.replay.records import RecordedTick

COLLISION, STOP, DETOUR, TIMEOUT, FALL = "collision", "stop", "detour", "timeout", "fall"
STOP_S: Final = 2.0
"""Shortest stop that is explained, s: shorter ones are those of a robot that lets a person pass."""
STANDS_M: Final = 0.05
STANDS_RAD: Final = 0.09
"""Motion within 1 s below which the robot stands; a trotting body sways by less."""
DETOUR_M: Final = 2.0
"""Growth of the shortest path to the goal that counts as a detour, m: more than passing a person takes."""
LOOP_M: Final = 4.0
"""Without truth: length of a path that leads back to within LOOP_NEAR_M of its start, m."""
LOOP_NEAR_M: Final = 0.7
_TOUCH_GAP_NS: Final = 2_000_000_000
"""Contacts with the same object closer in time than this are one collision, ns."""
_BACK_NS: Final = 1_000_000_000


@dataclass(frozen=True)
class Event:
    """Something that happened to the robot between two instants, ns."""

    kind: str
    begin_ns: int
    end_ns: int
    detail: str
    final: bool = False
    """Whether it is the stop that only a new arming ends."""
    first: bool = False
    """Whether it is a stop before the robot first moved."""

    @property
    def seconds(self) -> float:
        """Duration, s."""
        return (self.end_ns - self.begin_ns) / 1e9


def find_events(flight: Flight) -> list[Event]:
    """Return all events in the order of time; the end of a failed run is the last one."""
    detours = detours_by_route(flight) if any(t.route_m is not None for t in flight.truths) else loops(flight)
    found = [*collisions(flight), *stops(flight), *detours, *final_stop(flight)]
    found.sort(key=lambda event: event.begin_ns)
    end = {"timeout": TIMEOUT, "fell": FALL}.get(str(flight.result.get("end")))
    if end is not None:
        left = flight.result.get("ne_m")
        detail = "" if left is None else f"{float(left):.1f} m from the goal"
        found.append(Event(end, flight.end_ns, flight.end_ns, detail))
    return found


def collisions(flight: Flight) -> list[Event]:
    """Return the contacts that a simulator reports; a robot of its own does not feel them."""
    found: list[Event] = []
    open_until: dict[str, int] = {}
    for truth in flight.truths:
        new = sorted(name for name in truth.touching if truth.stamp_ns - open_until.get(name, -(2**62)) > _TOUCH_GAP_NS)
        if new:
            found.append(Event(COLLISION, truth.stamp_ns, truth.stamp_ns, ", ".join(new)))
        open_until.update(dict.fromkeys(truth.touching, truth.stamp_ns))
    return found


def stops(flight: Flight) -> list[Event]:
    """Return the spans of at least STOP_S in which the robot stood, also before it first moved."""
    found: list[Event] = []
    begin_ns: int | None = None
    ticks = flight.ticks
    back = 0
    for tick in ticks:
        while ticks[back].now_ns < tick.now_ns - _BACK_NS:
            back += 1
        standing = _stands(ticks[back], tick)
        if standing and begin_ns is None:
            begin_ns = ticks[back].now_ns
        if not standing and begin_ns is not None:
            _add_stop(found, ticks, begin_ns, tick.now_ns)
            begin_ns = None
    if begin_ns is not None:
        _add_stop(found, ticks, begin_ns, ticks[-1].now_ns)
    return found


def final_stop(flight: Flight) -> list[Event]:
    """Return the stop that only a new arming ends, from the last tick to the end of the log; empty without one.

    A fault or the result names its reason; in an episode, time that goes on without ticks shows it without a reason.
    """
    silent_s = (flight.end_ns - flight.last_tick_ns) / 1e9 if "end" in flight.result else 0.0
    if flight.stop_fault is None and not flight.result_faults and silent_s < STOP_S:
        return []
    return [Event(STOP, flight.last_tick_ns, flight.end_ns, "the robot was not driven again", final=True)]


def _stands(before: RecordedTick, now: RecordedTick) -> bool:
    if before.pose is None or now.pose is None:
        return not any(now.command)
    if now.now_ns - before.now_ns < _BACK_NS // 2:
        return True
    step = before.pose.inverse() @ now.pose
    return math.hypot(step.x_m, step.y_m) < STANDS_M and abs(step.theta_rad) < STANDS_RAD


def _add_stop(found: list[Event], ticks: Sequence[RecordedTick], begin_ns: int, end_ns: int) -> None:
    if end_ns - begin_ns < STOP_S * 1e9:
        return
    reasons: dict[str, int] = {}
    for tick in ticks:
        if begin_ns <= tick.now_ns <= end_ns:
            reasons[tick.reason] = reasons.get(tick.reason, 0) + 1
    most = max(reasons, key=lambda name: reasons[name])
    first, whole = begin_ns == ticks[0].now_ns, end_ns == ticks[-1].now_ns
    when = "; the robot never moved" if first and whole else "; before it first moved" if first else ""
    found.append(Event(STOP, begin_ns, end_ns, f"{(end_ns - begin_ns) / 1e9:.1f} s, mostly {most}{when}", first=first))


def detours_by_route(flight: Flight) -> list[Event]:
    """Return the spans in which the shortest path to the goal grew by more than DETOUR_M."""
    found: list[Event] = []
    nearest_m, nearest_ns, worst_m = math.inf, 0, 0.0
    for truth in flight.truths:
        if truth.route_m is None:
            continue
        if truth.route_m <= nearest_m:
            if worst_m > DETOUR_M:
                found.append(_detour(nearest_ns, truth.stamp_ns, worst_m))
            nearest_m, nearest_ns, worst_m = truth.route_m, truth.stamp_ns, 0.0
        worst_m = max(worst_m, truth.route_m - nearest_m)
    if worst_m > DETOUR_M:
        # Without ticks the robot stands: that time is the final stop's.
        found.append(_detour(nearest_ns, min(flight.truths[-1].stamp_ns, flight.last_tick_ns), worst_m))
    return found


def _detour(begin_ns: int, end_ns: int, worst_m: float) -> Event:
    return Event(DETOUR, begin_ns, end_ns, f"the path to the goal grew by {worst_m:.1f} m")


class _Place(NamedTuple):
    """A place of the odometry's path, m; `length_m`: of the path up to it."""

    at_ns: int
    x_m: float
    y_m: float
    length_m: float

    @property
    def cell(self) -> tuple[float, float]:
        """The square of LOOP_NEAR_M that contains the place."""
        return self.x_m // LOOP_NEAR_M, self.y_m // LOOP_NEAR_M


_Cells = dict[tuple[float, float], list[_Place]]


def loops(flight: Flight) -> list[Event]:
    """Return the loops of the odometry's path: it leads back to a place after more than LOOP_M.

    A new instruction begins a new path: it may lead the robot back.
    """
    found: list[Event] = []
    changes_ns = [at_ns for at_ns, _ in flight.new_instructions]
    cells: _Cells = {}
    last: _Place | None = None
    for tick in flight.ticks:
        if tick.pose is None:
            continue
        if changes_ns and changes_ns[0] <= tick.now_ns:
            changes_ns = [at_ns for at_ns in changes_ns if at_ns > tick.now_ns]
            cells, last = {}, None
        x_m, y_m = tick.pose.x_m, tick.pose.y_m
        step_m = 0.0 if last is None else math.hypot(x_m - last.x_m, y_m - last.y_m)
        if last is not None and step_m < 0.1:
            continue  # a place every 0.1 m
        place = _Place(tick.now_ns, x_m, y_m, step_m + (0.0 if last is None else last.length_m))
        first = _first_near(cells, place)
        if first is not None:
            detail = f"back at the same place after {place.length_m - first.length_m:.1f} m"
            found.append(Event(DETOUR, first.at_ns, tick.now_ns, detail))
            cells, place = {}, place._replace(length_m=0.0)
        cells.setdefault(place.cell, []).append(place)
        last = place
    return found


def _first_near(cells: _Cells, place: _Place) -> _Place | None:
    """Return the first place within LOOP_NEAR_M from which the path is longer than LOOP_M; None without one."""
    column, row = place.cell
    around = itertools.product((column - 1, column, column + 1), (row - 1, row, row + 1))
    near = (each for cell in around for each in cells.get(cell, ()) if place.length_m - each.length_m > LOOP_M)
    back = (each for each in near if math.hypot(place.x_m - each.x_m, place.y_m - each.y_m) < LOOP_NEAR_M)
    return min(back, key=lambda each: each.length_m, default=None)
