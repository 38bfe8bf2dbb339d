"""Newest reports of a rover joined to one state a step: order, age, jumps, quality and the source of each number."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from firmware_bridge.core.robot_state import RobotState
from firmware_bridge.mavlink import modes
from firmware_bridge.mavlink.clock import VehicleClock
from firmware_bridge.mavlink.mode_watch import ModeWatch
from firmware_bridge.mavlink.odometry import BAD_ESTIMATE, CRITICAL, JUMPED, NO_HEARTBEAT, OdometryInput

MS = 1_000_000
S = 1_000_000_000
OFFBOARD = 6 << 16


class Rover:
    """Reports into one OdometryInput, of a rover whose clock is that of the test."""

    def __init__(self, accepted: tuple[int, ...] = (0,)) -> None:
        self.input, self.clock, self.watch = OdometryInput(accepted), VehicleClock(), ModeWatch(modes.PX4)
        self.watch.heartbeat(12, OFFBOARD, 128, 4, 0)

    def synchronise(self, now_ns: int) -> None:
        assert self.clock.due(now_ns)
        self.clock.answer(now_ns, now_ns, now_ns)

    def take(self, message: object, now_ns: int) -> bool:
        return self.input.take(message, now_ns, self.clock)

    def odometry(self, now_ns: int, stamp_ns: int | None = None, **values: object) -> bool:
        given: dict[str, object] = {"x": 0.0, "vx": 0.0, "yawspeed": 0.0, "quality": 0, "reset_counter": 0, **values}
        message = dialect.MAVLink_odometry_message(
            (now_ns if stamp_ns is None else stamp_ns) // 1000, 20, 12, given["x"], 0.0, 0.0, (1.0, 0.0, 0.0, 0.0),
            given["vx"], 0.0, 0.0, 0.0, 0.0, given["yawspeed"], [math.nan] * 21, [math.nan] * 21,
            given["reset_counter"], 0, given["quality"],
        )  # fmt: skip
        return self.take(message, now_ns)

    def position(self, now_ns: int, x: float) -> bool:
        message = dialect.MAVLink_local_position_ned_message(now_ns // MS, x, 0.0, 0.0, 0.0, 0.0, 0.0)
        return self.take(message, now_ns)

    def attitude(self, now_ns: int, yaw_rate: float = 0.0) -> bool:
        return self.take(dialect.MAVLink_attitude_message(now_ns // MS, 0.0, 0.0, 0.0, 0.0, 0.0, yaw_rate), now_ns)

    def estimator(self, flags: int, now_ns: int) -> bool:
        return self.take(dialect.MAVLink_estimator_status_message(0, flags, 0, 0, 0, 0, 0, 0, 0, 0), now_ns)

    def state(self, *, lost: bool = False) -> RobotState | None:
        return self.input.state(self.watch, lost=lost)

    def error(self, *, lost: bool = False) -> int:
        state = self.state(lost=lost)
        assert state is not None
        return int(state.error_code)


@given(stamps=st.lists(st.integers(0, 400), min_size=1, max_size=30))
def test_stamps_of_states_only_grow_in_any_order_of_arrival(stamps: list[int]) -> None:
    rover, newest = Rover(), -1
    for at, stamp in enumerate(stamps):
        rover.odometry(10 * S + at * MS, 9 * S + stamp * MS)
        state = rover.state()
        assert (state is not None) is (stamp > newest)
        newest = max(newest, stamp)


def test_a_repeated_report_gives_no_second_state() -> None:
    rover = Rover()
    rover.odometry(10 * S)
    assert rover.state() is not None
    rover.odometry(10 * S + MS, 10 * S)
    assert rover.state() is None


@given(age_ms=st.integers(0, 3000))
def test_a_report_that_is_half_a_second_old_gives_no_state(age_ms: int) -> None:
    rover = Rover()
    rover.synchronise(10 * S)
    rover.odometry(10 * S, 10 * S - age_ms * MS)
    assert (rover.state() is not None) is (age_ms <= 500)


def test_no_state_is_given_before_the_first_heartbeat() -> None:
    rover = Rover()
    rover.watch = ModeWatch(modes.PX4)
    rover.odometry(10 * S)
    assert rover.state() is None


def test_position_and_attitude_replace_missing_odometry() -> None:
    rover = Rover()
    rover.attitude(10 * S)
    rover.position(10 * S, 3.0)
    state = rover.state()
    assert state is not None and state.T_odom_base[0] == 3.0


def test_a_position_without_a_recent_attitude_gives_no_state() -> None:
    rover = Rover()
    rover.attitude(10 * S)
    rover.position(10 * S + 250 * MS, 3.0)
    assert rover.state() is None


def test_odometry_is_preferred_to_a_position() -> None:
    rover = Rover()
    rover.odometry(10 * S, x=1.0)
    rover.attitude(10 * S)
    rover.position(10 * S + 20 * MS, 3.0)
    state = rover.state()
    assert state is not None and state.T_odom_base[0] == 1.0


def test_a_failed_odometry_gives_no_state() -> None:
    rover = Rover()
    assert not rover.odometry(10 * S, quality=-1)
    assert rover.state() is None


def test_a_jump_of_the_odometry_is_an_error_for_a_second() -> None:
    rover, errors = Rover(), []
    for step in range(14):
        rover.odometry(10 * S + step * 100 * MS, reset_counter=int(step > 1))
        errors.append(rover.error())
    assert errors == [0, 0] + [JUMPED] * 10 + [0, 0]


@pytest.mark.parametrize(("flags", "error"), [(1 | 2 | 8, 0), (1 | 2, BAD_ESTIMATE), (1 | 2 | 16 | 1024, BAD_ESTIMATE)])
def test_the_estimators_flags_become_an_error(flags: int, error: int) -> None:
    rover = Rover()
    rover.estimator(flags, 10 * S)
    rover.odometry(10 * S + MS)
    assert rover.error() == error


def test_good_flags_end_the_error() -> None:
    rover = Rover()
    rover.estimator(1, 10 * S)
    rover.estimator(1 | 2 | 8, 10 * S + MS)
    rover.odometry(10 * S + 2 * MS)
    assert rover.error() == 0


def test_a_failsafe_in_the_setpoint_mode_is_an_error() -> None:
    rover = Rover()
    rover.watch.heartbeat(12, OFFBOARD, 128, 5, S)
    rover.odometry(10 * S)
    assert rover.error() == CRITICAL


@pytest.mark.parametrize(
    ("accepted", "lost", "error"),
    [((0,), False, BAD_ESTIMATE), ((0, BAD_ESTIMATE), False, CRITICAL), ((0, BAD_ESTIMATE), True, NO_HEARTBEAT)],
)
def test_an_accepted_error_hides_no_other_one(accepted: tuple[int, ...], lost: bool, error: int) -> None:
    rover = Rover(accepted)
    rover.watch.heartbeat(12, OFFBOARD, 128, 5, S)
    rover.estimator(1, 10 * S)
    rover.odometry(10 * S)
    assert rover.error(lost=lost) == error


def test_missing_heartbeats_are_an_error() -> None:
    rover = Rover()
    rover.odometry(10 * S)
    assert rover.error(lost=True) == NO_HEARTBEAT


def test_the_gyro_is_that_of_an_attitude_of_the_same_time() -> None:
    rover = Rover()
    rover.attitude(10 * S, yaw_rate=-0.5)
    for at_ns, expected in ((10 * S, 0.5), (10 * S + 60 * MS, 0.1)):
        rover.odometry(at_ns, yawspeed=-0.1)
        state = rover.state()
        assert state is not None and state.gyro_wz_radps == pytest.approx(expected)


def test_the_battery_of_the_status_counts_only_without_a_battery_report() -> None:
    rover = Rover()
    cells = [8000] * 3 + [65535] * 7
    rover.take(dialect.MAVLink_battery_status_message(0, 0, 0, 0, cells, 0, -1, -1, 73), 10 * S)
    rover.take(dialect.MAVLink_sys_status_message(0, 0, 0, 0, 24000, 0, 20, 0, 0, 0, 0, 0, 0), 11 * S)
    battery = rover.input.take_battery()
    assert battery is not None and battery.soc_percent == 73


@pytest.mark.parametrize(("vx", "age_ms", "stands"), [(0.0, 0, True), (0.3, 0, False), (0.0, 300, False)])
def test_a_rover_stands_only_by_a_fresh_report(vx: float, age_ms: int, stands: bool) -> None:
    rover = Rover()
    rover.odometry(10 * S, vx=vx)
    rover.state()
    assert rover.input.stands(10 * S + age_ms * MS) is stands
