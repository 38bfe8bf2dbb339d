"""The way since an instruction began: at most 8 points, always from its start, the same however it is fed."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.geometry import SE2
from edge.reasoning.path_memory import (
    CAPACITY,
    FARTHEST_M,
    MAX_POINTS,
    PERIOD_NS,
    PathMemory,
    Point,
    past_path_of,
    simplified,
)

TICK_NS = 100_000_000
metres = st.floats(-50, 50, allow_nan=False)
ways = st.lists(st.tuples(metres, metres), min_size=1, max_size=60)
turns = st.lists(st.floats(-0.3, 0.3, allow_nan=False), min_size=1, max_size=300)


def distance(point: Point, a: Point, b: Point) -> float:
    ax, ay, bx, by = *a, *b
    square = (bx - ax) ** 2 + (by - ay) ** 2
    share = 0.0 if square == 0 else ((point[0] - ax) * (bx - ax) + (point[1] - ay) * (by - ay)) / square
    share = min(max(share, 0.0), 1.0)
    return math.dist(point, (ax + share * (bx - ax), ay + share * (by - ay)))


def drive(turning: list[float], speed_mps: float = 0.8) -> list[tuple[int, SE2]]:
    """Poses at 10 Hz of a robot that turns by so much in every tick."""
    T_odom_base, poses = SE2(3.0, -2.0, 0.4), []
    for tick, turn in enumerate(turning):
        poses.append((tick * TICK_NS, T_odom_base))
        T_odom_base = T_odom_base @ SE2(speed_mps / 10, 0.0, turn)
    return poses


def corner(before_s: int = 20, after_s: int = 20) -> list[tuple[int, SE2]]:
    """Straight on, a left turn within 1.5 s, straight on."""
    return drive([0.0] * (before_s * 10) + [math.pi / 2 / 15] * 15 + [0.0] * (after_s * 10))


@pytest.mark.slow
@given(ways, st.integers(2, 12), st.floats(0, 5))
def test_a_simplified_way_keeps_its_ends_and_order_and_no_more_points_than_wanted(
    points: list[Point], most: int, tolerance_m: float
) -> None:
    found = simplified(points, most, tolerance_m)
    assert found[0] == points[0] and found[-1] == points[-1] and len(found) <= max(most, 1)
    rest = iter(points)
    assert all(point in rest for point in found)


@pytest.mark.slow
@given(ways, st.floats(0.01, 5))
def test_with_points_to_spare_no_point_left_out_is_farther_than_the_tolerance(
    points: list[Point], tolerance_m: float
) -> None:
    found = simplified(points, len(points) + 2, tolerance_m)
    legs = list(itertools.pairwise(found)) or [(found[0], found[0])]
    for point in points:
        assert min(distance(point, a, b) for a, b in legs) <= tolerance_m + 1e-9


def test_a_path_out_and_back_keeps_its_far_end() -> None:
    points = [(float(x), 0.0) for x in (*range(6), *range(4, -1, -1))]
    assert simplified(points, 9, 0.5) == [(0.0, 0.0), (5.0, 0.0), (0.0, 0.0)]


def test_a_corner_gives_the_start_and_the_corner_in_the_newest_robot_frame() -> None:
    way = past_path_of(corner())
    # 20 s at 0.8 m/s straight on, then 16 m to the left of it: now the start is 17 m behind and as far to the left.
    assert len(way) == 2
    assert way[0] == pytest.approx((-16.8, 16.8), abs=0.3)
    assert way[1] == pytest.approx((-16.4, 0.4), abs=0.8)


def test_a_straight_way_is_its_start() -> None:
    assert past_path_of(drive([0.0] * 101)) == ((-8.0, 0.0),)


def test_the_first_path_is_the_start_and_without_any_pose_there_is_none() -> None:
    assert past_path_of(drive([0.0])) == ((0.0, 0.0),)
    assert past_path_of([]) == ()


@given(turns)
def test_a_way_has_at_most_8_points_of_tenths_and_begins_at_the_start(turning: list[float]) -> None:
    poses = drive(turning)
    way = past_path_of(poses)
    assert 1 <= len(way) <= MAX_POINTS
    start = poses[-1][1].inverse() @ poses[0][1]
    assert way[0] == pytest.approx((start.x_m, start.y_m), abs=0.051)
    for x_m, y_m in way:
        assert (round(x_m, 1), round(y_m, 1)) == (x_m, y_m)
        assert math.copysign(1, x_m) == 1 or x_m < 0


@given(turns, st.integers(1, 12))
def test_the_way_is_the_same_however_many_poses_come_at_once(turning: list[float], at_once: int) -> None:
    """As from the token ring: overlapping lists of the newest poses."""
    poses, memory = drive(turning), PathMemory()
    for end in range(at_once, len(poses) + at_once, at_once):
        for stamp_ns, T_odom_base in poses[max(0, end - 30) : end]:
            memory.put(stamp_ns, T_odom_base)
    assert memory.past_path(poses[-1][1]) == past_path_of(poses)


@given(turns, st.tuples(metres, metres, st.floats(-3, 3)))
def test_the_start_does_not_depend_on_the_origin_of_odometry(
    turning: list[float], moved: tuple[float, float, float]
) -> None:
    poses = drive(turning)
    T_new_old = SE2(*moved)
    elsewhere = past_path_of((stamp_ns, T_new_old @ T_odom_base) for stamp_ns, T_odom_base in poses)
    assert elsewhere[0] == pytest.approx(past_path_of(poses)[0], abs=0.11)


def test_a_robot_that_stands_keeps_nothing_new() -> None:
    memory = PathMemory()
    for tick in range(36_000):
        memory.put(tick * TICK_NS, SE2(1e-7 * tick, 0.0, 0.0))
    assert len(memory.points) == 1


@pytest.mark.slow
def test_hours_are_bounded_and_the_start_is_never_lost() -> None:
    memory, poses = PathMemory(), drive([0.02 * math.sin(tick / 70) for tick in range(30_000)])
    most = 0
    for stamp_ns, T_odom_base in poses:
        memory.put(stamp_ns, T_odom_base)
        most = max(most, len(memory.points))
    assert most < CAPACITY
    assert memory.points[0] == (poses[0][1].x_m, poses[0][1].y_m)
    assert memory.past_path(poses[-1][1])[0] == pytest.approx(past_path_of([poses[0], poses[-1]])[0])


def test_the_text_of_a_path_beyond_a_kilometre_has_a_bound() -> None:
    assert past_path_of([(0, SE2(-5000.0, 2.0, 0.0)), (PERIOD_NS, SE2(0.0, 0.0, 0.0))]) == ((-FARTHEST_M, 2.0),)


def test_a_pose_that_is_not_newer_changes_nothing() -> None:
    memory = PathMemory()
    memory.put(5 * PERIOD_NS, SE2(1.0, 0.0, 0.0))
    memory.put(5 * PERIOD_NS, SE2(9.0, 9.0, 0.0))
    memory.put(3 * PERIOD_NS, SE2(9.0, 9.0, 0.0))
    assert memory.past_path(SE2(2.0, 0.0, 0.0)) == ((-1.0, 0.0),)
