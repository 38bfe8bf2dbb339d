"""Whose fault it was: a flight in which one link of the chain fails is explained by that link."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from edge.core.geometry import SE2
from edge.flightlog.explain.events import COLLISION, DETOUR, STOP, TIMEOUT, find_events
from edge.flightlog.explain.explanation import deciding, explain
from edge.flightlog.explain.flight import FaultSpan, Flight, Truth
from edge.flightlog.explain.verdict import (
    ARRIVED,
    EXECUTION,
    EXPERT,
    LATE,
    LIMITED,
    ODOMETRY,
    PERSON,
    REASONING,
    UNEXPLAINED,
    Verdict,
)
from edge.flightlog.replay.records import RecordedTick
from tests.support.runner import explained_flights as flights
from tests.support.runner.explained_flights import SPEED_MPS, STRAIGHT, TEXT, TURN_LEFT, at

TOUCH_S = 10.0
LEAN_LEFT = "waypoints: (1.5, 0.7) (2.5, 1.5) (3.5, 2.2)"
SHARP_LEFT = "waypoints: (0.5, 2.8) (0.6, 4.0) (0.6, 5.0)"
"""Waypoints 80° left."""
SHARP_RIGHT = "waypoints: (0.5, -2.8) (0.6, -4.0) (0.6, -5.0)"


def only(flight: Flight, kind: str) -> Verdict:
    """The verdict of the flight's only event of a kind."""
    (found,) = [each for each in explain(flight) if each.event.kind == kind]
    return found.verdict


def touched(name: str, **changes: object) -> object:
    """Truths with a contact at TOUCH_S."""

    def at_second(second: float) -> Truth:
        touching = (name,) if 0 <= second - TOUCH_S < 0.3 else ()
        return replace(flights.truth(second), touching=touching, **changes)  # type: ignore[arg-type]

    return at_second


def stopped(second: float, **changes: object) -> RecordedTick:
    """A tick of a robot that stands from 10 to 14 s."""
    way_s = min(second, 10.0) if second < 14 else second - 4.0
    state = {"pose": SE2(SPEED_MPS * way_s, 0.0, 0.0)}
    return flights.tick(second, **state, **(changes if 10 <= second < 14 else {}))


def standing_truth(second: float) -> Truth:
    way_s = min(second, 10.0) if second < 14 else second - 4.0
    return flights.truth(second, T_world_base=SE2(SPEED_MPS * way_s, 0.0, 0.0), route_m=30 - SPEED_MPS * way_s)


def test_a_flight_without_a_fault_has_no_event() -> None:
    assert find_events(flights.flight()) == []


def test_a_contact_with_an_object_on_a_right_text_is_the_action_experts() -> None:
    flight = flights.flight(truths=touched("plant"))  # type: ignore[arg-type]
    verdict = only(flight, COLLISION)
    assert (verdict.cause, "plant" in verdict.because) == (EXPERT, True)


def test_odometry_that_has_slipped_comes_before_the_text() -> None:
    def slipped(second: float) -> Truth:
        off_m = 0.0 if second < 9.2 else 0.8
        return replace(touched("plant")(second), T_world_base=SE2(SPEED_MPS * second, off_m, 0.0))  # type: ignore[operator]

    assert only(flights.flight(truths=slipped), COLLISION).cause == ODOMETRY


@pytest.mark.parametrize(
    ("person_at", "cause"),
    [
        ((SPEED_MPS * 9.0 + 2.0, 0.3), REASONING),  # 2 m ahead in the picture of 9 s, and the text says nobody is near
        ((50.0, 0.0), LATE),  # nobody in that picture
        ((SPEED_MPS * 9.0 - 2.0, 0.0), LATE),  # behind the robot
    ],
)
def test_a_contact_with_a_person_asks_whether_the_picture_showed_one(
    person_at: tuple[float, float], cause: str
) -> None:
    flight = flights.flight(truths=touched("person", people=(person_at,)))  # type: ignore[arg-type]
    assert only(flight, COLLISION).cause == cause


def test_a_person_whom_a_wall_may_hide_is_not_said_to_be_in_the_picture() -> None:
    """An older truth has places of people, and no walls."""
    person = (SPEED_MPS * 9.0 + 2.0, 0.3)
    flight = flights.flight(truths=touched("person", people=(person,)))  # type: ignore[arg-type]
    (found,) = explain(flight)
    assert found.verdict.because == "the text names no person, and one was within 3 m ahead, possibly hidden"
    assert found.verdict.evidence[0] == "1 person within 3 m ahead, the nearest 2.0 m away"
    saw = dict(found.steps)["The camera saw"]
    assert "in truth 1 person within 6 m ahead, possibly hidden, the nearest at 2.0 m" in saw


@pytest.mark.parametrize(("seen", "cause"), [(True, REASONING), (False, LATE)])
def test_a_text_need_not_name_a_person_whom_a_solid_hides(seen: bool, cause: str) -> None:
    person = (SPEED_MPS * 9.0 + 2.0, 0.3)
    flight = flights.flight(truths=touched("person", people=(person,), seen=(seen,)))  # type: ignore[arg-type]
    assert only(flight, COLLISION).cause == cause
    (found,) = explain(flight)
    assert "hidden" not in found.verdict.because + dict(found.steps)["The camera saw"]


def test_a_contact_with_a_person_whom_the_text_named_is_the_action_experts_whatever_the_route() -> None:
    person, named = (SPEED_MPS * 9.0 + 2.0, 0.3), TEXT.replace("nobody near", "person ahead 2 m standing")
    truths = touched("person", people=(person,), route_bearing_rad=1.5)
    flight = flights.flight(truths=truths, texts=lambda _: named)  # type: ignore[arg-type]
    assert only(flight, COLLISION).cause == EXPERT


def test_a_person_who_walks_into_a_standing_robot_is_the_cause() -> None:
    def still(second: float) -> RecordedTick:
        return flights.tick(second, command=(0.0, 0.0, 0.0))

    assert only(flights.flight(ticks=still, truths=touched("person")), COLLISION).cause == PERSON  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("plan", "waypoints", "route_rad", "because"),
    [
        ("stop in 9 m", STRAIGHT, 1.3, "plans to stop, and the path still turns"),
        ("stop in 9 m", TURN_LEFT, 0.0, "plans to stop, and the path goes on"),
        ("go straight to the room in 9 m", STRAIGHT, 1.3, "goes straight on, and the path turns"),
        ("go straight to the room in 9 m", TURN_LEFT, 0.0, "its waypoints lead off it"),
        ("turn left into the room in 9 m", STRAIGHT, 1.3, "turns too late"),
        ("turn right into the room in 9 m", STRAIGHT, 1.3, "wrong side"),
        ("turn left into the room in 1 m", TURN_LEFT, 0.0, "wrong opening"),
        ("turn left into the room in 1 m", SHARP_LEFT, math.radians(30), "turns too early or too far"),
        ("turn right into the room in 1 m", SHARP_RIGHT, math.radians(-30), "turns too early or too far"),
        ("turn left into the room in 1 m", SHARP_RIGHT, math.radians(30), "turns too late"),
        ("turn back", STRAIGHT, 1.3, "turns back, and the path goes on"),
        ("turn back", STRAIGHT, 3.0, "turns back, as the path does, and its waypoints lead off it"),
    ],
)
def test_a_detour_on_waypoints_off_the_shortest_path_is_the_texts(
    plan: str, waypoints: str, route_rad: float, because: str
) -> None:
    text = f"Motion: nobody near.\nPlan: {plan}.\n{waypoints}"

    def away(second: float) -> Truth:
        turned = second >= 10
        route_m = 25.0 + (second - 10) * SPEED_MPS if turned else 30.0 - SPEED_MPS * second
        return flights.truth(second, route_m=route_m, route_bearing_rad=route_rad if second >= 9 else 0.0)

    verdict = only(flights.flight(texts=lambda n: text if n >= 5 else TEXT, truths=away), DETOUR)
    assert (verdict.cause, because in verdict.because) == (REASONING, True)


def test_a_text_that_contradicts_itself_is_the_one_that_is_shown() -> None:
    """The text in force where the detour begins is right; the one 2 s before it is not."""
    wrong = f"Motion: nobody near.\nPlan: turn right into the room in 1 m.\n{LEAN_LEFT}"

    def away(second: float) -> Truth:
        route_m = 30.0 - SPEED_MPS * second if second < 10 else 25.0 + (second - 10) * SPEED_MPS
        return flights.truth(second, route_m=route_m)

    flight = flights.flight(texts=lambda n: wrong if n == 4 else TEXT, truths=away)
    (found,) = [each for each in explain(flight) if each.event.kind == DETOUR]
    assert found.verdict.because.startswith("the text contradicts itself")
    assert (found.verdict.generation, found.generation, found.text) == (4, 4, wrong)


def test_a_plan_that_leaves_the_waypoints_is_the_action_experts() -> None:
    def veers(second: float) -> RecordedTick:
        rows = np.array([[0.5, 0.0, 0.0], [0.8, 0.5, 1.2], [0.9, 1.2, 1.5]])
        return flights.tick(second, rows=rows) if second > 6 else flights.tick(second)

    verdict = only(flights.flight(ticks=veers, truths=touched("plant")), COLLISION)  # type: ignore[arg-type]
    assert (verdict.cause, verdict.because) == (EXPERT, "the plan does not follow the text's waypoints")


def test_a_stop_by_a_fault_names_the_fault() -> None:
    flight = flights.flight(
        ticks=lambda s: stopped(s, command=(0.0, 0.0, 0.0), reason="camera-frozen"), truths=standing_truth
    )
    verdict = only(flight, STOP)
    assert (verdict.cause, "camera-frozen" in verdict.because) == (LIMITED, True)


def test_a_stop_under_the_supervisors_limit_names_the_fault_that_is_present() -> None:
    ticks = flights.flight(
        ticks=lambda s: stopped(s, command=(0.0, 0.0, 0.0), speed_scale=0.5), truths=standing_truth,
        faults=[FaultSpan("too-hot", "96 °C", at(9.0), at(15.0))],
    )  # fmt: skip
    assert "too-hot" in only(ticks, STOP).because


def test_a_robot_that_is_commanded_and_stands_is_blocked() -> None:
    verdict = only(flights.flight(ticks=lambda s: stopped(s), truths=standing_truth), STOP)
    assert (verdict.cause, "m driven (true)" in verdict.evidence[0]) == (EXECUTION, True)


@pytest.mark.parametrize(
    ("plan", "waypoints", "cause"),
    [
        ("stop now", "waypoints: (0.1, 0.0) (0.1, 0.0) (0.1, 0.0)", REASONING),
        ("wait, then stop in 9 m", STRAIGHT, REASONING),  # nobody is there to wait for
        ("stop in 9 m", STRAIGHT, EXPERT),
    ],
)
def test_a_stop_that_the_plan_makes_is_judged_by_the_text(plan: str, waypoints: str, cause: str) -> None:
    rows = np.zeros((3, 3))
    flight = flights.flight(
        ticks=lambda s: stopped(s, command=(0.0, 0.0, 0.0), rows=rows), truths=standing_truth,
        texts=lambda n: f"Motion: nobody near.\nPlan: {plan}.\n{waypoints}" if n >= 5 else TEXT,
    )  # fmt: skip
    assert only(flight, STOP).cause == cause


@pytest.mark.parametrize(("route_m", "cause"), [(1.0, ARRIVED), (8.0, REASONING)])
@pytest.mark.parametrize(("reason", "plan"), [("arrived", "stop in 9 m"), ("ok", "stop now")])
def test_a_stop_where_the_texts_mean_to_stop_is_judged_by_the_goal(
    reason: str, plan: str, route_m: float, cause: str
) -> None:
    flight = flights.flight(
        ticks=lambda s: stopped(s, command=(0.0, 0.0, 0.0), rows=np.zeros((3, 3)), reason=reason),
        truths=lambda s: replace(standing_truth(s), route_m=route_m),
        texts=lambda _: TEXT.replace("stop in 9 m", plan),
    )
    assert only(flight, STOP).cause == cause


def test_a_robots_log_has_no_decisive_event_because_it_does_not_know_the_goal() -> None:
    flight = flights.flight(ticks=lambda s: stopped(s, command=(0.0, 0.0, 0.0)), truths=None)
    found = explain(flight)
    assert found and deciding(flight, found) is None


@pytest.mark.parametrize("pose", [SE2(1.0, 0.0, 0.0), None], ids=["odometry", "no odometry"])
def test_a_robot_that_never_moves_stands_from_the_first_tick_on(pose: SE2 | None) -> None:
    def still(second: float) -> RecordedTick:
        return flights.tick(second, pose=pose, command=(0.0, 0.0, 0.0), reason="no-token" if second < 9 else "too-hot")

    (found,) = explain(flights.flight(ticks=still, truths=None))
    assert (found.event.kind, found.at_s) == (STOP, 0.0)
    assert found.event.detail == "19.9 s, mostly too-hot; the robot never moved"
    assert "too-hot" in found.verdict.because, "the end decides, not the wait for the first text"


def test_a_stop_before_the_first_motion_says_so() -> None:
    def late(second: float) -> RecordedTick:
        return flights.tick(second, pose=SE2(SPEED_MPS * max(second - 5.0, 0.0), 0.0, 0.0))

    (event,) = find_events(flights.flight(ticks=late, truths=None))
    assert event.first and event.begin_ns == at(0.0) and event.detail.endswith("before it first moved")


def round_trip(second: float) -> RecordedTick:
    angle = second / 20 * 2 * np.pi
    return flights.tick(second, pose=SE2(2 * np.sin(angle), 2 - 2 * np.cos(angle), angle))


def test_without_truth_a_flight_knows_stops_and_loops_but_no_contacts() -> None:
    flight = flights.flight(ticks=round_trip, truths=None)
    assert [event.kind for event in find_events(flight)] == [DETOUR]


def test_a_path_that_a_new_instruction_leads_back_is_no_detour() -> None:
    flight = flights.flight(ticks=round_trip, truths=None)
    new = {n: replace(each, instruction="come back" if n >= 5 else None) for n, each in flight.generations.items()}
    flight = replace(flight, generations=new)
    assert flight.new_instructions == [(at(10.0), "come back")]
    assert find_events(flight) == []


def test_the_rest_of_an_instruction_after_the_turn_that_it_begins_with_is_no_new_one() -> None:
    flight = flights.flight()
    told = {n: replace(each, instruction="Leave the room.") for n, each in flight.generations.items()}
    flight = replace(flight, instruction="Turn around, leave the room.", generations=told)
    assert flight.new_instructions == []
    later = {n: each if n < 5 else replace(each, instruction="come back") for n, each in told.items()}
    assert replace(flight, generations=later).new_instructions == [(at(10.0), "come back")]


def test_a_timeout_is_explained_by_the_event_that_took_longest() -> None:
    flight = flights.flight(
        ticks=lambda s: stopped(s, command=(0.0, 0.0, 0.0), reason="reasoning"), truths=standing_truth,
        result={"end": "timeout", "ne_m": 9.0},
    )  # fmt: skip
    found = explain(flight)
    assert [each.event.kind for each in found] == [STOP, TIMEOUT]
    assert found[1].refers and found[1].verdict.cause == LIMITED
    assert deciding(flight, found) is found[0]


def test_a_timeout_after_a_collision_alone_does_not_say_that_the_collision_took_the_time() -> None:
    flight = flights.flight(truths=touched("plant"), result={"end": "timeout", "ne_m": 9.0})  # type: ignore[arg-type]
    found = explain(flight)
    assert [each.event.kind for each in found] == [COLLISION, TIMEOUT]
    because = found[1].verdict.because
    assert because.startswith("no stop or detour came before it; the first collision, at 10 s (plant): text and")


def test_what_no_rule_explains_says_so() -> None:
    flight = flights.flight(result={"end": "timeout"})
    assert [each.verdict.cause for each in explain(flight)] == [UNEXPLAINED]


def test_every_explanation_answers_the_six_questions() -> None:
    flight = flights.flight(truths=touched("plant"))  # type: ignore[arg-type]
    steps = dict(explain(flight)[0].steps)
    assert list(steps) == [
        "The camera saw", "The text claimed", "Its waypoints, m at 3, 6, 9 s", "The action expert planned", "Commanded",
        "The robot did",
    ]  # fmt: skip
    assert "1.50 m" in steps["The robot did"] and "nobody near" in steps["The text claimed"]
