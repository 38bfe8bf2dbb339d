"""Rules that constrain decoding: progress that follows the text before, a turn that only comes nearer."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.geometry import SE2, wrap_angle
from edge.reasoning.decoding_rules import (
    MAX_OBSERVATIONS,
    MAX_REFUSALS,
    SECOND_NS,
    TurnDistances,
    TurnEstimator,
    TurnObservation,
    limit_distance,
    observed_turn,
)
from edge.state.reasoning_text import AHEAD, Plan, Progress, Stop, Turn, TurnBack
from edge.state.ring import EncodedFrame
from tools.train.drives.trace_sentences import plan_metres

HERE = SE2(0.0, 0.0, 0.0)
SIDES = st.sampled_from(["left", "right"])
KINDS = st.sampled_from(["room", "corridor", "crossing"])


# A plan


def plan(side: str, area: str, metres: float) -> Plan:
    return Plan(Turn(side, area, plan_metres(metres)))


@given(SIDES, KINDS, st.floats(0.0, 30.0))
def test_a_planned_turn_is_an_observation_of_it(side: str, kind: str, metres: float) -> None:
    expected = TurnObservation(side, 0.0 if metres < 1.0 else float(round(metres)))
    assert observed_turn(plan(side, kind, metres)) == expected


@pytest.mark.parametrize("other", [None, Plan(Stop(3)), Plan(Stop(0), waits=True), Plan(TurnBack())])
def test_other_plans_observe_no_turn(other: Plan | None) -> None:
    assert observed_turn(other) is None


@given(SIDES, KINDS, st.floats(0.0, 30.0), st.lists(st.floats(-5.0, 30.0), min_size=1, max_size=4))
def test_a_turn_only_ever_comes_nearer(side: str, kind: str, metres: float, distances_m: list[float]) -> None:
    before = plan(side, kind, metres)
    after = limit_distance(before, TurnDistances(side, tuple(distances_m)))
    assert isinstance(before.action, Turn) and isinstance(after.action, Turn)
    assert (after.action.side, after.action.area) == (side, kind)
    assert after.action.distance_m <= before.action.distance_m


@pytest.mark.parametrize(
    ("planned_m", "side", "distances_m", "limited_m"),
    [
        (6, "left", (3.0, 3.2, 2.9, 3.1), 3),
        (6, "left", (0.4, 0.2, 0.9, 7.0), 0),
        (6, "left", (5.9, 6.3, 6.1), 6),
        (2, "left", (6.0, 6.0, 6.0, 6.0), 2),
        (5, "left", (3.0,), 4),
        (0, "left", (3.0, 3.0), 0),
        (6, "right", (1.0, 1.0, 1.0), 6),
    ],
)
def test_the_median_of_all_observations_to_its_side_limits_the_distance(
    planned_m: int, side: str, distances_m: tuple[float, ...], limited_m: int
) -> None:
    limited = limit_distance(plan("left", "corridor", planned_m), TurnDistances(side, distances_m))
    assert limited == plan("left", "corridor", limited_m)


# Estimated turns

PROGRESS = Progress(1, 2, 0)
NEXT = Progress(2, 2, 0)


def observe(
    estimator: TurnEstimator, progress: Progress | None, turn: TurnObservation | None, pose: SE2 = HERE, *,
    second: float = 0.0, overruled: bool = False, claimed: bool = False,
) -> None:  # fmt: skip
    frame = EncodedFrame(round(second * SECOND_NS), pose, np.zeros(1, np.float32))
    estimator.update(progress, turn, frame, overruled=overruled, claimed=claimed)


def rotate(estimator: TurnEstimator, degrees: Sequence[float], second: float = 0.0) -> float:
    """Put headings 0.1 s apart; return the time after them, s."""
    for number, heading in enumerate(degrees):
        pose = SE2(0.0, 0.0, wrap_angle(math.radians(heading)))
        estimator.put(round((second + number / 10) * SECOND_NS), pose)
    return second + len(degrees) / 10


def before_turn(side: str = "left", heading: float = 0.0) -> TurnEstimator:
    """Return the estimator of a robot that has driven straight on for 2 s and whose text has just named a turn."""
    estimator = TurnEstimator()
    assert estimator.distances(HERE) is None
    rotate(estimator, [heading] * 20)
    observe(estimator, PROGRESS, TurnObservation(side, 6.0), second=1.9)
    return estimator


@pytest.mark.parametrize(
    ("at", "here", "left_m"),
    [
        (SE2(1.0, 2.0, math.pi / 2), SE2(1.0, 4.5, math.pi / 2), 3.5),
        (HERE, SE2(-2.0, 0.0, 0.0), 8.0),
        (SE2(0.0, 0.0, math.pi - 0.1), SE2(0.0, 0.0, 0.1 - math.pi), 6.0),
        (HERE, SE2(2.0, 0.0, math.radians(30)), 4.0),
        (HERE, SE2(6.9, 0.0, 0.0), -0.9),
    ],
    ids=["driven on", "driven back", "beside the cut of angles", "heading aside", "a little past it"],
)
def test_the_remaining_distance_shrinks_by_the_driven_distance(at: SE2, here: SE2, left_m: float) -> None:
    estimator = TurnEstimator()
    observe(estimator, PROGRESS, TurnObservation("left", 6.0), at)
    left = estimator.distances(here)
    assert left is not None and left.side == "left" and left.distances_m == pytest.approx([left_m])


@pytest.mark.parametrize(
    "here", [SE2(2.0, 0.0, math.radians(50)), SE2(2.0, 0.0, -math.radians(50)), SE2(7.1, 0.0, 0.0)]
)
def test_an_observation_from_another_leg_or_of_a_passed_turn_is_dropped(here: SE2) -> None:
    estimator = before_turn()
    assert estimator.distances(here) is None
    observe(estimator, PROGRESS, TurnObservation("left", 3.0), here)
    left = estimator.distances(here)
    assert left is not None and left.distances_m == pytest.approx([3.0])


def test_the_last_observations_count() -> None:
    estimator = TurnEstimator()
    for metres in range(20):
        observe(estimator, PROGRESS, TurnObservation("left", float(metres)))
    last_m = tuple(float(metres) for metres in range(20 - MAX_OBSERVATIONS, 20))
    assert estimator.distances(HERE) == TurnDistances("left", last_m)


@pytest.mark.parametrize(
    ("progress", "turn", "overruled", "expected"),
    [
        (PROGRESS, TurnObservation("right", 3.0), False, TurnDistances("right", (3.0,))),
        (Progress(1, 2, 1), TurnObservation("left", 3.0), False, TurnDistances("left", (3.0,))),
        (PROGRESS, None, False, None),
        (None, TurnObservation("left", 3.0), False, None),
        (PROGRESS, TurnObservation(AHEAD, 3.0), False, None),
        (PROGRESS, TurnObservation("right", 2.0), True, TurnDistances("left", (6.0,))),
        (NEXT, TurnObservation("left", 8.0), True, None),
        (Progress(1, 2, 1), TurnObservation("left", 8.0), True, None),
    ],
    ids=["another side", "another opening", "no turn", "no progress", "straight on", "overruled", "next", "passed"],
)
def test_observations_are_of_one_turn(
    progress: Progress | None, turn: TurnObservation | None, overruled: bool, expected: TurnDistances | None
) -> None:
    estimator = before_turn()
    observe(estimator, progress, turn, overruled=overruled)
    assert estimator.distances(HERE) == expected


STRAIGHT, SWAY = [0.0] * 30, [-13.0, -13.0, 0.0, 13.0, 13.0, 0.0, 0.0]
SLOWLY = [3.0 * n for n in range(31)]


@pytest.mark.parametrize("from_degrees", [0.0, 170.0, -100.0])
@pytest.mark.parametrize(
    ("side", "degrees", "done"),
    [
        ("left", SLOWLY[:10], True),
        ("left", SLOWLY[:8], False),
        ("right", SLOWLY, False),
        ("left", STRAIGHT, False),
        ("left", [*SWAY, *SWAY], False),
        ("left", [*SLOWLY[:12], *SLOWLY[11::-1]], False),
        ("left", [*SLOWLY[:20], *SLOWLY[19::-1]], True),
    ],
    ids=["turns", "begins to", "turns the other way", "goes straight", "sways", "makes way", "turned, and back"],
)
def test_a_turn_may_be_done_once_the_robot_has_turned_that_way(
    side: str, degrees: list[float], done: bool, from_degrees: float
) -> None:
    estimator = before_turn(side, from_degrees)
    rotate(estimator, [from_degrees + heading for heading in degrees], second=2.0)
    assert estimator.may_be_done == done
    mirrored = before_turn({"left": "right", "right": "left"}[side], from_degrees)
    rotate(mirrored, [from_degrees - heading for heading in degrees], second=2.0)
    assert mirrored.may_be_done == done


@pytest.mark.parametrize("turn", [None, TurnObservation(AHEAD, 4.0)])
def test_without_a_side_a_turn_may_always_be_done(turn: TurnObservation | None) -> None:
    estimator = TurnEstimator()
    observe(estimator, PROGRESS, turn)
    assert estimator.may_be_done


@pytest.mark.parametrize("side", ["right", AHEAD])
def test_the_side_is_the_one_that_most_texts_name(side: str) -> None:
    estimator = before_turn("left")
    observe(estimator, PROGRESS, TurnObservation(side, 4.0))
    assert estimator.may_be_done
    observe(estimator, PROGRESS, TurnObservation("left", 4.0))
    assert not estimator.may_be_done
    rotate(estimator, [-heading for heading in SLOWLY], second=2.0)
    assert not estimator.may_be_done
    for _ in range(2):
        observe(estimator, PROGRESS, TurnObservation(side, 4.0))
    assert estimator.may_be_done


def test_a_side_misread_from_afar_is_forgotten() -> None:
    estimator = TurnEstimator()
    rotate(estimator, [0.0] * 20)
    for side in ["right"] * 20 + ["left"] * 9:
        observe(estimator, PROGRESS, TurnObservation(side, 6.0), second=1.9)
    rotate(estimator, SLOWLY, second=2.0)
    assert estimator.may_be_done


@pytest.mark.parametrize("sides", [[], ["right"], ["right", "right"]], ids=["as said", "a tie", "misread"])
def test_the_rest_of_a_turn_is_not_the_next_one_to_the_same_side(sides: list[str]) -> None:
    estimator = before_turn()
    for side in sides:
        observe(estimator, PROGRESS, TurnObservation(side, 6.0), second=1.9)
    second = rotate(estimator, SLOWLY[:18], second=2.0)
    observe(estimator, NEXT, TurnObservation("left", 6.0), second=second - 0.1)
    second = rotate(estimator, [*SLOWLY[18:], *[90.0] * 20], second=second)
    assert not estimator.may_be_done
    rotate(estimator, [90.0 + heading for heading in SLOWLY[:10]], second=second)
    assert estimator.may_be_done


def test_two_turns_to_the_same_side_without_a_pause_are_both_made() -> None:
    """Round the end of a rack; the second turn was refused before until its text had claimed it six times."""
    estimator = before_turn()
    second = rotate(estimator, SLOWLY[:18], second=2.0)
    observe(estimator, NEXT, TurnObservation("left", 2.0), second=second - 0.1)
    second = rotate(estimator, [54.0 + heading for heading in SLOWLY[:24]], second=second)
    assert not estimator.may_be_done
    rotate(estimator, [126.0 + heading for heading in SLOWLY[:18]], second=second)
    assert estimator.may_be_done


@pytest.mark.parametrize(("side", "sign"), [("left", 1), ("right", -1)])
def test_the_next_turn_may_begin_as_soon_as_it_is_named(side: str, sign: int) -> None:
    """To the same side once the turn before has ended, to the other side at once."""
    estimator = before_turn()
    second = rotate(estimator, [*SLOWLY, *([90.0] * 30 if sign > 0 else [])], second=2.0)
    observe(estimator, NEXT, TurnObservation(side, 1.0), second=second - (0.3 if sign > 0 else 0.1))
    if sign < 0:
        assert not estimator.may_be_done
    rotate(estimator, [90.0 + sign * heading for heading in SLOWLY[:10]], second=second)
    assert estimator.may_be_done


def test_a_turn_may_begin_a_little_before_the_text_names_it_as_next() -> None:
    estimator = before_turn("right")
    second = rotate(estimator, SLOWLY[:10], second=7.0)
    observe(estimator, NEXT, TurnObservation("left", 1.0), second=second + 1.0)
    assert estimator.may_be_done


def test_a_turn_that_was_made_need_not_be_made_again() -> None:
    estimator = before_turn()
    rotate(estimator, SLOWLY, second=2.0)
    observe(estimator, NEXT, TurnObservation("right", 6.0), second=6.0)
    observe(estimator, PROGRESS, TurnObservation("left", 1.0), second=12.0)
    assert estimator.may_be_done


def test_poses_that_come_again_change_nothing() -> None:
    estimator = before_turn()
    for _ in range(3):
        rotate(estimator, [-90.0] * 20)
    assert not estimator.may_be_done


def test_a_turn_that_is_claimed_again_and_again_counts_as_done() -> None:
    estimator = before_turn()
    for _ in range(MAX_REFUSALS - 1):
        observe(estimator, PROGRESS, None, overruled=True, claimed=True)
    observe(estimator, PROGRESS, TurnObservation("left", 3.0))
    for _ in range(MAX_REFUSALS):
        assert not estimator.may_be_done
        observe(estimator, PROGRESS, None, overruled=True, claimed=True)
    assert estimator.may_be_done
    observe(estimator, PROGRESS, TurnObservation("left", 3.0))
    assert estimator.may_be_done


def test_another_progress_that_is_overruled_claims_no_turn() -> None:
    estimator = before_turn()
    for _ in range(2 * MAX_REFUSALS):
        observe(estimator, PROGRESS, None, overruled=True)
    assert not estimator.may_be_done
