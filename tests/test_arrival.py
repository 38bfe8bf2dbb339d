"""Where the words mean to stop: which answers place it, when the robot is there, and what lets it go on."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.arrival import ARRIVED, FAR_M, LOOKS, NEAR_M, SHORT_M, Arrival, is_there
from edge.geometry import SE2
from edge.reasoning_text import MAX_TEXT_CHARS, parse_progress
from tests.control_bench import Bench

TOLD = "Walk down the corridor and stop at the Vending Machine."
AT_GOAL = SE2(24.0, 0.0, 0.0)


def text(
    plan: str = "stop in 2 m", objects: str = "vending machine left 2 m, exit door ahead 5 m",
    progress: str = "last leg of 0, passed 0",
) -> str:  # fmt: skip
    return f"Situation: in a corridor.\nObjects: {objects}.\nMotion: nobody near.\nProgress: {progress}.\nPlan: {plan}."


def hear(arrival: Arrival, said: str, x_m: float, y_m: float = 0.0, theta_rad: float = 0.0) -> SE2 | None:
    arrival.heard(said, parse_progress(said), SE2(x_m, y_m, theta_rad))
    return arrival.T_odom_stop


def placed(*answers: tuple[str, float]) -> SE2 | None:
    """Where to stop after answers at x in m."""
    arrival = Arrival(TOLD)
    return [hear(arrival, said, x_m) for said, x_m in answers][-1]


def test_two_near_looks_place_it_between_them() -> None:
    assert placed((text("stop in 4 m"), 20.0), (text("stop in 3 m"), 22.0)) == SE2(24.5, 0.0, 0.0)


def test_it_lies_ahead_of_where_the_robot_heads() -> None:
    arrival = Arrival(TOLD)
    for _ in range(2):
        place = hear(arrival, text("stop in 2 m"), 5.0, 1.0, math.pi / 2)
    assert place is not None
    assert place.as_tuple() == pytest.approx((5.0, 3.0, math.pi / 2))


def test_stop_now_is_here() -> None:
    assert placed((text("stop now"), 7.0), (text("stop now"), 7.0)) == SE2(7.0, 0.0, 0.0)


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


def test_the_place_moves_on_with_newer_looks() -> None:
    looks = [(text(), 20.0 + k) for k in range(6)]
    assert placed(*looks) == SE2(26.0, 0.0, 0.0)  # the median of the last three


def test_words_without_the_thing_in_view_do_not_move_it() -> None:
    lost = [text("stop in 17 m", objects="exit door ahead 3 m"), text("stop now", objects="none")] * 5
    assert placed((text(), 20.0), (text(), 20.0), *((said, 23.0) for said in lost)) == SE2(22.0, 0.0, 0.0)


FAR_THING = text("stop in 9 m", objects=f"vending machine ahead {round(FAR_M)} m")
ANOTHER_LEG = text("turn left into the room in 3 m", progress="turn 1 of 1, passed 0")


@pytest.mark.parametrize("other", [FAR_THING, ANOTHER_LEG], ids=["far", "another leg"])
def test_several_answers_of_elsewhere_in_a_row_let_it_go_on(other: str) -> None:
    arrival = Arrival(TOLD)
    for _ in range(2):
        hear(arrival, text(), 20.0)
    for _ in range(LOOKS - 1):
        assert hear(arrival, other, 20.0) is not None
    hear(arrival, text("stop now", objects="none"), 20.0)
    for _ in range(LOOKS - 1):
        assert hear(arrival, other, 20.0) is not None
    assert hear(arrival, other, 20.0) is None


@pytest.mark.parametrize("named", ["machine", "vending machine", "VENDING MACHINE".lower()])
def test_the_instruction_names_a_thing_by_whole_words(named: str) -> None:
    assert placed(*[(text(objects=f"{named} left 2 m"), 5.0)] * 2) is not None
    assert placed(*[(text(objects="chin left 2 m"), 5.0)] * 2) is None


@given(said=st.text(alphabet="Objects: Plan stop in now last leg of 0, m.\n vending machine left 2", max_size=300))
def test_no_text_breaks_it(said: str) -> None:
    hear(Arrival(TOLD), said, 0.0)


def test_only_the_beginning_of_an_endless_text_is_read() -> None:
    arrival, said = Arrival(TOLD), "x" * MAX_TEXT_CHARS + "\n" + text()
    for _ in range(2):
        arrival.heard(said, parse_progress(text()), AT_GOAL)
    assert arrival.T_odom_stop is None


@pytest.mark.parametrize(
    ("pose", "there"),
    [
        (SE2(24.0 - SHORT_M - 0.1, 0.0, 0.0), False),
        (SE2(24.0 - SHORT_M + 0.1, 0.0, 0.0), True),
        (SE2(24.5, -0.5, -1.8), True),
        (SE2(24.0 + NEAR_M + 0.1, 0.0, 0.0), False),
        (SE2(23.0, 3.0, 0.0), False),
    ],
    ids=["before", "at", "past and turned", "long past", "beside and before"],
)
def test_it_is_there_at_the_place_or_past_it(pose: SE2, there: bool) -> None:
    assert is_there(AT_GOAL, pose) is there
    assert not is_there(None, pose)


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


def test_a_fault_that_forces_zero_is_told_before_having_arrived() -> None:
    bench = Bench()
    bench.drive()
    bench.think(stop=SE2(bench.walked_m, 0.0, 0.0))
    bench.loop._slot.drive_until_ns = 0
    bench.see()
    assert bench.tick() == (0.0, "thinking")
