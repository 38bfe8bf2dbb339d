"""The gliding stand-in: it moves as its robot does, and the world stops it where it stops the robot."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sim_hil.scene.scene import Scene, Terrain, load_scene
from sim_hil.simulation.camera import MOUNTS
from sim_hil.simulation.gliding import GLIDES
from sim_hil.simulation.physics import Simulation
from tests.support.benchmark.benchmark_episodes import block, hall
from tools.bench.sim.gliding import apart, commands, drive

RATE_HZ = 120
ROBOTS = sorted(GLIDES)


@contextmanager
def gliding(scene: Scene, *, people: int = 0, **options: Any) -> Iterator[Simulation]:
    simulation = Simulation(scene, people=people, seed=1, rate_hz=RATE_HZ, glides=True, **options)
    try:
        simulation.settle()
        yield simulation
    finally:
        simulation.close()


def run(simulation: Simulation, seconds: float, velocity: tuple[float, float, float] | None) -> None:
    for step in range(round(seconds * RATE_HZ)):
        if velocity is not None and step % (RATE_HZ // 10) == 0:
            simulation.command(*velocity)
        simulation.step()


@pytest.mark.parametrize("robot", ROBOTS)
class TestEveryStandIn:
    @pytest.mark.slow
    def test_it_is_as_far_from_its_robot_as_a_step_after_three_seconds(self, robot: str) -> None:
        given = commands(20.0, seed=2)
        real, glide = (drive(robot, given, glides=glides) for glides in (False, True))
        gaps_m, turns_rad = apart(real.pose, glide.pose, 3.0)
        assert np.median(gaps_m) < 0.1 and np.max(gaps_m) < 0.4
        assert np.median(turns_rad) < 0.1 and np.max(turns_rad) < 0.4

    def test_it_follows_a_velocity_and_stops_within_its_robots_braking(self, robot: str) -> None:
        with gliding(hall(), robot=robot) as simulation:
            run(simulation, 2.0, (0.6, 0.0, 0.0))
            (x_m, _, _), _ = simulation.pose()
            run(simulation, 1.0, (0.6, 0.0, 0.0))
            assert simulation.pose()[0][0] - x_m == pytest.approx(0.6, abs=0.02)
            assert simulation.commanded == (0.6, 0.0, 0.0)
            (x_m, _, _), _ = simulation.pose()
            run(simulation, 2.0, (0.0, 0.0, 0.0))
            assert 0.05 < simulation.pose()[0][0] - x_m < 0.3

    def test_a_command_holds_for_a_second(self, robot: str) -> None:
        with gliding(hall(), robot=robot) as simulation:
            simulation.command(0.6, 0.0, 0.0)
            run(simulation, 0.95, None)
            assert simulation.commanded == (0.6, 0.0, 0.0)
            run(simulation, 0.1, None)
            assert simulation.commanded == (0.0, 0.0, 0.0)
            run(simulation, 2.0, None)
            assert np.allclose(simulation.truth().velocity_world_mps, 0.0, atol=1e-3)

    def test_a_command_is_clipped_to_what_its_robot_can_do(self, robot: str) -> None:
        with gliding(hall(), robot=robot) as simulation:
            simulation.command(9.0, 0.0, 9.0)
            vx, _, wz = simulation.commanded
            assert 1.0 <= vx <= 1.5 and 0.5 <= wz <= 2.0

    def test_at_rest_it_neither_moves_nor_sways(self, robot: str) -> None:
        with gliding(hall(), robot=robot) as simulation:
            before = simulation.render_state()
            run(simulation, 3.0, (0.0, 0.0, 0.0))
            assert np.allclose(simulation.render_state(), before, atol=1e-6)

    def test_a_wall_stops_it_and_is_named(self, robot: str) -> None:
        with gliding(hall(block(-6.0, 0.0, 0.5, 3.0)), robot=robot) as simulation:
            run(simulation, 5.0, (0.6, 0.0, 0.0))
            (x_m, y_m, _), heading = simulation.pose()
            assert -6.9 < x_m < -6.5 and abs(y_m) < 0.05 and abs(heading) < 0.05
            assert simulation.touching == {"block -6.0 0.0"}
            run(simulation, 2.0, (-0.4, 0.0, 0.0))
            assert simulation.touching == frozenset() and simulation.collided_with() == {"block -6.0 0.0"}

    def test_it_slides_along_a_wall_that_it_meets_at_an_angle(self, robot: str) -> None:
        with gliding(hall(block(-5.0, 1.0, 8.0, 0.5)), robot=robot, start=(-8.0, 0.0, 0.3)) as simulation:
            run(simulation, 6.0, (0.6, 0.0, 0.0))
            (x_m, y_m, _), _ = simulation.pose()
            assert x_m > -6.0 and y_m < 0.75

    def test_it_takes_a_platform_and_stands_at_its_height(self, robot: str) -> None:
        platform = Terrain("platform", "platform", (-5.0, 0.0, 0.0), 0.0, (3.0, 3.0), 0.15, "concrete")
        with gliding(replace(hall(), terrain=(platform,)), robot=robot) as simulation:
            (_, _, low_m), _ = simulation.pose()
            run(simulation, 6.0, (0.6, 0.0, 0.0))
            (x_m, _, high_m), _ = simulation.pose()
            assert x_m == pytest.approx(-4.6, abs=0.3) and high_m - low_m == pytest.approx(0.15, abs=0.01)
            assert simulation.collided_with() == set()

    @pytest.mark.slow
    def test_the_same_seed_and_commands_give_the_same_motion(self, robot: str) -> None:
        states = []
        for _ in range(2):
            with gliding(load_scene("corridor"), people=3, robot=robot) as simulation:
                run(simulation, 2.0, (0.6, 0.0, 0.2))
                states.append(simulation.render_state())
        assert np.array_equal(*states)

    def test_its_render_state_is_its_robots(self, robot: str) -> None:
        with gliding(hall(), robot=robot) as simulation:
            assert len(simulation.render_state()) == MOUNTS[robot].fields


@pytest.mark.slow
def test_a_person_who_stands_in_the_way_is_a_collision() -> None:
    with gliding(load_scene("corridor"), people=6, start=(9.0, 0.0, 0.0)) as simulation:
        for _ in range(600):
            people, ((x_m, y_m, _), heading) = simulation.people(), simulation.pose()
            nearest = people[np.argmin(np.hypot(people[:, 0] - x_m, people[:, 1] - y_m))]
            turn = np.arctan2(nearest[1] - y_m, nearest[0] - x_m) - heading
            run(simulation, 0.1, (0.8, 0.0, float(np.clip(2 * np.arctan2(np.sin(turn), np.cos(turn)), -1, 1))))
            if "person" in simulation.collided_with():
                break
        assert "person" in simulation.collided_with()
