"""The wheeled base's drive electronics, odometry and battery without physics."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_hil.robots.carter.battery import CAPACITY_WH, ELECTRONICS_W, CarterBattery, load_w
from sim_hil.robots.carter.drive import (
    ACCEL_MPS2,
    ALPHA_RADPS2,
    BRAKE_MPS2,
    COUNTS_PER_TURN,
    HOLD_S,
    MAX_TORQUE_NM,
    NO_LOAD_RADPS,
    V_MAX_MPS,
    W_MAX_RADPS,
    DriveController,
    WheelCalibration,
    WheelOdometry,
)  # fmt: skip
from sim_hil.robots.carter.urdf import TRACK_M, WHEEL_RADIUS_M

DT_S = 1 / 240


class IdealWheels:
    """A controller whose wheels do exactly what its reference says."""

    def __init__(self) -> None:
        self.controller = DriveController(DT_S)
        self.controller.powered = True
        self.references: list[tuple[float, float]] = []

    def run(self, seconds: float) -> tuple[float, float]:
        for _ in range(round(seconds / DT_S)):
            v, w = self.controller.reference
            half = TRACK_M / 2
            self.controller.step((v - w * half) / WHEEL_RADIUS_M, (v + w * half) / WHEEL_RADIUS_M)
            self.references.append(self.controller.reference)
        return self.controller.reference


@given(st.floats(-100, 100), st.floats(-100, 100))
def test_the_reference_goes_where_the_command_points_and_never_beyond_the_limits(v: float, w: float) -> None:
    wheels = IdealWheels()
    for _ in range(4):
        wheels.controller.command(v, w)
        wheels.run(0.5)
    expected = (max(-V_MAX_MPS, min(V_MAX_MPS, v)), max(-W_MAX_RADPS, min(W_MAX_RADPS, w)))
    assert wheels.controller.reference == pytest.approx(expected)


@given(st.lists(st.tuples(st.floats(-2, 2), st.floats(-3, 3)), min_size=1, max_size=6))
def test_the_reference_never_changes_faster_than_the_limits(commands: list[tuple[float, float]]) -> None:
    wheels = IdealWheels()
    for v, w in commands:
        wheels.controller.command(v, w)
        wheels.run(0.1)
    before = (0.0, 0.0)
    for now in wheels.references:
        speeding_up = abs(now[0]) > abs(before[0])
        most = (ACCEL_MPS2 if speeding_up else BRAKE_MPS2) * DT_S
        assert abs(now[0] - before[0]) <= most + 1e-9
        assert abs(now[1] - before[1]) <= ALPHA_RADPS2 * DT_S + 1e-9
        before = now


def test_a_command_is_obeyed_for_one_second() -> None:
    wheels = IdealWheels()
    wheels.controller.command(0.5, 0.0)
    wheels.run(HOLD_S - 2 * DT_S)
    assert wheels.controller.commanded == (0.5, 0.0)
    wheels.run(4 * DT_S)
    assert wheels.controller.commanded == (0.0, 0.0)
    assert wheels.run(1.0) == (0.0, 0.0)


@pytest.mark.parametrize("command", [(math.nan, 0.0), (0.0, math.nan), (math.inf, 0.0), (0.0, -math.inf)])
def test_a_command_that_is_no_number_is_refused_and_changes_nothing(command: tuple[float, float]) -> None:
    wheels = IdealWheels()
    wheels.controller.command(0.3, 0.1)
    with pytest.raises(ValueError, match="finite"):
        wheels.controller.command(*command)
    assert wheels.controller.commanded == (0.3, 0.1)


def test_without_power_it_obeys_nothing() -> None:
    wheels = IdealWheels()
    wheels.controller.powered = False
    wheels.controller.command(0.5, 0.5)
    assert wheels.run(0.5) == (0.0, 0.0)


def test_an_emergency_stop_brakes_harder_than_a_command_to_stop() -> None:
    def stopping_s(stop: bool) -> float:
        wheels = IdealWheels()
        for _ in range(3):
            wheels.controller.command(1.5, 0.0)
            wheels.run(0.9)
        wheels.controller.estop = stop
        wheels.controller.command(0.0, 0.0)
        steps = 0
        while wheels.controller.reference != (0.0, 0.0):
            wheels.run(DT_S)
            steps += 1
        return steps * DT_S

    assert stopping_s(True) == pytest.approx(1.5 / 2.5, abs=0.02)
    assert stopping_s(False) == pytest.approx(1.5 / 2.0, abs=0.02)


@given(st.floats(-60, 60), st.floats(-60, 60))
def test_a_motor_never_gives_more_than_its_limit_nor_drives_beyond_its_top_speed(left: float, right: float) -> None:
    controller = DriveController(DT_S)
    for torque, speed in zip(controller.step(left, right), (left, right), strict=True):
        assert abs(torque) <= MAX_TORQUE_NM
        if abs(speed) >= NO_LOAD_RADPS:
            assert torque * speed <= 0.0


def test_a_blocked_wheel_is_released_by_a_stop() -> None:
    controller = DriveController(DT_S)
    controller.powered = True
    for _ in range(480):
        controller.command(0.5, 0.0)
        pushing, _ = controller.step(0.0, 0.0)
    assert pushing == MAX_TORQUE_NM and controller.saturated
    controller.command(0.0, 0.0)
    for _ in range(240):
        resting, _ = controller.step(0.0, 0.0)
    assert resting == 0.0


@given(st.floats(-2, 2), st.floats(-2, 2))
def test_odometry_of_a_steady_arc_is_that_arc(v: float, w: float) -> None:
    odometry, steps = WheelOdometry(), 480
    for step in range(1, steps + 1):
        time_s = step * DT_S
        left, right = (v - w * TRACK_M / 2) / WHEEL_RADIUS_M, (v + w * TRACK_M / 2) / WHEEL_RADIUS_M
        odometry.step(left * time_s, right * time_s)
    turned = w * steps * DT_S
    radius = v / w if abs(w) > 1e-6 else 0.0
    x = radius * math.sin(turned) if radius else v * steps * DT_S * math.cos(turned / 2)
    y = radius * (1 - math.cos(turned)) if radius else v * steps * DT_S * math.sin(turned / 2)
    found = odometry.sample(0.0, 0.0).T_odom_base
    # A count is 0.2 mm of way, and as much between the wheels 0.5 mrad.
    assert (found.x_m, found.y_m) == pytest.approx((x, y), abs=0.01)
    assert found.theta_rad == pytest.approx(turned, abs=0.002)


def test_encoders_count_whole_steps_of_a_turn() -> None:
    odometry = WheelOdometry()
    odometry.step(2 * math.pi + 1e-6, -1e-6)
    sample = odometry.sample(0.0, 0.0)
    assert (sample.left_counts, sample.right_counts) == (COUNTS_PER_TURN, -1)


def test_wheels_of_another_size_than_believed_make_odometry_drift() -> None:
    believed = WheelCalibration(left_radius_m=WHEEL_RADIUS_M * 0.999, right_radius_m=WHEEL_RADIUS_M * 1.001)
    odometry = WheelOdometry(believed)
    for step in range(1, 2001):
        odometry.step(step * 0.05, step * 0.05)
    found = odometry.sample(0.0, 0.0)
    assert found.distance_m == pytest.approx(2000 * 0.05 * WHEEL_RADIUS_M, rel=1e-3)
    assert found.T_odom_base.theta_rad == pytest.approx(found.distance_m * 0.002 / TRACK_M, rel=0.02)


def test_a_full_battery_lasts_as_long_as_its_energy() -> None:
    battery, hours = CarterBattery(), 0.0
    while battery.read().soc_percent > 0.0:
        battery.draw(ELECTRONICS_W + 30.0, 60.0)
        hours += 1 / 60
    # The maker's "over 8 hours"; the pack's mean voltage lies a percent below its nominal one.
    assert hours == pytest.approx(CAPACITY_WH / (ELECTRONICS_W + 30.0), rel=0.03)
    assert hours > 8.0


def test_driving_takes_more_than_standing_and_braking_gives_nothing_back() -> None:
    assert load_w(0.0, 0.0, 0.0, 0.0) == load_w(-5.0, 3.0, -5.0, 3.0) == ELECTRONICS_W
    assert load_w(5.0, 3.0, 5.0, 3.0) > ELECTRONICS_W


def test_the_current_is_a_mean_over_time_at_any_reading_rate() -> None:
    asked, silent = CarterBattery(), CarterBattery()
    for step in range(48):  # 0.1 s of nothing, then 0.1 s of 400 W in every second step
        power_w = 400.0 if step >= 24 and step % 2 else 0.0
        for battery in (asked, silent):
            battery.draw(power_w, 1 / 240)
        assert asked.read() == asked.read()
    found = silent.read()
    assert asked.read() == found
    assert found.current_a == pytest.approx(200.0 / 41.5, rel=1e-3)
