"""Where texts plan to stop: which of them place it, when the robot has arrived, and what lets it drive on."""

from __future__ import annotations

import math

import pytest

from edge.core.geometry import SE2
from edge.motion.recovery import ARRIVED, ASIDE_M, PASSED_M, SHORT_M, has_arrived
from edge.reasoning.instruction_state import AGREEING_TEXTS, CONTRADICTING_TEXTS, StopEstimator
from edge.state.reasoning_text import parse_text
from tests.support.runner.control_bench import Bench

INSTRUCTION = "Walk down the corridor and stop at the Vending Machine."
AT_GOAL = SE2(24.0, 0.0, 0.0)


def text(
    plan: str = "stop in 2 m", objects: str = "vending machine left 2 m, exit door ahead 5 m",
    progress: str = "last leg of 0, passed 0",
) -> str:  # fmt: skip
    return f"Situation: in a corridor.\nObjects: {objects}.\nMotion: nobody near.\nProgress: {progress}.\nPlan: {plan}."


def read(arrival: StopEstimator, line: str, x_m: float, y_m: float = 0.0, theta_rad: float = 0.0) -> SE2 | None:
    arrival.update(parse_text(line), SE2(x_m, y_m, theta_rad))
    return arrival.T_odom_stop


def placed(*answers: tuple[str, float]) -> SE2 | None:
    """Where to stop after answers at x in m."""
    arrival = StopEstimator(INSTRUCTION)
    return [read(arrival, line, x_m) for line, x_m in answers][-1]


@pytest.mark.parametrize(
    ("first", "second", "placed_m"),
    [
        ((text("stop in 4 m"), 20.0), (text("stop in 3 m"), 22.0), 24.5),
        ((text("stop now"), 7.0), (text("stop now"), 7.0), 7.5),
        ((text("wait, then stop in 2 m"), 7.0), (text("stop in 2 m"), 7.0), 9.0),
    ],
    ids=["between them", "now is half a metre ahead", "waiting first"],
)
def test_two_near_texts_place_the_stop(first: tuple[str, float], second: tuple[str, float], placed_m: float) -> None:
    assert placed(first, second) == SE2(placed_m, 0.0, 0.0)


@pytest.mark.parametrize(
    "other",
    [
        text("stop in 5 m"),
        text(objects="vending machine left 5 m"),
        text(objects="exit door ahead 2 m"),
        text(objects="none"),
        text("turn left into the room in 2 m"),
        text(progress="turn 1 of 2, passed 0"),
        text(progress="nonsense"),
        "",
    ],
    ids=["far stop", "far thing", "another thing", "nothing seen", "a turn", "another leg", "no progress", "no text"],
)
def test_one_text_beside_another_that_plans_otherwise_is_not_enough(other: str) -> None:
    assert placed((text(), 20.0), (other, 21.0)) is None
    assert placed((text(), 20.0), (other, 21.0), (other, 22.0), (text(), 23.0)) is None


def test_one_other_text_between_two_does_not_matter() -> None:
    assert placed((text(), 20.0), ("", 20.0), (text(), 20.0)) == SE2(22.0, 0.0, 0.0)


def test_the_place_is_the_median_of_the_last_three_texts() -> None:
    assert placed(*((text(), x_m) for x_m in (20.0, 21.0, 22.0, 23.0, 29.0))) == SE2(25.0, 0.0, 0.0)


def test_texts_at_another_heading_place_another_stop() -> None:
    arrival = StopEstimator(INSTRUCTION)
    read(arrival, text(), 20.0)
    assert read(arrival, text(), 20.0, theta_rad=math.pi / 2) is None
    place = read(arrival, text(), 20.0, theta_rad=math.pi / 2)
    assert place is not None and place.as_tuple() == pytest.approx((20.0, 2.0, math.pi / 2))


def test_texts_that_stop_soon_without_the_landmark_in_view_neither_move_nor_drop_it() -> None:
    lost = [text("stop in 3 m", objects="exit door ahead 3 m"), text("stop now", objects="none")] * 20
    assert placed((text(), 20.0), (text(), 20.0), *((each, 23.0) for each in lost)) == SE2(22.0, 0.0, 0.0)


ELSEWHERE = {
    "thing away": text(objects="vending machine ahead 5 m"),
    "stop later": text("stop in 5 m"),
    "nothing seen": text("stop in 14 m", objects="exit door ahead 12 m"),
    "another leg": text("turn left into the room in 3 m", progress="turn 1 of 1, passed 0"),
    "back": text("turn back"),
}


@pytest.mark.parametrize("other", ELSEWHERE.values(), ids=ELSEWHERE)
def test_most_texts_that_plan_no_stop_nearby_drop_it(other: str) -> None:
    soon, near = text("stop now", objects="none"), ((text(), 20.0),) * AGREEING_TEXTS
    others = ((other, 20.0),) * CONTRADICTING_TEXTS
    assert placed(*near, *others[1:], (soon, 20.0)) is not None
    assert placed(*near, *others[1:], (soon, 20.0), others[0]) is None
    assert placed(*near, *others) is None


def test_texts_before_it_was_placed_do_not_drop_it() -> None:
    before = ((ELSEWHERE["another leg"], 10.0),) * 9
    assert placed(*before, *((text(), 20.0),) * AGREEING_TEXTS, (ELSEWHERE["stop later"], 20.0)) is not None


@pytest.mark.parametrize(
    ("instruction", "thing", "named"),
    [
        ("stop at the Vending Machine", "vending machine", True),
        ("stop at the vending machine", "yellow vending machine", True),
        ("stop at the red vending machine", "yellow vending machine", False),
        ("stop at the red vending machine", "vending machine", True),
        ("stop at the red vending machine", "red vending machine", True),
        ("stop at the end of the hallway", "end of the hallway", True),
        ("stop at the machines", "machine", False),
        ("stop at the vending machine", "chin", False),
    ],
)
def test_a_landmark_is_named_by_whole_words_and_by_its_colour_where_one_is_given(
    instruction: str, thing: str, named: bool
) -> None:
    arrival = StopEstimator(instruction)
    for _ in range(AGREEING_TEXTS):
        read(arrival, text(objects=f"{thing} left 2 m"), 5.0)
    assert (arrival.T_odom_stop is not None) is named


def test_of_several_named_landmarks_the_first_one_counts() -> None:
    arrival = StopEstimator("Pass the water dispenser and stop at the vending machine.")
    for _ in range(AGREEING_TEXTS):
        read(arrival, text(objects="vending machine ahead 9 m, water dispenser right 2 m"), 5.0)
    assert arrival.T_odom_stop is None


@pytest.mark.parametrize(
    ("pose", "there"),
    [
        (SE2(24.0 - SHORT_M - 0.1, 0.0, 0.0), False),
        (SE2(24.0 - SHORT_M + 0.1, 0.0, 0.0), True),
        (SE2(24.5, -0.5, -1.8), True),
        (SE2(24.0 + PASSED_M + 0.1, 0.0, 0.0), False),
        (SE2(24.0, ASIDE_M + 0.1, 0.0), False),
    ],
    ids=["before", "at", "past and turned", "long past", "beside"],
)
def test_it_is_there_at_the_place_or_past_it(pose: SE2, there: bool) -> None:
    assert has_arrived(AT_GOAL, pose) is there
    assert not has_arrived(None, pose)


def test_the_control_loop_stands_there_and_drives_on_once_the_place_is_further() -> None:
    bench = Bench()
    bench.drive()
    for place, expected in (
        (None, "ok"),
        (SE2(bench.walked_m + 0.2, 0.0, 0.0), ARRIVED),
        (SE2(bench.walked_m + 9.0, 0.0, 0.0), "ok"),
    ):
        bench.see()
        bench.think(stop=place)
        speed_mps, reason = bench.tick()
        assert reason == expected
        assert (speed_mps == 0.0) is (reason == ARRIVED)


def test_standing_to_think_comes_before_having_arrived() -> None:
    bench = Bench()
    bench.drive()
    bench.think(stop=SE2(bench.walked_m, 0.0, 0.0))
    bench.slot.drive_until_ns = 0
    bench.see()
    assert bench.tick() == (0.0, "reasoning")
