"""The simulation around the robot: any robot, rate and start; people at their own rate, with bodies only nearby."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from math import hypot
from typing import Any

import numpy as np
import pybullet
import pytest

from sim_hil.crowd.people import UPDATE_HZ
from sim_hil.scene.scene import Scene, Terrain, load_scene
from sim_hil.simulation.physics import Simulation, SportAction
from tests.support.benchmark.benchmark_episodes import block, hall


@contextmanager
def simulated(scene: Scene, *, people: int = 0, **options: Any) -> Iterator[Simulation]:
    simulation = Simulation(scene, people=people, seed=1, **options)
    try:
        yield simulation
    finally:
        simulation.close()


def run(simulation: Simulation, seconds: float, velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
    for step in range(round(seconds * simulation.rate_hz)):
        if step % (simulation.rate_hz // 10) == 0:
            simulation.command(*velocity)
        simulation.step()


@pytest.mark.parametrize("robot", ["go2", "carter"])
def test_any_robot_gets_ready_and_drives_as_commanded(robot: str) -> None:
    with simulated(hall(), robot=robot, rate_hz=240) as simulation:
        simulation.settle()
        (x0, _, _), _ = simulation.pose()
        run(simulation, 3.0, (0.6, 0.0, 0.0))
        (x1, _, _), _ = simulation.pose()
        assert 1.2 < x1 - x0 < 2.0
        assert simulation.truth().commanded[0] == pytest.approx(0.6)


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["go2", "carter"])
def test_the_same_seed_and_commands_give_the_same_motion(robot: str) -> None:
    states = []
    for _ in range(2):
        with simulated(load_scene("corridor"), people=3, robot=robot, rate_hz=240) as simulation:
            simulation.settle()
            run(simulation, 2.0, (0.6, 0.0, 0.2))
            states.append(simulation.render_state())
    assert np.array_equal(*states)


def test_a_start_of_its_own_takes_the_place_of_the_scenes() -> None:
    with simulated(hall(), start=(2.0, 1.0, 1.5)) as simulation:
        (x, y, _), heading = simulation.pose()
        assert (x, y, heading) == pytest.approx((2.0, 1.0, 1.5), abs=0.02)
        assert simulation.scene.start == (2.0, 1.0, 1.5)


@pytest.mark.slow
def test_a_robot_that_starts_on_a_platform_stands_on_it() -> None:
    platform = Terrain("platform", "platform", (-8.0, 0.0, 0.0), 0.0, (3.0, 3.0), 0.3, "concrete")
    with simulated(replace(hall(), terrain=(platform,))) as simulation:
        simulation.settle()
        assert 0.5 < simulation.pose()[0][2] < 0.7


@pytest.mark.slow
def test_no_person_walks_while_the_robot_gets_ready() -> None:
    with simulated(load_scene("corridor"), people=3) as simulation:
        before = simulation.people()
        simulation.settle()
        assert np.array_equal(simulation.people(), before) and simulation.time_s > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [240, 500])
def test_people_keep_their_own_rate(rate_hz: int) -> None:
    with simulated(load_scene("corridor"), people=2, rate_hz=rate_hz) as simulation:
        changes, before = 0, simulation.people()
        for _ in range(rate_hz):
            simulation.step()
            changes += not np.array_equal(simulation.people(), before)
            before = simulation.people()
        assert changes == pytest.approx(UPDATE_HZ, abs=1)


@pytest.mark.slow
def test_only_people_near_the_robot_have_a_body() -> None:
    seen = set()
    with simulated(load_scene("corridor"), people=6, start=(9.0, 0.0, 0.0), rate_hz=240) as simulation:
        for _ in range(30):
            run(simulation, 0.5)
            (x, y, _), _ = simulation.pose()
            for px, py, _ in simulation.people():
                ((hit, *_),) = pybullet.rayTest((px, py, 2.5), (px, py, 0.5), physicsClientId=simulation.client)
                gap_m = hypot(px - x, py - y)
                if not 2.0 < gap_m < 3.0:
                    assert (hit >= 0) == (gap_m < 2.5)
                    seen.add(hit >= 0)
    assert seen == {True, False}


@pytest.mark.slow
def test_a_contact_ends_but_the_collision_stays_recorded() -> None:
    with simulated(hall(block(-7.0, 0.0, 0.5, 2.0)), rate_hz=240) as simulation:
        simulation.settle()
        for _ in range(40):
            if not simulation.touching:
                run(simulation, 0.1, (0.6, 0.0, 0.0))
        assert simulation.touching == {"block -7.0 0.0"}
        run(simulation, 2.0, (-0.4, 0.0, 0.0))
        assert simulation.touching == frozenset() and simulation.collided_with() == {"block -7.0 0.0"}
        assert not simulation.fell


@pytest.mark.parametrize("options", [{"robot": "spot"}, {"rate_hz": 30}])
def test_an_unknown_robot_and_a_senseless_rate_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="simulation"):
        Simulation(hall(), people=0, seed=1, **options)


def test_sport_actions_are_the_go2s_alone() -> None:
    with simulated(hall(), robot="carter") as simulation, pytest.raises(ValueError, match="Go2"):
        simulation.sport(SportAction.STAND_UP)
