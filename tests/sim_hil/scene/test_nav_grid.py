"""Free space of a scene: clearances are exact, paths feasible, short and taut."""

from __future__ import annotations

import itertools
from dataclasses import replace
from math import hypot, inf, pi, sqrt

import numpy as np
import pytest

from sim_hil.benchmark.suite.robots import robot_grid
from sim_hil.scene.nav_grid import NavGrid, length_m
from sim_hil.scene.scene import SceneError, Terrain, Wall
from tests.support.benchmark.benchmark_episodes import block, hall

CLEARANCE_M = 0.4


def wall(x: float, y0: float, y1: float) -> Wall:
    return Wall(f"wall {x} {y0}", (x, y0), (x, y1), 0.2, 2.5, "wall_wainscot")


@pytest.mark.parametrize(
    ("point", "expected"),
    [
        ((2.0, 0.0), 1.5),
        ((0.0, 1.3), 0.3),
        ((1.3, 1.6), 1.0),
        ((0.05, 0.05), -0.45),
        ((-9.7, 0.0), 0.3),
        ((5.0, 0.0), 2.0),
    ],
)
def test_clearance_is_the_distance_to_the_nearest_edge_up_to_the_cap(
    point: tuple[float, float], expected: float
) -> None:
    grid = NavGrid(hall(block(0.0, 0.0, 1.0, 2.0)), clearance_m=CLEARANCE_M)
    assert grid.clearance_m(*point) == pytest.approx(expected, abs=0.02)


def test_a_turned_box_is_as_near_as_its_corner() -> None:
    grid = NavGrid(hall(block(0.0, 0.0, 2.0, 2.0, turn=pi / 4)), clearance_m=CLEARANCE_M)
    assert grid.clearance_m(2.0, 0.0) == pytest.approx(2.0 - sqrt(2.0), abs=0.02)


def test_an_object_above_the_robot_is_no_obstacle() -> None:
    assert NavGrid(hall(block(0.0, 0.0, 1.0, 1.0, z=1.0)), clearance_m=CLEARANCE_M).is_free(0.0, 0.0)
    assert not NavGrid(hall(block(0.0, 0.0, 1.0, 1.0, z=0.5)), clearance_m=CLEARANCE_M).is_free(0.0, 0.0)


def test_a_free_path_is_straight() -> None:
    grid = NavGrid(hall(), clearance_m=CLEARANCE_M)
    assert grid.path((-8.0, 3.0), (7.3, -2.1)) == [(-8.0, 3.0), (7.3, -2.1)]


def test_the_path_round_a_wall_is_the_shortest_that_keeps_the_clearance() -> None:
    # A wall from the lower edge up to y = 3: the shortest way touches the circle of the clearance around its corners.
    grid = NavGrid(hall(walls=(wall(0.0, -5.0, 3.0),)), clearance_m=CLEARANCE_M)
    found = grid.distance_m((-6.0, 0.0), (6.0, 0.0))
    leg = sqrt((6.0 - 0.1) ** 2 + 3.0**2 - CLEARANCE_M**2)
    turned = np.arctan2(3.0, 5.9) + np.arcsin(CLEARANCE_M / hypot(3.0, 5.9))
    exact = 2 * (leg + CLEARANCE_M * turned) + 0.2
    assert exact - 0.01 <= found <= 1.01 * exact


@pytest.mark.parametrize("seed", range(6))
def test_a_path_keeps_the_clearance_and_is_no_longer_than_the_path_over_cells(seed: int) -> None:
    rng = np.random.default_rng(seed)
    things = [
        block(*rng.uniform((-7, -4), (7, 4)), *rng.uniform(0.4, 1.5, 2), turn=rng.uniform(-3, 3)) for _ in range(9)
    ]
    grid = NavGrid(hall(*things), clearance_m=CLEARANCE_M)
    start, goal = (-9.0, -4.0), (9.0, 4.0)
    path = grid.path(start, goal)
    assert path is not None and path[0] == start and path[-1] == goal
    for a, b in itertools.pairwise(path):
        share = np.linspace(0, 1, 200)[:, None]
        assert grid.clearances_at(np.array(a) * (1 - share) + np.array(b) * share).min() >= CLEARANCE_M - 0.01
    assert hypot(18.0, 8.0) - 1e-9 <= length_m(path) <= grid.field_at(grid.distance_field(goal), *start) + 0.15


def test_a_gap_too_narrow_for_the_robot_has_no_path() -> None:
    walls = (wall(0.0, -5.0, -0.37), wall(0.0, 0.37, 5.0))
    assert NavGrid(hall(walls=walls), clearance_m=0.3).path((-3.0, 0.0), (3.0, 0.0)) is not None
    grid = NavGrid(hall(walls=walls), clearance_m=CLEARANCE_M)
    assert grid.path((-3.0, 0.0), (3.0, 0.0)) is None
    assert grid.distance_m((-3.0, 0.0), (3.0, 0.0)) == inf


def test_a_start_too_near_a_wall_is_left_by_the_nearest_free_point() -> None:
    grid = NavGrid(hall(walls=(wall(0.0, -5.0, 5.0),)), clearance_m=CLEARANCE_M)
    path = grid.path((0.2, 0.0), (4.0, 0.0))
    assert path is not None and path[0] == (0.2, 0.0) and path[-1] == (4.0, 0.0)
    assert length_m(path) < 3.9


def test_a_distance_field_falls_to_zero_at_the_goal_and_is_infinite_out_of_reach() -> None:
    grid = NavGrid(hall(walls=(wall(5.0, -5.0, 5.0),)), clearance_m=CLEARANCE_M)
    field = grid.distance_field((0.0, 0.0))
    assert grid.field_at(field, 0.0, 0.0) == 0.0
    assert grid.field_at(field, -3.0, 0.0) == pytest.approx(3.0, abs=0.15)
    assert grid.field_at(field, 7.0, 0.0) == inf


def test_a_blended_field_changes_as_much_as_one_moves() -> None:
    grid = NavGrid(hall(), clearance_m=CLEARANCE_M)
    field = grid.distance_field((8.0, 0.0))
    left = [grid.blended_at(field, -3.0 + 0.013 * step, 0.0) for step in range(100)]
    assert np.diff(left) == pytest.approx(-0.013, abs=1e-6)


def test_a_blended_field_counts_what_has_a_value_and_is_infinite_only_out_of_reach() -> None:
    grid = NavGrid(hall(walls=(wall(5.0, -5.0, 5.0),)), clearance_m=CLEARANCE_M)
    field = grid.distance_field((0.0, 0.0))
    for x_m in np.arange(4.3, 5.0, 0.03):
        assert grid.blended_at(field, x_m, 0.0) == pytest.approx(4.5, abs=0.3)
    assert grid.blended_at(field, 7.0, 0.0) == inf


@pytest.mark.parametrize(("rise", "expected"), [(0.04, True), (0.15, False)])
def test_a_platform_too_high_to_step_on_is_kept_off(rise: float, expected: bool) -> None:
    step = Terrain("step", "platform", (0.0, 0.0, 0.0), 0.0, (4.0, 9.9), rise, "concrete")
    grid = NavGrid(replace(hall(), terrain=(step,)), clearance_m=CLEARANCE_M)
    assert (grid.path((-6.0, 0.0), (6.0, 0.0)) is not None) == expected
    assert grid.is_free(0.0, 0.0)


@pytest.mark.parametrize(("robot", "expected"), [("go2", True), ("carter", False)])
def test_a_bump_of_5_cm_is_in_the_way_of_the_carter_only(robot: str, expected: bool) -> None:
    bump = Terrain("bump", "platform", (0.0, 0.0, 0.0), 0.0, (4.0, 9.9), 0.05, "concrete")
    grid = robot_grid(replace(hall(), terrain=(bump,)), robot)
    assert (grid.path((-6.0, 0.0), (6.0, 0.0)) is not None) == expected


def test_a_platform_is_reached_by_its_ramp() -> None:
    platform = Terrain("platform", "platform", (3.0, 0.0, 0.0), 0.0, (4.0, 6.0), 0.2, "concrete")
    ramp = Terrain("ramp", "ramp", (0.0, 1.0, 0.0), 0.0, (2.0, 1.5), 0.2, "concrete")
    grid = NavGrid(replace(hall(), terrain=(platform, ramp)), clearance_m=CLEARANCE_M)
    path = grid.path((-6.0, 0.0), (3.0, -2.0))
    assert path is not None and length_m(path) > hypot(9.0, 2.0) + 0.1
    assert NavGrid(replace(hall(), terrain=(platform,)), clearance_m=CLEARANCE_M).path((-6.0, 0.0), (3.0, 0.0)) is None


def test_a_scene_without_room_is_refused() -> None:
    with pytest.raises(SceneError, match="expected room for a clearance of"):
        NavGrid(hall(block(0.0, 0.0, 20.0, 10.0)), clearance_m=CLEARANCE_M)


@pytest.mark.parametrize(("clearance", "cell"), [(-0.1, 0.1), (2.0, 0.1), (0.3, 0.0)])
def test_senseless_sizes_are_refused(clearance: float, cell: float) -> None:
    with pytest.raises(ValueError, match="navigation grid"):
        NavGrid(hall(), clearance_m=clearance, resolution_m=cell)
