"""The wheeled base under physics: it tracks, climbs, stops, slips and is stopped."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pybullet
import pytest

from sim_hil.robots.carter.body import TYRE_GRIP, Bumpers
from sim_hil.robots.carter.sensors import CarterSensors
from sim_hil.robots.carter.urdf import LENGTH_M, RADIUS_M, WHEEL_RADIUS_M
from sim_hil.robots.go2.gait import GRAVITY_MPS2
from tools.bench.sim.wheeled_course import World, forward_mps

RATES_HZ = (240, 480, 500)


Make = Callable[..., World]


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    worlds: list[World] = []

    def build(rate_hz: int = 240) -> World:
        worlds.append(World(tmp_path, rate_hz))
        return worlds[-1]

    yield build
    for world in worlds:
        world.close()


def test_the_tyres_have_the_grip_that_they_should(make: Make) -> None:
    world = make()
    friction = [pybullet.getDynamicsInfo(world.robot.body, link, physicsClientId=world.client)[1] for link in range(3)]
    assert friction[:2] == [TYRE_GRIP, TYRE_GRIP]
    assert friction[2] < 0.1


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_it_stands_still_and_level_until_a_command(make: Make, rate_hz: int) -> None:
    world = make(rate_hz)
    world.run(0.3)
    truth = world.run(1.0)
    assert np.linalg.norm(truth.position_m) < 0.001
    assert world.robot.up() > 0.99999
    assert truth.accel_mps2 == pytest.approx((0.0, 0.0, GRAVITY_MPS2), abs=0.02)


TRACKED = [(1.5, 0.0), (0.5, 0.0), (-0.8, 0.0), (0.0, 1.0), (0.0, -2.0), (0.6, 0.8), (1.2, -0.5)]


@pytest.mark.parametrize(("rate_hz", "v", "w"), [*((240, v, w) for v, w in TRACKED), (480, 1.2, -0.5), (500, 0.6, 0.8)])
def test_it_tracks_a_velocity_within_three_percent(make: Make, rate_hz: int, v: float, w: float) -> None:
    world = make(rate_hz).go()
    world.run(2.5, v, w)
    samples = []
    for _ in range(10):
        truth = world.run(0.1, v, w)
        samples.append((forward_mps(truth), float(truth.gyro_radps[2])))
    mean_v, mean_w = np.mean(samples, axis=0)
    assert mean_v == pytest.approx(v, rel=0.03, abs=0.01)
    assert mean_w == pytest.approx(w, rel=0.03, abs=0.01)


def test_a_speed_beyond_the_limit_is_clipped_and_sideways_is_ignored(make: Make) -> None:
    world = make().go()
    world.robot.command(9.0, 5.0, 0.0)
    assert world.truth().commanded == (1.5, 0.0, 0.0)


def test_its_stopping_distance_follows_from_its_brakes(make: Make) -> None:
    world = make().go()
    start_x = world.run(2.5, 1.5).position_m[0]
    truth = world.run(2.0, 0.0)
    assert forward_mps(truth) == pytest.approx(0.0, abs=0.01)
    assert truth.position_m[0] - start_x == pytest.approx(1.5**2 / (2 * 2.0), rel=0.15)


def test_an_emergency_stop_ends_motion_and_commands_until_released_and_powered(make: Make) -> None:
    world = make().go()
    world.run(2.0, 1.0)
    world.robot.press_estop()
    begin_x = world.truth().position_m[0]
    truth = world.run(1.0, 1.0)
    assert forward_mps(truth) == pytest.approx(0.0, abs=0.01)
    assert truth.position_m[0] - begin_x < 0.3
    world.robot.stand()
    assert not world.robot.ready
    world.robot.release_estop()
    assert np.allclose(world.run(0.5, 1.0).position_m, truth.position_m, atol=0.005)
    world.robot.stand()
    assert forward_mps(world.run(1.5, 1.0)) == pytest.approx(1.0, rel=0.03)


def test_turning_in_place_it_stays_inside_its_circle(make: Make) -> None:
    world = make()
    for post in range(12):
        a, out = 2 * math.pi * post / 12, RADIUS_M + 0.02 + 0.05
        world.box((out * math.cos(a), out * math.sin(a), 0.5), (0.06, 0.06, 1.0))
    world.go()
    for _ in range(50):
        assert world.run(0.1, 0.0, 1.5).bumpers == Bumpers()
    assert math.hypot(*world.truth().position_m[:2]) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("v", [0.3, 0.6, 1.5])
def test_it_climbs_a_ramp_of_8_degrees_rests_on_it_and_backs_down(make: Make, v: float) -> None:
    world = make()
    world.ramp(1.0, 8.0, 6.0)
    world.go()
    top = world.run(1.0 + 2.5 / v, v)
    assert forward_mps(top) == pytest.approx(v * math.cos(math.radians(8)), rel=0.03)
    assert top.rpy_rad[1] == pytest.approx(-math.radians(8), abs=0.005)
    rest = world.run(2.0, 0.0)
    later = world.run(3.0)
    assert np.allclose(rest.position_m, later.position_m, atol=0.005)
    down = world.run(1.0 + 3.5 / v, -v)
    assert abs(down.position_m[2]) < 0.005 and world.robot.up() > 0.999


@pytest.mark.parametrize("rate_hz", (240, 480))
@pytest.mark.parametrize("v", [0.3, 0.6, 1.0])
def test_it_climbs_an_edge_of_2_cm(make: Make, v: float, rate_hz: int) -> None:
    world = make(rate_hz)
    world.box((5.0, 0.0, 0.01), (8.0, 6.0, 0.02))
    world.go()
    truth = world.run(1.0 + 2.2 / v, v)
    assert truth.position_m[0] > 1.8
    assert truth.position_m[2] == pytest.approx(0.02, abs=0.003)
    assert truth.bumpers == Bumpers()


@pytest.mark.parametrize("v", [0.3, 1.5])
def test_a_kerb_of_15_cm_stops_it_and_triggers_its_front_bumper(make: Make, v: float) -> None:
    world = make()
    world.box((5.0, 0.0, 0.075), (8.0, 6.0, 0.15))
    world.go()
    truth = world.run(1.0 + 1.5 / v, v)
    assert truth.position_m[0] < 1.0 - LENGTH_M / 2 + 0.02
    assert forward_mps(truth) == pytest.approx(0.0, abs=0.02)
    assert truth.bumpers.front and not truth.bumpers.rear
    assert world.robot.up() > 0.99


@pytest.mark.slow
def test_wheels_that_spin_at_a_kerb_carry_the_odometry_on_without_the_robot(make: Make) -> None:
    world = make()
    world.box((5.0, 0.0, 0.075), (8.0, 6.0, 0.15))
    truth = world.go().run(6.0, 0.6)
    assert truth.odometry.T_odom_base.x_m - truth.position_m[0] > 0.5


@pytest.mark.slow
def test_on_a_clean_floor_odometry_is_nearly_right_and_never_the_truth(make: Make) -> None:
    world = make().go()
    for v, w in ((1.0, 0.0), (0.5, 1.0), (0.8, -0.7), (1.2, 0.0)):
        world.run(2.5, v, w)
    truth = world.truth()
    reported = truth.odometry.T_odom_base
    error_m = math.hypot(reported.x_m - truth.position_m[0], reported.y_m - truth.position_m[1])
    assert 0.0 < error_m < 0.05 * truth.odometry.distance_m


def test_pushed_sideways_it_slides_and_its_wheels_do_not_notice(make: Make) -> None:
    world = make()
    world.run(0.2)
    for _ in range(120):
        position, _ = world.robot.pose()
        pybullet.applyExternalForce(
            world.robot.body, -1, (0, 600, 0), position, pybullet.WORLD_FRAME, physicsClientId=world.client
        )
        world.run(world.dt_s)
    truth = world.truth()
    assert truth.position_m[1] > 0.1
    assert abs(truth.odometry.T_odom_base.y_m) < 0.05


@pytest.mark.parametrize(("side", "centre"), [("front", (0.6, 0.0)), ("rear", (-0.6, 0.0))])
def test_the_pushed_bumper_reports_contact_and_releases(make: Make, side: str, centre: tuple[float, float]) -> None:
    world = make()
    world.box((*centre, 0.5), (0.1, 2.0, 1.0), grip=0.1)
    world.go()
    sign = 1.0 if side == "front" else -1.0
    assert getattr(world.run(1.5, 0.3 * sign).bumpers, side)
    assert world.run(1.5, -0.3 * sign).bumpers == Bumpers()


@pytest.mark.slow
def test_driving_draws_the_battery_down_faster_than_standing(make: Make) -> None:
    standing, driving = make().go(), make()
    driving.ramp(0.5, 8.0, 30.0)
    driving.go()
    left = [world.run(5.0, v).battery.soc_percent for world, v in ((standing, 0.0), (driving, 1.0))]
    assert 100.0 > left[0] > left[1]


@pytest.mark.slow
def test_severe_odometry_noise_moves_the_report_away_and_none_does_not(make: Make) -> None:
    world = make().go()
    exact, severe = CarterSensors(world.robot), CarterSensors(world.robot, odometry_noise="severe", seed=3)
    for step in range(1, 81):
        truth = world.run(0.1, 1.0)
        readings = [sensors.read(step * 0.1).T_odom_base for sensors in (exact, severe)]
    assert readings[0] == truth.odometry.T_odom_base
    assert math.hypot(readings[1].x_m - readings[0].x_m, readings[1].y_m - readings[0].y_m) > 0.05


def test_the_gyroscope_feels_the_turn_and_the_accelerometer_the_start(make: Make) -> None:
    world = make().go()
    assert world.run(0.5, 1.0).accel_mps2[0] == pytest.approx(1.0, abs=0.15)
    sensors = CarterSensors(world.robot, seed=5)
    world.run(1.5, 0.0, 1.0)
    assert sensors.read(1.0).gyro_radps[2] == pytest.approx(1.0, abs=0.03)
    assert sensors.read(1.0).wheel_radps[1] == pytest.approx(1.0 * 0.207 / WHEEL_RADIUS_M, abs=0.1)
