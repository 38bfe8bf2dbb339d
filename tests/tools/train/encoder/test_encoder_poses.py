"""Poses are where the robot can be, leave room to people, and look at what they were drawn for."""

from __future__ import annotations

from math import atan2, hypot, pi

import numpy as np
import pytest

from sim_hil.benchmark.suite.robots import robot_grid
from sim_hil.robots.go2.body import rotation_matrix
from sim_hil.scene.nav_grid import NavGrid
from tests.tools.train.encoder.test_encoder_labels import SCENE
from tools.train.encoder import worker as encoder_poses
from tools.train.encoder.worker import Poses, body_state, quaternion_xyzw

PEOPLE = np.array([(1.0, 0.0, 0.0), (4.0, -1.0, 0.0), (10.0, 1.0, 0.0)])
NOBODY = np.zeros((0, 3))


@pytest.fixture(scope="module")
def grid() -> NavGrid:
    return robot_grid(SCENE, "go2")


def drawn(
    grid: NavGrid, sort: str, people: np.ndarray, monkeypatch: pytest.MonkeyPatch, count: int = 60
) -> list[tuple[float, float, float]]:
    """Poses of one sort alone."""
    monkeypatch.setattr(encoder_poses, "SHARES", ((sort, 1.0),))
    poses = Poses(SCENE, grid, np.random.default_rng(1))
    return [poses.draw(people) for _ in range(count)]


def off(pose: tuple[float, float, float], x: float, y: float) -> float:
    """By how much a pose looks past a point, rad."""
    return abs((atan2(y - pose[1], x - pose[0]) - pose[2] + pi) % (2 * pi) - pi)


@pytest.mark.parametrize("sort", [name for name, _ in encoder_poses.SHARES])
def test_poses_of_every_sort_are_on_free_floor_and_clear_of_people(
    grid: NavGrid, sort: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for people in (PEOPLE, NOBODY):
        for x, y, _ in drawn(grid, sort, people, monkeypatch):
            assert grid.is_free(x, y)
            assert all(hypot(x - px, y - py) >= 0.6 for px, py, _ in people)


def test_poses_before_a_thing_have_one_in_view(grid: NavGrid, monkeypatch: pytest.MonkeyPatch) -> None:
    things = [thing.position_m[:2] for thing in SCENE.objects]
    poses = drawn(grid, "thing", NOBODY, monkeypatch)
    looking = [min(off(pose, x, y) for x, y in things) < 0.9 for pose in poses]
    assert np.mean(looking) > 0.9


def test_poses_along_a_way_look_along_it_both_ways(grid: NavGrid, monkeypatch: pytest.MonkeyPatch) -> None:
    headings = np.array([pose[2] for pose in drawn(grid, "way", NOBODY, monkeypatch)])
    assert np.mean(np.abs(np.cos(headings)) > 0.8) > 0.85
    assert 0.2 < np.mean(np.cos(headings) > 0) < 0.8


def test_a_floor_full_of_people_still_gives_a_pose(grid: NavGrid) -> None:
    crowd = np.array([(x, y, 0.0) for x in np.arange(-2, 12, 0.5) for y in np.arange(-2, 2, 0.5)])
    x, y, _ = Poses(SCENE, grid, np.random.default_rng(1)).draw(crowd)
    assert grid.is_free(x, y)


@pytest.mark.parametrize(
    ("roll", "pitch", "yaw"), [(0.0, 0.0, 0.7), (0.1, 0.0, 0.0), (0.0, 0.2, 0.0), (0.1, -0.2, 2.0)]
)
def test_a_quaternion_rolls_then_pitches_then_turns(roll: float, pitch: float, yaw: float) -> None:
    matrix = rotation_matrix(quaternion_xyzw(roll, pitch, yaw))
    assert atan2(matrix[1, 0], matrix[0, 0]) == pytest.approx(yaw)
    assert -np.arcsin(matrix[2, 0]) == pytest.approx(pitch)
    assert atan2(matrix[2, 1], matrix[2, 2]) == pytest.approx(roll)


@pytest.mark.parametrize(("robot", "height"), [("go2", 0.31), ("carter", 0.0)])
def test_a_body_sways_a_little_about_its_height(robot: str, height: float) -> None:
    rng = np.random.default_rng(1)
    states = np.array([body_state(SCENE, robot, (1.0, -0.5, 0.3), rng) for _ in range(200)])
    assert states[:, :2] == pytest.approx(np.tile((1.0, -0.5), (200, 1)))
    assert states[:, 2].mean() == pytest.approx(height, abs=0.01) and states[:, 2].std() < 0.05
    up = np.array([rotation_matrix(tuple(state[3:7]))[2, 2] for state in states])
    assert up.min() > 0.95
    assert (states[:, 2].std() > 0) == (robot == "go2")
