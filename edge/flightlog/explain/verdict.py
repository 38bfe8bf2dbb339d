"""Whose fault an event was: rules over what the camera saw, the text claimed, the plan, the command and the motion.

Each rule compares two neighbours of that chain; the first one that fails names the cause. A rule that needs ground
truth is silent without it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from edge.core.geometry import SE2, wrap_angle
from edge.flightlog.explain.chain import (
    NEAR_M,
    drift,
    generation_of,
    leading_waypoint,
    people_ahead,
    waypoint_at,
)
from edge.flightlog.explain.events import COLLISION, DETOUR, FALL, STOP, Event
from edge.flightlog.explain.flight import Flight, bearing_rad
from edge.flightlog.replay.records import RecordedGeneration, RecordedTick
from edge.motion.recovery import ARRIVED as HELD_AT_STOP
from edge.state.reasoning_text import LEFT, RIGHT, Stop, Turn, TurnBack, parse_text, parse_waypoints

ODOMETRY: Final = "odometry"
REASONING: Final = "reasoning text"
LATE: Final = "late reasoning"
EXPERT: Final = "action expert"
LIMITED: Final = "command limited"
EXECUTION: Final = "execution"
PERSON: Final = "person"
ARRIVED: Final = "arrived"
UNEXPLAINED: Final = "unexplained"
CAUSES: Final = (ODOMETRY, REASONING, LATE, EXPERT, LIMITED, EXECUTION, PERSON, ARRIVED, UNEXPLAINED)
"""Causes, in the order of the chain from the robot's pose to its motion."""

DRIFT_M: Final = 0.5
DRIFT_RAD: Final = math.radians(15)
"""Error of the odometry since the anchor from which on it is the cause, m and rad: a third of an opening's width."""
WRONG_WAY_RAD: Final = math.radians(45)
"""Angle between waypoints and shortest path that contradicts the route: more than passing an obstacle takes."""
OFF_TEXT_RAD: Final = math.radians(45)
OFF_TEXT_M: Final = 1.5
"""Angle and distance between the plan's end and the waypoints at its time from which on the plan disagrees."""
_STRAIGHT_RAD: Final = math.radians(25)
"""Direction of the shortest path within which it goes straight on."""
GOAL_M: Final = 2.0
"""Path to the goal beyond which a stop is not at the goal, m: the benchmark's threshold and some odometry error."""
GOES_M: Final = 0.25
"""Distance in 1 s from which on a plan drives, m."""
HELD_SHARE: Final = 0.3
"""Share of the planned speed below which the command was limited."""
LAG_SHARE: Final = 0.4
"""Share of the commanded speed below which the robot did not do as commanded."""
_BEFORE_NS: Final = 3_000_000_000
"""Span before an event that is judged, ns: the plan's horizon."""


@dataclass(frozen=True)
class Verdict:
    """Cause of an event, the reason in one sentence, and the numbers behind it."""

    cause: str
    because: str
    evidence: tuple[str, ...] = ()
    generation: int | None = None
    """Number of the generation whose text is the cause, where it is not the one in force at the event."""

    def __post_init__(self) -> None:
        if self.cause not in CAUSES:
            raise ValueError(f"verdict: expected a cause of {', '.join(CAUSES)}, found {self.cause!r}")


def judge(flight: Flight, event: Event) -> Verdict:
    """Return the verdict of an event. The end of a run is judged by its longest earlier event, see `decisive`."""
    if event.final:
        return _final_stop(flight)
    begin_ns, end_ns = window(event)
    ticks = flight.ticks_between(begin_ns, end_ns)
    if not ticks:
        return Verdict(UNEXPLAINED, "the log has no tick of this time")
    if event.kind == STOP:
        return _of_stop(flight, event, ticks)
    with_person = event.kind == COLLISION and "person" in event.detail
    chain = (
        _odometry(flight, ticks[-1]),
        # A route that leads elsewhere is no reason to walk into a person.
        _person(flight, event, ticks) if with_person else _texts(flight, event, ticks[-1]),
        _plan_against_text(flight, ticks),
        _command(flight, ticks),
        _execution(flight, ticks),
    )
    found = next((verdict for verdict in chain if verdict is not None), None)
    if found is not None:
        return found
    if event.kind == COLLISION and _drives(ticks):
        return Verdict(EXPERT, f"text and odometry were right; the plan led into {event.detail}", _motion(ticks))
    return Verdict(UNEXPLAINED, "text, plan, command and motion agree with each other and with the shortest path")


def window(event: Event) -> tuple[int, int]:
    """Return the span whose ticks decide an event, ns: from the begin of a stop on, before any other event.

    The stop that only a new arming ends has no ticks after its begin. Of a stop before the first motion, the end
    decides: its begin waits for the first text.
    """
    if event.first:
        return max(event.begin_ns, event.end_ns - _BEFORE_NS), event.end_ns
    if event.kind == STOP and not event.final:
        return event.begin_ns, min(event.end_ns, event.begin_ns + _BEFORE_NS)
    return event.begin_ns - _BEFORE_NS, event.begin_ns


def decisive(flight: Flight, events: Sequence[Event]) -> Event | None:
    """Return the event that cost the run its goal.

    The fall; else the stop that only a new arming ends; else the stop or detour that took longest; else the first
    collision or the end itself. Of a run that reached its goal, the first collision.
    None without an event, and for a run of a robot, whose log does not say whether the goal was reached.
    """
    if not events or "end" not in flight.result:
        return None
    collision = next((event for event in events if event.kind == COLLISION), None)
    if flight.result["end"] == "reached":
        return collision
    if events[-1].kind == FALL:
        return events[-1]
    costly = [event for event in events if event.kind in (STOP, DETOUR)]
    longest = max(costly, key=lambda event: (event.final, event.seconds), default=None)
    return longest or collision or events[-1]


def _odometry(flight: Flight, tick: RecordedTick) -> Verdict | None:
    error = drift(flight, tick)
    if error is None or (error[0] < DRIFT_M and abs(error[1]) < DRIFT_RAD):
        return None
    numbers = f"error since the anchor: {error[0]:.2f} m, {math.degrees(error[1]):+.0f}°"
    return Verdict(ODOMETRY, "the robot was not where its odometry said, so the waypoints lay elsewhere", (numbers,))


def _person(flight: Flight, event: Event, ticks: Sequence[RecordedTick]) -> Verdict | None:
    """Judge a contact with a person: standing robot, late text, or a text that names no person."""
    if not _drives(ticks[-10:]):
        return Verdict(PERSON, "the robot stood; the person came to it", _motion(ticks[-10:]))
    generation = generation_of(flight, ticks[-1])
    truth = None if generation is None else flight.truth_at(generation.frames_ns[-1])
    if generation is None or truth is None:
        return None
    claimed = parse_text(generation.text).people
    ahead = people_ahead(truth, NEAR_M)
    age_s = (event.begin_ns - generation.frames_ns[-1]) / 1e9
    if ahead and not claimed:
        count = "1 person" if len(ahead) == 1 else f"{len(ahead)} people"
        numbers = f"{count} within {NEAR_M:g} m ahead, the nearest {ahead[0][0]:.1f} m away"
        hidden = ", possibly hidden" if truth.seen is None else ""
        because = f"the text names no person, and one was within {NEAR_M:g} m ahead{hidden}"
        return Verdict(REASONING, because, (numbers, _line(generation.text, "Motion")))
    if not ahead:
        numbers = f"nobody within {NEAR_M:g} m ahead {age_s:.1f} s before the contact"
        return Verdict(LATE, "the person came after the picture that the text describes", (numbers,))
    return None


def _texts(flight: Flight, event: Event, tick: RecordedTick) -> Verdict | None:
    """Judge the text in force at a tick; where a detour begins also its neighbours, and the first wrong one counts."""
    now = generation_of(flight, tick)
    if now is None:
        return None
    until_ns = event.begin_ns + _BEFORE_NS if event.kind == DETOUR else now.frames_ns[-1]
    since_ns = now.frames_ns[-1] - (_BEFORE_NS if event.kind == DETOUR else 0)
    judged = [each for each in flight.generations.values() if since_ns <= each.frames_ns[-1] <= until_ns]
    verdicts = (_text(flight, each) for each in sorted(judged, key=lambda each: each.number))
    return next((verdict for verdict in verdicts if verdict is not None), None)


def _text(flight: Flight, generation: RecordedGeneration) -> Verdict | None:
    """Judge a text against the shortest path at its anchor and against itself."""
    point = leading_waypoint(generation)
    route = flight.route_at(generation.frames_ns[-1])
    lines = (_line(generation.text, "Progress"), _line(generation.text, "Plan"))
    if point is None:
        return None
    if route is not None and route.route_bearing_rad is not None:
        waypoint_rad, route_rad = bearing_rad(point), route.route_bearing_rad
        if abs(wrap_angle(waypoint_rad - route_rad)) > WRONG_WAY_RAD:
            numbers = f"waypoints {_side(waypoint_rad)}, shortest path {_side(route_rad)}"
            because = _wrong_way(generation, waypoint_rad, route_rad)
            return Verdict(REASONING, because, (numbers, *lines), generation.number)
    plan = parse_text(generation.text).plan
    if plan is not None and isinstance(plan.action, Turn) and plan.action.distance_m <= 1:
        side = {LEFT: 1.0, RIGHT: -1.0}.get(plan.action.side, 0.0)
        last = (parse_waypoints(generation.text) or (point,))[-1]
        if side * bearing_rad(last) < -math.radians(20):
            return Verdict(REASONING, "the text contradicts itself: its plan and its waypoints turn to different sides",
                           (f"last waypoint {_side(bearing_rad(last))}", *lines), generation.number)  # fmt: skip
    return None


def _wrong_way(generation: RecordedGeneration, waypoint_rad: float, route_rad: float) -> str:
    """Return what the text got wrong about the route, for waypoints that lead elsewhere than the shortest path.

    `waypoint_rad`, `route_rad`: directions of both, seen from the robot at the anchor, left positive.
    """
    plan, turns = parse_text(generation.text).plan, abs(route_rad) >= _STRAIGHT_RAD
    if plan is None:
        return "the waypoints lead off the path to the goal, and the text states no plan"
    if isinstance(plan.action, Stop):
        onward = "still turns" if turns else "goes on"
        return f"the text ends the route too early: it plans to stop, and the path {onward}"
    if isinstance(plan.action, TurnBack):
        if abs(route_rad) > math.pi / 2:
            return "the text turns back, as the path does, and its waypoints lead off it"
        return "the text turns back, and the path goes on"
    if plan.action.side not in (LEFT, RIGHT):
        if not turns:
            return "the text goes straight on, as the path does, and its waypoints lead off it"
        return "the text goes straight on, and the path turns"
    if not turns:
        return "the text turns where the path goes straight on: too early, or into a wrong opening"
    side = 1 if plan.action.side == LEFT else -1
    if side * route_rad < 0:
        return "the text turns to the wrong side"
    if side * waypoint_rad > side * route_rad:
        return "the text turns too early or too far: the path turns less to that side"
    return "the text turns too late: the path turns to that side already"


def _plan_against_text(flight: Flight, ticks: Sequence[RecordedTick]) -> Verdict | None:
    """Judge the plans' ends against the waypoints at the same time, seen from the robot; most ticks must disagree."""
    judged, off, worst = 0, 0, ""
    for tick in ticks:
        generation = generation_of(flight, tick)
        if generation is None or tick.rows is None or len(tick.rows) < 3:
            continue
        point = waypoint_at(generation, tick.delay_s + 3.0)
        if point is None:
            continue
        there = tick.offset.inverse() @ SE2(*point, 0.0)
        planned = (float(tick.rows[2][0]), float(tick.rows[2][1]))
        judged += 1
        both = min(math.hypot(there.x_m, there.y_m), math.hypot(*planned)) > 0.5
        apart = abs(wrap_angle(bearing_rad((there.x_m, there.y_m)) - bearing_rad(planned))) if both else 0.0
        gap_m = math.hypot(there.x_m - planned[0], there.y_m - planned[1])
        if apart > OFF_TEXT_RAD or gap_m > OFF_TEXT_M:
            off += 1
            worst = worst or (
                f"at {flight.seconds(tick.now_ns):.1f} s the plan ends at ({planned[0]:.1f}, {planned[1]:.1f}) m, "
                f"the waypoints at ({there.x_m:.1f}, {there.y_m:.1f}) m"
            )
    if judged < 5 or off <= judged / 2:
        return None
    return Verdict(EXPERT, "the plan does not follow the text's waypoints", (f"{off} of {judged} plans apart", worst))


def _command(flight: Flight, ticks: Sequence[RecordedTick]) -> Verdict | None:
    """Judge the commands against the plans: most ticks that plan to drive must be held."""
    plans = [tick for tick in ticks if _planned_m(tick) >= GOES_M]
    held = [tick for tick in plans if _speed(tick.command) < HELD_SHARE * _planned_m(tick) and not _turns(tick)]
    if len(plans) < 5 or len(held) <= len(plans) / 2:
        return None
    return Verdict(LIMITED, f"the plan drives, the command does not: {_holder(flight, held)}",
                   (f"{len(held)} of {len(plans)} ticks held", *_motion(ticks)))  # fmt: skip


def _holder(flight: Flight, held: Sequence[RecordedTick]) -> str:
    """Return what held the commands: a fault, a recovery or the controller."""
    names = [tick.reason for tick in held if tick.reason != "ok"]
    if names:
        return max(set(names), key=names.count)
    faults = flight.faults_at(held[-1].now_ns)
    if held[-1].speed_scale < 1 and faults:
        return f"the supervisor's limit {held[-1].speed_scale:.0%} for {faults[-1]}"
    return "the controller's limits or slew"


def _execution(flight: Flight, ticks: Sequence[RecordedTick]) -> Verdict | None:
    """Judge the motion against the commands over the span; short of LAG_SHARE of the way, the robot did not follow."""
    asked_m = sum(_speed(tick.command) * 0.1 for tick in ticks)
    if asked_m < 0.2 or ticks[0].pose is None or ticks[-1].pose is None:
        return None
    then, now = flight.truth_at(ticks[0].now_ns), flight.truth_at(ticks[-1].now_ns)
    true = then is not None and now is not None
    step = then.T_world_base.inverse() @ now.T_world_base if then is not None and now is not None else (
        ticks[0].pose.inverse() @ ticks[-1].pose
    )  # fmt: skip
    went_m = math.hypot(step.x_m, step.y_m)
    if went_m >= LAG_SHARE * asked_m or abs(step.theta_rad) > math.radians(60):
        return None
    touching = sorted({name for truth in (then, now) if truth is not None for name in truth.touching})
    blocked = f"blocked by {', '.join(touching)}" if touching else "blocked, slipping or lagging"
    source = "true" if true else "by odometry"
    return Verdict(EXECUTION, f"the robot did not do as commanded: {blocked}",
                   (f"{asked_m:.2f} m commanded, {went_m:.2f} m driven ({source})",))  # fmt: skip


def _final_stop(flight: Flight) -> Verdict:
    """Name what stopped the robot until a new arming: the fault, or the first line of the result."""
    fault, lines = flight.stop_fault, flight.result_faults
    if fault is not None:
        return Verdict(LIMITED, f"stopped until a new arming: {fault.name}", (fault.detail, *lines))
    if lines:
        return Verdict(LIMITED, lines[0], lines[1:])
    return Verdict(LIMITED, "control ended before the episode did, and the log names no fault")


def _of_stop(flight: Flight, event: Event, ticks: Sequence[RecordedTick]) -> Verdict:
    """Judge a stop backwards: was it commanded, by whom, and did plan and text ask for it?"""
    return (
        _arrival(flight, event)
        or _execution(flight, ticks)
        or _command(flight, ticks)
        or _standing_plan(flight, ticks)
        or Verdict(UNEXPLAINED, f"the robot stood: {event.detail}", _motion(ticks))
    )


def _arrival(flight: Flight, event: Event) -> Verdict | None:
    """Judge a stop that was mostly held at the place where the texts mean to stop."""
    ticks = flight.ticks_between(event.begin_ns, event.end_ns)
    held = [tick for tick in ticks if tick.reason == HELD_AT_STOP]
    if len(held) <= len(ticks) / 2:
        return None
    return _text_stops(flight, event.begin_ns, generation_of(flight, held[0]))


def _text_stops(flight: Flight, at_ns: int, generation: RecordedGeneration | None) -> Verdict:
    """Judge a stop that the text plans: at the goal or before it."""
    truth = flight.route_at(at_ns)
    lines = () if generation is None else (_line(generation.text, "Progress"), _line(generation.text, "Plan"))
    if truth is not None and truth.route_m is not None and truth.route_m > GOAL_M:
        return Verdict(REASONING, "the text ends the route before the goal", (f"{truth.route_m:.1f} m before", *lines))
    return Verdict(ARRIVED, "the robot stands where the texts mean to stop", lines)


def _standing_plan(flight: Flight, ticks: Sequence[RecordedTick]) -> Verdict | None:
    """Judge a stop that the plan itself made: as the text asks, or against it."""
    tick = ticks[len(ticks) // 2]
    generation = generation_of(flight, tick)
    if generation is None:
        return Verdict(LIMITED, "there was no semantic state to drive by", (tick.reason,))
    if tick.rows is None:
        return Verdict(LIMITED, f"there was no plan: {tick.reason}")
    if tick.reason != "ok":
        return Verdict(LIMITED, f"the robot was held: {tick.reason}", _motion(ticks))
    parts, point = parse_text(generation.text), leading_waypoint(generation)
    lines = (_line(generation.text, "Motion"), _line(generation.text, "Plan"))
    waits = parts.plan is not None and parts.plan.waits
    truth = flight.truth_at(generation.frames_ns[-1])
    if waits and truth is not None and not people_ahead(truth, 2 * NEAR_M):
        return Verdict(REASONING, "the text waits for a person, and nobody is there", lines)
    if waits:
        return Verdict(PERSON, "the text lets a person pass", lines)
    if parts.plan is not None and isinstance(parts.plan.action, Stop) and parts.plan.action.distance_m == 0:
        return _text_stops(flight, tick.now_ns, generation)
    if point is None:
        left = "" if truth is None or truth.route_m is None else f"{truth.route_m:.1f} m from the goal"
        return Verdict(REASONING, "the text's waypoints stay where the robot is: it means to be there", (*lines, left))
    return Verdict(EXPERT, "the text goes on, the plan stands", (*lines, f"plan of 1 s: {_planned_m(tick):.2f} m"))


def _planned_m(tick: RecordedTick) -> float:
    """Return the length of the plan's first second, m; 0 without a finite plan."""
    if tick.rows is None or not len(tick.rows):
        return 0.0
    length_m = math.hypot(float(tick.rows[0][0]), float(tick.rows[0][1]))
    return length_m if math.isfinite(length_m) else 0.0


def _speed(velocity: tuple[float, float, float]) -> float:
    return math.hypot(velocity[0], velocity[1])


def _turns(tick: RecordedTick) -> bool:
    return abs(tick.command[2]) > 0.2


def _drives(ticks: Sequence[RecordedTick]) -> bool:
    return any(_speed(tick.command) > 0.1 or _turns(tick) for tick in ticks)


def _motion(ticks: Sequence[RecordedTick]) -> tuple[str, ...]:
    count = max(1, len(ticks))
    planned = sum(_planned_m(tick) for tick in ticks) / count
    commanded = sum(_speed(tick.command) for tick in ticks) / count
    return (f"mean planned {planned:.2f} m/s, commanded {commanded:.2f} m/s",)


def _line(text: str, head: str) -> str:
    """Return the text's line of that head, or that it has none; at most 100 characters."""
    return next((line[:100] for line in text.splitlines() if line.startswith(head)), f"no line {head}")


def _side(angle_rad: float) -> str:
    degrees = math.degrees(angle_rad)
    return "straight ahead" if abs(degrees) < 10 else f"{abs(degrees):.0f}° {'left' if degrees > 0 else 'right'}"
