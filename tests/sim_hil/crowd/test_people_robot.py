"""People and the robot: they see or hear it, leave it room, step aside, and never run into it."""

from __future__ import annotations

from dataclasses import replace
from math import hypot, inf, pi

import numpy as np
import pytest

from sim_hil.crowd.people import UPDATE_HZ, People
from sim_hil.crowd.senses import ObservedRobot, RobotWatch, notice
from sim_hil.crowd.state import Crowd
from sim_hil.crowd.walkable_map import CrowdMap
from sim_hil.scene.scene import Place, Scene, Wall, load_scene

DT = 0.1


@pytest.fixture(scope="module")
def hall() -> Scene:
    return replace(load_scene("corridor"), objects=(), routes=())


@pytest.fixture(scope="module")
def ways(hall: Scene) -> CrowdMap:
    return CrowdMap(hall)


def _one(heading: float, *, inattentive: bool = False) -> Crowd:
    crowd = Crowd(1, np.random.default_rng(0))
    crowd.x[0], crowd.heading[0] = 10.0, heading
    crowd.reaction_s[0], crowd.sight_m[0], crowd.sight_cos[0] = 0.4, 7.0, np.cos(np.radians(95))
    if inattentive:
        crowd.sight_m[0], crowd.sight_cos[0] = 2.0, np.cos(np.radians(40))
    return crowd


def _robot(x: float, y: float = 0.0, vx: float = 0.0) -> ObservedRobot:
    return ObservedRobot(x, y, -1.0, 0.0, vx, 0.0, 0.22)


def _noticed_after_s(crowd: Crowd, ways: CrowdMap, robot: ObservedRobot) -> float:
    for tick in range(1, 40):
        notice(crowd, ways, robot, DT)
        if crowd.aware[0]:
            return tick * DT
    return inf


@pytest.mark.parametrize(
    ("heading", "robot_x", "inattentive", "least_s", "most_s"),
    [
        pytest.param(0.0, 14.0, False, 0.39, 0.41, id="ahead, after a reaction time"),
        pytest.param(pi, 14.0, False, inf, inf, id="behind"),
        pytest.param(pi, 10.8, False, 0.0, 0.95, id="heard right behind"),
        pytest.param(pi, 11.5, False, 1.05, 1.95, id="heard later further behind"),
        pytest.param(0.0, 13.0, True, inf, inf, id="eyes on the phone"),
        pytest.param(0.0, 11.9, True, 0.0, 0.95, id="eyes on the phone, near"),
    ],
)
def test_the_robot_is_noticed(
    ways: CrowdMap, heading: float, robot_x: float, inattentive: bool, least_s: float, most_s: float
) -> None:
    noticed_s = _noticed_after_s(_one(heading, inattentive=inattentive), ways, _robot(robot_x))
    assert least_s <= noticed_s <= most_s


def test_a_wall_hides_the_robot(hall: Scene) -> None:
    wall = Wall("screen", (12.0, -2.0), (12.0, 1.0), 0.1, 2.5, "wall_wainscot")
    walled = CrowdMap(replace(hall, walls=(*hall.walls, wall)))
    assert _noticed_after_s(_one(0.0), walled, _robot(14.0)) == inf
    assert _noticed_after_s(_one(0.0), walled, _robot(11.3)) < 1.0


def test_an_unseen_robot_is_forgotten_after_a_while(ways: CrowdMap) -> None:
    crowd = _one(0.0)
    _noticed_after_s(crowd, ways, _robot(14.0))
    for _ in range(20):
        notice(crowd, ways, _robot(-50.0), DT)
    assert crowd.aware[0]
    for _ in range(10):
        notice(crowd, ways, _robot(-50.0), DT)
    assert not crowd.aware[0]


def test_some_people_are_inattentive_and_react_later() -> None:
    crowd = Crowd(400, np.random.default_rng((3, 7)))
    assert 0.06 < crowd.inattentive.mean() < 0.18
    assert crowd.reaction_s[crowd.inattentive].mean() > crowd.reaction_s[~crowd.inattentive].mean() + 0.2


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_no_person_runs_into_a_robot_that_stands_in_the_middle_of_a_corridor(seed: int) -> None:
    scene = load_scene("corridor")
    people = People(scene, 8, seed)
    robot, closest, passes = (9.0, 0.0, 0.0), 9.0, 0
    side = np.sign(people.poses()[:, 0] - 9.0)
    for _ in range(40 * UPDATE_HZ):
        people.step(*robot)
        poses = people.poses()
        closest = min(closest, float(np.hypot(poses[:, 0] - 9.0, poses[:, 1]).min()))
        passes += int((np.sign(poses[:, 0] - 9.0) != side).sum())
        side = np.sign(poses[:, 0] - 9.0)
    assert closest > 0.52
    assert passes >= 2  # and they do get past it


@pytest.fixture
def standing(hall: Scene) -> People:
    """A person at (15, 0) who faces back along x, and stands for at least 13 s while the robot stays away."""
    scene = replace(hall, places=(Place("spot", (15.0, 0.0), pi, "stand"),))
    for seed in range(40):
        twin = People(scene, 1, seed)
        if hypot(twin.poses()[0, 0] - 15.0, twin.poses()[0, 1]) < 0.01:
            for _ in range(13 * UPDATE_HZ):
                twin.step(-100.0, -100.0, 0.0)
            if hypot(twin.poses()[0, 0] - 15.0, twin.poses()[0, 1]) < 0.01:
                return People(scene, 1, seed)
    raise AssertionError("no seed with a standing person")


def test_a_standing_person_stays_when_a_robot_passes(standing: People) -> None:
    for step in range(8 * UPDATE_HZ):
        standing.step(11.0 + step / UPDATE_HZ, 1.2, 0.0)
    assert hypot(standing.poses()[0, 0] - 15.0, standing.poses()[0, 1]) < 0.05


def test_a_person_whom_the_robot_drives_at_steps_aside_without_jumping(standing: People) -> None:
    x, fastest, closest = 11.0, 0.0, 9.0
    for _ in range(12 * UPDATE_HZ):
        x += 0.4 / UPDATE_HZ
        standing.step(x, 0.0, 0.0)
        fastest = max(fastest, float(np.hypot(*standing.velocities()[0])))
        closest = min(closest, hypot(standing.poses()[0, 0] - x, standing.poses()[0, 1]))
    assert closest > 0.5
    assert fastest < 1.0


def test_a_person_steps_aside_for_a_waiting_robot(standing: People) -> None:
    for _ in range(12 * UPDATE_HZ):
        standing.step(13.6, 0.0, 0.0)
        if abs(standing.poses()[0, 1]) > 0.7:
            break
    assert abs(standing.poses()[0, 1]) > 0.7


def test_a_robot_put_elsewhere_has_no_velocity() -> None:
    watch = RobotWatch(0.22)
    watch.step(-1.0, 0.0, 0.0, 1 / UPDATE_HZ)
    assert watch.step(14.0, 1.3, 0.0, 1 / UPDATE_HZ).vx == 0.0
