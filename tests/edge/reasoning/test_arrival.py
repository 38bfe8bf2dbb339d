"""Where the words mean to stop: which answers place it, when the robot is there, and what lets it go on."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.geometry import SE2
from edge.motion.recovery import ARRIVED, ASIDE_M, PASSED_M, SHORT_M, has_arrived
from edge.reasoning.instruction_state import AGREEING_TEXTS, CONTRADICTING_TEXTS, StopEstimator
from edge.state.reasoning_text import MAX_TEXT_CHARS, parse_text
from edge.state.switches import Switches
from tests.support.runner.control_bench import Bench

TOLD = "Walk down the corridor and stop at the Vending Machine."
AT_GOAL = SE2(24.0, 0.0, 0.0)


def text(
    plan: str = "stop in 2 m", objects: str = "vending machine left 2 m, exit door ahead 5 m",
    progress: str = "last leg of 0, passed 0",
) -> str:  # fmt: skip
    return f"Situation: in a corridor.\nObjects: {objects}.\nMotion: nobody near.\nProgress: {progress}.\nPlan: {plan}."


def hear(arrival: StopEstimator, said: str, x_m: float, y_m: float = 0.0, theta_rad: float = 0.0) -> SE2 | None:
    arrival.update(parse_text(said), SE2(x_m, y_m, theta_rad))
    return arrival.T_odom_stop


def placed(*answers: tuple[str, float]) -> SE2 | None:
    """Where to stop after answers at x in m."""
    arrival = StopEstimator(TOLD)
    return [hear(arrival, said, x_m) for said, x_m in answers][-1]


def test_two_near_looks_place_it_between_them() -> None:
    assert placed((text("stop in 4 m"), 20.0), (text("stop in 3 m"), 22.0)) == SE2(24.5, 0.0, 0.0)


def test_it_lies_ahead_of_where_the_robot_heads() -> None:
    arrival = StopEstimator(TOLD)
    for _ in range(2):
        place = hear(arrival, text("stop in 2 m"), 5.0, 1.0, math.pi / 2)
    assert place is not None
    assert place.as_tuple() == pytest.approx((5.0, 3.0, math.pi / 2))


def test_stop_now_is_half_a_metre_ahead() -> None:
    assert placed((text("stop now"), 7.0), (text("stop now"), 7.0)) == SE2(7.5, 0.0, 0.0)


def test_who_waits_before_he_stops_means_the_same_place() -> None:
    assert placed((text("wait, then stop in 2 m"), 7.0), (text("stop in 2 m"), 7.0)) == SE2(9.0, 0.0, 0.0)


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
def test_one_look_beside_an_answer_that_says_something_else_is_not_enough(other: str) -> None:
    assert placed((text(), 20.0), (other, 21.0)) is None
    assert placed((text(), 20.0), (other, 21.0), (other, 22.0), (text(), 23.0)) is None


def test_one_odd_answer_between_two_looks_does_not_matter() -> None:
    assert placed((text(), 20.0), ("", 20.0), (text(), 20.0)) == SE2(22.0, 0.0, 0.0)


def test_the_place_is_the_median_of_the_last_three_looks() -> None:
    assert placed(*((text(), x_m) for x_m in (20.0, 21.0, 22.0, 23.0, 29.0))) == SE2(25.0, 0.0, 0.0)


def test_looks_by_who_headed_elsewhere_are_of_another_place() -> None:
    arrival = StopEstimator(TOLD)
    hear(arrival, text(), 20.0)
    assert hear(arrival, text(), 20.0, theta_rad=1.5) is None
    place = hear(arrival, text(), 20.0, theta_rad=1.5)
    assert place is not None and place.x_m == pytest.approx(20.0, abs=0.2)


def test_texts_that_stop_soon_without_the_thing_in_view_neither_move_nor_drop_it() -> None:
    lost = [text("stop in 3 m", objects="exit door ahead 3 m"), text("stop now", objects="none")] * 20
    assert placed((text(), 20.0), (text(), 20.0), *((said, 23.0) for said in lost)) == SE2(22.0, 0.0, 0.0)


ELSEWHERE = {
    "thing away": text(objects="vending machine ahead 5 m"),
    "stop later": text("stop in 5 m"),
    "nothing seen": text("stop in 14 m", objects="exit door ahead 12 m"),
    "another leg": text("turn left into the room in 3 m", progress="turn 1 of 1, passed 0"),
    "back": text("turn back"),
}


@pytest.mark.parametrize("other", ELSEWHERE.values(), ids=ELSEWHERE)
def test_most_answers_of_elsewhere_drop_it(other: str) -> None:
    soon, looks = text("stop now", objects="none"), ((text(), 20.0),) * AGREEING_TEXTS
    others = ((other, 20.0),) * CONTRADICTING_TEXTS
    assert placed(*looks, *others[1:], (soon, 20.0)) is not None
    assert placed(*looks, *others[1:], (soon, 20.0), others[0]) is None
    assert placed(*looks, *others) is None


def test_answers_of_elsewhere_before_it_was_placed_do_not_drop_it() -> None:
    before = ((ELSEWHERE["another leg"], 10.0),) * 9
    assert placed(*before, *((text(), 20.0),) * AGREEING_TEXTS, (ELSEWHERE["stop later"], 20.0)) is not None


@pytest.mark.parametrize(
    ("told", "thing", "named"),
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
def test_a_thing_is_named_by_whole_words_and_by_its_colour_where_one_is_told(
    told: str, thing: str, named: bool
) -> None:
    arrival = StopEstimator(told)
    for _ in range(AGREEING_TEXTS):
        hear(arrival, text(objects=f"{thing} left 2 m"), 5.0)
    assert (arrival.T_odom_stop is not None) is named


def test_of_several_things_that_are_named_the_first_one_counts() -> None:
    arrival = StopEstimator("Pass the water dispenser and stop at the vending machine.")
    for _ in range(AGREEING_TEXTS):
        hear(arrival, text(objects="vending machine ahead 9 m, water dispenser right 2 m"), 5.0)
    assert arrival.T_odom_stop is None


LINES = st.sampled_from([line for said in ELSEWHERE.values() for line in f"{said}\nPlan: \nObjects: ,, m.".split("\n")])


@given(lines=st.lists(LINES | st.text(max_size=20), max_size=12), cut=st.integers(0, 300))
def test_no_text_breaks_it(lines: list[str], cut: int) -> None:
    arrival = StopEstimator(TOLD)
    for _ in range(AGREEING_TEXTS):
        hear(arrival, "\n".join(lines)[cut:], 0.0)


def test_only_the_beginning_of_an_endless_text_is_read() -> None:
    arrival, said = StopEstimator(TOLD), "x" * MAX_TEXT_CHARS + "\n" + text()
    for _ in range(2):
        arrival.update(parse_text(said), AT_GOAL)
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


def test_a_loop_that_is_not_to_stay_drives_on_there() -> None:
    bench = Bench(switches=Switches(stand_at_goal=False))
    bench.drive()
    bench.think(stop=SE2(bench.walked_m, 0.0, 0.0))
    bench.see()
    assert bench.tick()[1] == "ok"


def test_standing_to_think_is_told_before_having_arrived() -> None:
    bench = Bench()
    bench.drive()
    bench.think(stop=SE2(bench.walked_m, 0.0, 0.0))
    bench.slot.drive_until_ns = 0
    bench.see()
    assert bench.tick() == (0.0, "thinking")
