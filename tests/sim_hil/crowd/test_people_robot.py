"""How people take the robot: they have to see it, then leave it room, get out of its way, and never run into it."""

from __future__ import annotations

from dataclasses import replace
from math import hypot, pi

import numpy as np
import pytest

from sim_hil.crowd.people import UPDATE_HZ, People
from sim_hil.crowd.senses import ObservedRobot, notice
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
    return float("inf")


def test_the_robot_ahead_is_noticed_after_a_reaction_time(ways: CrowdMap) -> None:
    assert _noticed_after_s(_one(0.0), ways, _robot(14.0)) == pytest.approx(0.4)


def test_the_robot_behind_ones_back_is_not_noticed(ways: CrowdMap) -> None:
    assert _noticed_after_s(_one(pi), ways, _robot(14.0)) == float("inf")


def test_right_behind_one_it_is_heard(ways: CrowdMap) -> None:
    assert _noticed_after_s(_one(pi), ways, _robot(10.8)) < 1.0


def test_a_little_further_behind_one_it_is_heard_later(ways: CrowdMap) -> None:
    assert 1.0 < _noticed_after_s(_one(pi), ways, _robot(11.5)) < 2.0


def test_who_looks_at_a_phone_notices_it_only_when_it_is_near(ways: CrowdMap) -> None:
    assert _noticed_after_s(_one(0.0, inattentive=True), ways, _robot(13.0)) == float("inf")
    assert _noticed_after_s(_one(0.0, inattentive=True), ways, _robot(11.9)) < 1.0


def test_a_wall_hides_the_robot(hall: Scene) -> None:
    wall = Wall("screen", (12.0, -2.0), (12.0, 1.0), 0.1, 2.5, "wall_wainscot")
    walled = CrowdMap(replace(hall, walls=(*hall.walls, wall)))
    assert _noticed_after_s(_one(0.0), walled, _robot(14.0)) == float("inf")
    assert _noticed_after_s(_one(0.0), walled, _robot(11.3)) < 1.0


def test_out_of_sight_is_out_of_mind_after_a_while(ways: CrowdMap) -> None:
    crowd = _one(0.0)
    _noticed_after_s(crowd, ways, _robot(14.0))
    for _ in range(20):
        notice(crowd, ways, _robot(-50.0), DT)
    assert crowd.aware[0]
    for _ in range(10):
        notice(crowd, ways, _robot(-50.0), DT)
    assert not crowd.aware[0]


def test_some_people_are_inattentive_and_the_seed_says_who() -> None:
    crowd = Crowd(400, np.random.default_rng((3, 7)))
    assert 0.06 < crowd.inattentive.mean() < 0.18
    assert crowd.reaction_s[crowd.inattentive].mean() > crowd.reaction_s[~crowd.inattentive].mean() + 0.2


@pytest.mark.parametrize("seed", range(2))
def test_nobody_runs_into_a_robot_that_stands_in_the_middle_of_a_corridor(seed: int) -> None:
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


@pytest.mark.slow
def test_who_has_room_leaves_the_robot_more_than_who_has_none(hall: Scene) -> None:
    tight = [Wall(f"side {y}", (2.0, y), (26.0, y), 0.1, 2.5, "wall_wainscot") for y in (-1.15, 1.15)]
    closest = []
    for scene in (hall, replace(hall, walls=(*hall.walls, *tight))):
        passes = []
        for seed in range(2):
            people = People(scene, 6, seed)
            gaps = []
            for _ in range(30 * UPDATE_HZ):
                people.step(13.0, 0.0, 0.0)
                gaps.append(np.hypot(people.poses()[:, 0] - 13.0, people.poses()[:, 1]))
            least = np.min(gaps, axis=0)
            passes += least[least < 2.0].tolist()
        closest.append(float(np.median(passes)))
    assert closest[0] > closest[1] > 0.55
    assert closest[0] > 0.75


def _standing(hall: Scene) -> tuple[People, int]:
    """One person who stands at (15, 0) and looks towards the robot's side, for minutes."""
    people = People(replace(hall, places=(Place("spot", (15.0, 0.0), pi, "stand"),)), 1, 0)
    crowd = people._crowd
    crowd.x[0], crowd.y[0], crowd.heading[0] = 15.0, 0.0, pi
    crowd.vx[0] = crowd.vy[0] = 0.0
    people._plans._hold(0, pi, (900.0, 901.0))
    return people, 0


def test_a_person_who_stands_does_not_mind_a_robot_that_passes(hall: Scene) -> None:
    people, _ = _standing(hall)
    for step in range(8 * UPDATE_HZ):
        people.step(11.0 + step / UPDATE_HZ, 1.2, 0.0)
    assert hypot(people.poses()[0, 0] - 15.0, people.poses()[0, 1]) < 0.05


def test_a_person_whom_the_robot_drives_at_steps_aside_without_jumping(hall: Scene) -> None:
    people, _ = _standing(hall)
    x, fastest, closest = 11.0, 0.0, 9.0
    for _ in range(12 * UPDATE_HZ):
        x += 0.4 / UPDATE_HZ
        people.step(x, 0.0, 0.0)
        fastest = max(fastest, float(np.hypot(*people.velocities()[0])))
        closest = min(closest, hypot(people.poses()[0, 0] - x, people.poses()[0, 1]))
    assert closest > 0.5
    assert fastest < 1.0


def test_a_robot_that_waits_before_somebody_is_let_past(hall: Scene) -> None:
    people, _ = _standing(hall)
    for _ in range(12 * UPDATE_HZ):
        people.step(13.6, 0.0, 0.0)
        if abs(people.poses()[0, 1]) > 0.7:
            break
    assert abs(people.poses()[0, 1]) > 0.7


def test_the_robot_put_elsewhere_is_not_taken_for_one_that_races(hall: Scene) -> None:
    people, _ = _standing(hall)
    people.step(-1.0, 0.0, 0.0)
    people.step(14.0, 1.3, 0.0)
    assert people._watch.step(14.0, 1.3, 0.0, 1 / UPDATE_HZ).vx == 0.0
