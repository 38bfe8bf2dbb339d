"""The rover's rules: who may arm and drive it, what stops it by itself. A clock of numbers, no wire."""

from __future__ import annotations

from math import radians

import pytest

from sim_hil.protocols.mavlink.parameters import Parameters
from sim_hil.protocols.mavlink.setpoints import Setpoint, Sticks
from sim_hil.protocols.mavlink.vehicle import ACCEPTED, FAILED, REJECTED, Health, Mode, Station, Vehicle
from tests.support.robot.fake_base import FakeBase

FIRST, SECOND = Station(255, ("127.0.0.1", 1)), Station(254, ("127.0.0.1", 2))
SAME_NUMBER = Station(255, ("127.0.0.1", 3))
AHEAD = Setpoint(local=False, vx_mps=0.5, vy_mps=0.0, yaw_rate_radps=0.0)


@pytest.fixture
def base() -> FakeBase:
    return FakeBase()


@pytest.fixture
def vehicle(base: FakeBase) -> Vehicle:
    return Vehicle(base, Parameters())


def driving(vehicle: Vehicle, now_s: float = 0.0) -> None:
    vehicle.heartbeat(FIRST, now_s)
    vehicle.setpoint(FIRST, AHEAD, now_s)
    assert vehicle.arm(FIRST, now_s) == ACCEPTED
    assert vehicle.set_mode(FIRST, Mode.OFFBOARD, now_s) == ACCEPTED
    vehicle.step(now_s)


def texts(vehicle: Vehicle) -> str:
    return " ".join(each.text for each in vehicle.take_texts())


def test_it_drives_only_when_armed_and_in_offboard_mode(vehicle: Vehicle, base: FakeBase) -> None:
    vehicle.setpoint(FIRST, AHEAD, 0.0)
    vehicle.step(0.0)
    assert base.velocity[0] == 0.0
    vehicle.arm(FIRST, 0.1)
    vehicle.step(0.1)
    assert base.powered and base.velocity[0] == 0.0
    vehicle.set_mode(FIRST, Mode.OFFBOARD, 0.2)
    vehicle.step(0.2)
    assert base.velocity == (0.5, 0.0, 0.0)


def test_offboard_mode_needs_setpoints(vehicle: Vehicle) -> None:
    assert vehicle.set_mode(FIRST, Mode.OFFBOARD, 0.0) == REJECTED
    vehicle.setpoint(FIRST, AHEAD, 0.0)
    assert vehicle.set_mode(FIRST, Mode.OFFBOARD, 0.6) == REJECTED


def test_setpoints_that_end_stop_it_after_half_a_second(vehicle: Vehicle, base: FakeBase) -> None:
    driving(vehicle)
    vehicle.step(0.49)
    assert base.velocity[0] == 0.5
    vehicle.step(0.51)
    assert base.velocity[0] == 0.0 and vehicle.mode is Mode.HOLD and vehicle.armed
    assert "no setpoints" in texts(vehicle)


def test_returning_setpoints_do_not_drive_it_until_offboard_mode_is_requested(vehicle: Vehicle, base: FakeBase) -> None:
    driving(vehicle)
    vehicle.step(0.6)
    vehicle.setpoint(FIRST, AHEAD, 0.7)
    vehicle.step(0.7)
    assert base.velocity[0] == 0.0


def test_a_station_that_falls_silent_stops_it_and_then_disarms_it(vehicle: Vehicle, base: FakeBase) -> None:
    driving(vehicle)
    for tenth in range(1, 60):
        now_s = tenth / 10
        vehicle.setpoint(FIRST, AHEAD, now_s)  # setpoints alone are no sign of life
        vehicle.step(now_s)
        assert (base.velocity[0] == 0.5) == (now_s <= 3.5)
        assert vehicle.armed == (now_s <= 5.5)
    sent = texts(vehicle)
    assert "lost, holding" in sent and "lost, disarmed" in sent


def test_a_second_station_may_not_drive_or_arm_or_disarm_it(vehicle: Vehicle, base: FakeBase) -> None:
    driving(vehicle)
    for other in (SECOND, SAME_NUMBER):
        vehicle.heartbeat(other, 0.1)
        assert not vehicle.setpoint(other, Setpoint(False, -1.0, 0.0), 0.1)
        assert vehicle.arm(other, 0.1) == vehicle.disarm(other, 0.1) == REJECTED
        assert not vehicle.may_change(other, 0.1)
    vehicle.step(0.1)
    assert base.velocity[0] == 0.5 and vehicle.armed


def test_a_mode_of_a_second_station_stops_it_and_refuses_the_first_ones_setpoints(
    vehicle: Vehicle, base: FakeBase
) -> None:
    driving(vehicle)
    vehicle.heartbeat(SECOND, 0.1)
    assert vehicle.set_mode(SECOND, Mode.MANUAL, 0.1) == ACCEPTED and vehicle.controller == SECOND
    assert not vehicle.setpoint(FIRST, AHEAD, 0.2)
    vehicle.step(0.2)
    assert not any(base.velocity) and vehicle.armed


def test_the_first_station_drives_again_by_setpoints_and_a_mode_of_its_own(vehicle: Vehicle, base: FakeBase) -> None:
    driving(vehicle)
    vehicle.set_mode(SECOND, Mode.HOLD, 0.1)
    vehicle.setpoint(FIRST, AHEAD, 0.2)
    assert vehicle.set_mode(FIRST, Mode.OFFBOARD, 0.2) == ACCEPTED
    vehicle.step(0.25)
    vehicle.setpoint(FIRST, AHEAD, 0.3)
    assert base.velocity[0] == 0.5


def test_a_second_station_may_take_over_after_a_disarm(vehicle: Vehicle) -> None:
    driving(vehicle)
    assert vehicle.disarm(FIRST, 1.0) == ACCEPTED
    assert vehicle.arm(SECOND, 1.1) == ACCEPTED and vehicle.controller == SECOND


def test_only_the_station_that_a_parameter_names_may_drive(base: FakeBase) -> None:
    vehicle = Vehicle(base, Parameters(MAV_GCS_SYSID=SECOND.system))
    assert vehicle.arm(FIRST, 0.0) == REJECTED and vehicle.arm(SECOND, 0.0) == ACCEPTED


def test_every_station_may_stop_it_and_it_stays_stopped_until_a_disarm(vehicle: Vehicle, base: FakeBase) -> None:
    driving(vehicle)
    vehicle.emergency_stop("test")
    assert base.stopped and not vehicle.armed
    assert vehicle.arm(FIRST, 1.0) == vehicle.arm(FIRST, 1.0, forced=True) == FAILED
    assert vehicle.disarm(FIRST, 1.1) == ACCEPTED and not base.stopped
    assert vehicle.arm(FIRST, 1.2) == ACCEPTED


def test_a_pressed_button_stops_it_and_denies_arming(vehicle: Vehicle, base: FakeBase) -> None:
    driving(vehicle)
    vehicle.button = True
    vehicle.step(0.1)
    assert base.stopped
    assert vehicle.disarm(FIRST, 0.2) == vehicle.arm(FIRST, 0.2, forced=True) == FAILED


@pytest.mark.parametrize(
    ("health", "word"), [(Health(charge=0.05), "battery low"), (Health(tilt_rad=radians(40)), "tilted by 40")]
)
def test_arming_is_refused_with_a_reason_unless_it_is_forced(vehicle: Vehicle, health: Health, word: str) -> None:
    vehicle.health = health
    assert vehicle.arm(FIRST, 0.0) == FAILED
    assert word in texts(vehicle)
    assert vehicle.arm(FIRST, 0.0, forced=True) == ACCEPTED


def test_sticks_drive_it_in_manual_mode_and_time_out(vehicle: Vehicle, base: FakeBase) -> None:
    vehicle.arm(FIRST, 0.0)
    vehicle.set_mode(FIRST, Mode.MANUAL, 0.0)
    vehicle.sticks(FIRST, Sticks(0.5, 1.0), 0.0)
    assert base.velocity == pytest.approx((0.3, 0.0, -radians(60)))
    vehicle.step(0.6)
    assert base.velocity == (0.0, 0.0, 0.0) and "no sticks" in texts(vehicle)


def test_speeds_are_limited_by_the_parameters(base: FakeBase) -> None:
    vehicle = Vehicle(base, Parameters(RO_SPEED_LIM=0.2, RO_YAW_RATE_LIM=10.0))
    driving(vehicle)
    vehicle.setpoint(FIRST, Setpoint(False, 5.0, 0.0, yaw_rate_radps=-3.0), 0.1)
    assert base.velocity == pytest.approx((0.2, 0.0, radians(10)))


def test_a_velocity_of_the_local_frame_is_followed_as_the_base_turns(vehicle: Vehicle, base: FakeBase) -> None:
    driving(vehicle)
    vehicle.setpoint(FIRST, Setpoint(local=True, vx_mps=0.5, vy_mps=0.0), 0.0)
    assert base.velocity == pytest.approx((0.5, 0.0, 0.0))
    vehicle.health = Health(yaw_rad=radians(90))  # it faces east, north is to its left
    vehicle.step(0.1)
    assert base.velocity[0] == pytest.approx(0.0, abs=1e-9) and base.velocity[2] > 1.0
