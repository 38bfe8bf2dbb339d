"""Walking people: deterministic, on their way, polite."""

from __future__ import annotations

import itertools
from dataclasses import replace
from math import hypot, pi

import numpy as np
import pytest

from sim_hil.crowd.people import UPDATE_HZ, People, appearances
from sim_hil.scene.scene import Box, Route, Scene, load_scene
from sim_hil.simulation.physics import Simulation, SportAction

FAR_AWAY = (-100.0, -100.0, 0.0)
ROBOT_HALF_LENGTH_M = 0.33


@pytest.fixture(scope="module")
def corridor() -> Scene:
    return load_scene("corridor")


def _walk(people: People, seconds: float, robot: tuple[float, float, float] = FAR_AWAY) -> list[np.ndarray]:
    poses = [people.poses()]
    for _ in range(round(seconds * UPDATE_HZ)):
        people.step(*robot)
        poses.append(people.poses())
    return poses


def _box_gap(box: Box, x: float, y: float) -> float:
    rx, ry = x - box.centre_m[0], y - box.centre_m[1]
    c, s = box.axis
    return hypot(max(abs(rx * c + ry * s) - box.size_m[0] / 2, 0), max(abs(-rx * s + ry * c) - box.size_m[1] / 2, 0))


def test_same_seed_gives_the_same_people(corridor: Scene) -> None:
    first, second = (_walk(People(corridor, 5, 3), 10.0)[-1] for _ in range(2))
    assert np.array_equal(first, second)
    assert appearances(5, 3) == appearances(5, 3)


def test_another_seed_gives_other_people(corridor: Scene) -> None:
    assert not np.array_equal(People(corridor, 5, 3).poses(), People(corridor, 5, 4).poses())
    assert appearances(5, 3) != appearances(5, 4)


def test_people_walk_at_walking_speed_without_jumping(corridor: Scene) -> None:
    poses = _walk(People(corridor, 4, 1), 20.0)
    steps = [np.hypot(*(b - a)[:, :2].T) * UPDATE_HZ for a, b in itertools.pairwise(poses)]
    assert np.max(steps) < 1.6
    assert 0.5 < np.mean(steps) < 1.4


@pytest.mark.slow
def test_people_turn_round_gradually(corridor: Scene) -> None:
    poses = _walk(People(corridor, 4, 2), 40.0)
    for a, b in itertools.pairwise(poses):
        turn = (b[:, 2] - a[:, 2] + pi) % (2 * pi) - pi
        assert np.abs(turn).max() * UPDATE_HZ < 3.1


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_nobody_is_stuck_for_long(corridor: Scene, seed: int) -> None:
    poses = np.array(_walk(People(corridor, 8, seed), 40.0))[:, :, :2]
    path = np.hypot(*np.moveaxis(np.diff(poses, axis=0), -1, 0)).sum(axis=0)
    assert path.min() > 0.4 * 40.0 * 0.8


def test_routes_leave_room_for_a_person_to_walk_beside_the_line(corridor: Scene) -> None:
    boxes = [box for _, box in corridor.obstacles()]
    for route in corridor.routes:
        for a, b in zip(route.points_m, route.points_m[1:], strict=False):
            for share in np.linspace(0, 1, 50):
                x, y = a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share
                assert min(_box_gap(box, x, y) for box in boxes) > 0.48


@pytest.mark.slow
def test_people_keep_clear_of_walls_and_of_each_other(corridor: Scene) -> None:
    boxes = [box for _, box in corridor.obstacles()]
    for poses in _walk(People(corridor, 8, 6), 30.0)[::5]:
        for index, (x, y, _) in enumerate(poses):
            assert min(_box_gap(box, x, y) for box in boxes) > 0.2
            assert all(hypot(x - ox, y - oy) > 0.44 for ox, oy, _ in poses[:index])


@pytest.mark.slow
def test_people_walk_round_a_standing_robot_without_touching_it(corridor: Scene) -> None:
    # One person on a straight route, the robot lengthwise in the middle of it.
    scene = replace(corridor, routes=(Route(((3.0, 0.0), (15.0, 0.0))),))
    people = People(scene, 1, 0)
    poses = _walk(people, 40.0, robot=(9.0, 0.0, 0.0))
    xs = [float(pose[0, 0]) for pose in poses]
    assert min(xs) < 8.0 and max(xs) > 10.0  # got past
    for pose in poses:
        x, y, _ = pose[0]
        along = min(max(x - 9.0, -ROBOT_HALF_LENGTH_M), ROBOT_HALF_LENGTH_M)
        assert hypot(x - 9.0 - along, y) > 0.35


@pytest.mark.slow
def test_people_never_overlap_a_robot_that_walks_at_them(corridor: Scene) -> None:
    scene = replace(corridor, routes=(Route(((2.0, 0.0), (9.0, 0.0))),))
    simulation = Simulation(scene, people=1, seed=1)
    simulation.sport(SportAction.STAND_UP)
    for _ in range(1000):
        simulation.step()
    simulation.sport(SportAction.BALANCE_STAND)
    for index in range(5000):
        if index % 50 == 0:
            simulation.move(0.5, 0.0, 0.0)
        simulation.step()
        if index % 50 == 0:
            truth = simulation.truth()
            gap = np.hypot(*(simulation.people()[:, :2] - truth.position_m[:2]).T).min()
            assert gap > 0.4  # trunk and person are 0.27 m wide together, side by side
    assert not simulation.fell
    simulation.close()


def test_limbs_swing_with_walking_and_rest_at_the_start(corridor: Scene) -> None:
    people = People(replace(corridor, routes=(Route(((3.0, 0.0), (9.0, 0.0))),)), 1, 0)
    assert people.render_rows()[0, 4] == 0
    _walk(people, 3.0)
    assert people.render_rows()[0, 4] > 0.7
    assert 0 <= people.render_rows()[0, 3] < 1


@pytest.mark.slow
def test_a_scene_without_routes_is_walked_all_over(corridor: Scene) -> None:
    poses = np.array(_walk(People(replace(corridor, routes=()), 6, 0), 60.0))
    assert np.ptp(poses[:, :, 0], axis=0).max() > 10.0


def test_a_scene_without_room_has_no_people(corridor: Scene) -> None:
    with pytest.raises(ValueError, match="no room"):
        People(corridor, 2000, 0)
