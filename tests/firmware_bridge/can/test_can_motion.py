"""Wheel odometry, and the check that command, wheels and gyroscope agree."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.can.motion import ERROR_COMMAND, ERROR_GYRO, AgreementCheck, WheelOdometry
from firmware_bridge.core.config_can import CanAgreement

TRACK_M = 0.5
MS = 1_000_000
speeds = st.floats(-1.5, 1.5)


@given(speeds, st.floats(-2, 2))
def test_equal_times_on_an_arc_end_on_its_circle(vx: float, wz: float) -> None:
    odometry = WheelOdometry(TRACK_M)
    left, right = vx - wz * TRACK_M / 2, vx + wz * TRACK_M / 2
    assert odometry.velocity(left, right) == pytest.approx((vx, wz), abs=1e-9)
    for _ in range(200):
        odometry.advance(left, right, 0.01)
    x, y, theta = odometry.T_odom_base
    if abs(wz) < 1e-6:
        assert (x, y) == pytest.approx((2 * vx, 0.0), abs=1e-3)
    else:
        assert (x, y) == pytest.approx((vx / wz * math.sin(2 * wz), vx / wz * (1 - math.cos(2 * wz))), abs=1e-3)
    assert math.remainder(theta - 2 * wz, math.tau) == pytest.approx(0.0, abs=1e-9)


@given(speeds, speeds)
def test_driving_back_the_same_way_returns_to_the_start(left: float, right: float) -> None:
    odometry = WheelOdometry(TRACK_M)
    for sign in (1, -1):
        for _ in range(50):
            odometry.advance(sign * left, sign * right, 0.02)
    assert odometry.T_odom_base == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


def first_error(
    moved: tuple[float, float], commanded: tuple[float, float] | None, gyro: float | None, limits: CanAgreement
) -> tuple[int, float] | None:
    """The error code of a lasting disagreement, and the seconds after which it came; None within 5 s."""
    check = AgreementCheck(limits)
    check.check(0, (0.0, 0.0), (0.0, 0.0), 0.0)
    for step in range(1, 251):
        if codes := check.check(step * 20 * MS, moved, commanded, gyro):
            return codes[0], step * 0.02
    return None


LIMITS = CanAgreement()


@given(speeds, st.floats(-1, 1))
def test_wheels_that_do_as_commanded_and_turn_as_the_gyroscope_says_agree(vx: float, wz: float) -> None:
    assert first_error((vx, wz), (vx, wz), wz, LIMITS) is None


@given(st.floats(0.5, 1.5))
def test_blocked_wheels_are_an_error_after_the_command_time(vx: float) -> None:
    assert first_error((0.0, 0.0), (vx, 0.0), 0.0, LIMITS) == (ERROR_COMMAND, pytest.approx(2.0, abs=0.05))


@given(st.floats(0.21, 1.5))
def test_a_drive_that_runs_away_is_an_error_after_the_command_time(vx: float) -> None:
    assert first_error((vx, 0.0), (0.0, 0.0), 0.0, LIMITS) == (ERROR_COMMAND, pytest.approx(2.0, abs=0.05))


@given(st.floats(0.4, 1.0))
def test_one_wheel_without_encoder_contradicts_the_gyroscope(vx: float) -> None:
    moved = WheelOdometry(TRACK_M).velocity(0.0, vx)
    assert first_error(moved, None, 0.0, LIMITS) == (ERROR_GYRO, pytest.approx(1.0, abs=0.05))


@given(st.floats(0.35, 2.0))
def test_wheels_that_turn_on_the_spot_without_the_base_slip(wz: float) -> None:
    assert first_error((0.0, wz), (0.0, wz), 0.0, LIMITS) == (ERROR_GYRO, pytest.approx(1.0, abs=0.05))


def test_an_unknown_command_and_an_absent_gyroscope_prove_nothing() -> None:
    assert first_error((1.0, 1.0), None, None, LIMITS) is None


def test_a_disagreement_with_a_break_is_not_an_error() -> None:
    check = AgreementCheck(LIMITS)
    for step in range(500):
        moved = (0.0, 0.0) if step % 90 else (0.5, 0.0)
        assert check.check(step * 20 * MS, moved, (0.5, 0.0), 0.0) == ()


def test_both_errors_are_reported_at_once() -> None:
    check = AgreementCheck(LIMITS)
    for step in range(151):
        codes = check.check(step * 20 * MS, (0.0, 1.0), (0.5, 0.0), 0.0)
    assert codes == (ERROR_COMMAND, ERROR_GYRO)
