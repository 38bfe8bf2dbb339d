"""What a ROS 2 base reports: only possible values become a state, whatever the bytes."""

from __future__ import annotations

import math
from dataclasses import astuple
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from firmware_bridge.ros2.messages.common import (
    Header_,
    Point_,
    Pose_,
    PoseWithCovariance_,
    Quaternion_,
    Time_,
    Twist_,
    TwistWithCovariance_,
    Vector3_,
)
from firmware_bridge.ros2.messages.navigation import Odometry_
from firmware_bridge.ros2.messages.sensors import BatteryState_, Imu_
from firmware_bridge.ros2.report import Attitude, attitude, battery_state, robot_state

HEADER = (Time_(3, 250_000_000), "odom")


def odometry(
    yaw_rad: float = 0.0,
    *,
    position: tuple[float, float, float] = (1.0, 2.0, 0.0),
    velocity: tuple[float, float, float] = (0.5, 0.0, 0.0),
    turn: float = 0.2,
    stamp: Time_ = HEADER[0],
    scale: float = 1.0,
) -> Odometry_:
    q = Quaternion_(0.0, 0.0, scale * math.sin(yaw_rad / 2), scale * math.cos(yaw_rad / 2))
    pose = PoseWithCovariance_(Pose_(Point_(*position), q), [0.0] * 36)
    twist = TwistWithCovariance_(Twist_(Vector3_(*velocity), Vector3_(0.0, 0.0, turn)), [0.0] * 36)
    return Odometry_(Header_(stamp, "odom"), "base_link", pose, twist)


def imu(roll_rad: float = 0.0, *, wz: float = 0.1, known: float = 0.0, gyro_known: float = 0.0) -> Imu_:
    q = Quaternion_(math.sin(roll_rad / 2), 0.0, 0.0, math.cos(roll_rad / 2))
    rest = [0.0] * 8
    rates, accelerations = Vector3_(0.0, 0.0, wz), Vector3_(0.0, 0.0, 9.81)
    return Imu_(Header_(*HEADER), q, [known, *rest], rates, [gyro_known, *rest], accelerations, [0.0] * 9)


def battery(percentage: float = 0.5, voltage: float = 25.0, current: float = -1.0) -> BatteryState_:
    return BatteryState_(
        Header_(*HEADER), voltage, 20.0, current, 1.0, 1.0, 1.0, percentage, 0, 0, 0, True, [], [], "", ""
    )


def test_a_report_becomes_the_state_it_describes() -> None:
    state = robot_state(odometry(math.pi / 2), 7, "body")
    assert state is not None
    assert state.T_odom_base == pytest.approx((1.0, 2.0, math.pi / 2))
    assert (state.vx_mps, state.vy_mps, state.wz_radps) == (0.5, 0.0, 0.2)
    assert state.gyro_wz_radps is None, "wheels are no gyroscope"
    assert (state.received_ns, state.robot_stamp_ns) == (7, 3_250_000_000)


def test_a_velocity_in_the_odometry_frame_is_turned_into_the_body() -> None:
    state = robot_state(odometry(math.pi / 2, velocity=(0.0, 0.5, 0.0)), 7, "odom")
    assert state is not None
    assert (state.vx_mps, state.vy_mps) == pytest.approx((0.5, 0.0))


def test_a_quaternion_that_is_nearly_normal_is_normalised() -> None:
    state = robot_state(odometry(1.0, scale=1.03), 7, "body")
    assert state is not None and state.T_odom_base[2] == pytest.approx(1.0)


def test_an_imu_gives_gyroscope_and_tilt() -> None:
    state = robot_state(odometry(), 7, "body", attitude(imu(0.6), 6))
    assert state is not None
    assert state.gyro_wz_radps == pytest.approx(0.1) and state.roll_rad == pytest.approx(0.6)


def test_an_imu_without_orientation_leaves_the_odometrys_tilt() -> None:
    assert attitude(imu(0.6, known=-1.0), 6) == Attitude(6, 0.1, None, None)


@pytest.mark.parametrize(
    "sample",
    [
        odometry(scale=0.0),
        odometry(scale=0.9),
        odometry(scale=math.nan),
        odometry(scale=1e200),
        odometry(position=(math.nan, 0.0, 0.0)),
        odometry(position=(2e6, 0.0, 0.0)),
        odometry(velocity=(21.0, 0.0, 0.0)),
        odometry(velocity=(0.0, math.inf, 0.0)),
        odometry(turn=51.0),
        odometry(stamp=Time_(-1, 0)),
        odometry(stamp=Time_(0, 1_000_000_000)),
    ],
    ids=lambda sample: "",
)
def test_an_impossible_odometry_is_no_state(sample: Odometry_) -> None:
    assert robot_state(sample, 7, "body") is None


@pytest.mark.parametrize("sample", [imu(wz=math.nan), imu(wz=60.0), imu(gyro_known=-1.0), imu(math.nan)])
def test_an_impossible_or_useless_imu_report_is_none(sample: Imu_) -> None:
    assert attitude(sample, 7) is None


def test_a_charge_is_a_share_and_unmeasured_values_are_zero() -> None:
    found = battery_state(battery(0.29, math.nan, math.nan), 7)
    assert found is not None and (found.soc_percent, found.voltage_v, found.current_a) == (29, 0.0, 0.0)


@pytest.mark.parametrize("share", [math.nan, -0.1, 1.5, 29.0, math.inf])
def test_a_charge_that_is_no_share_is_no_report(share: float) -> None:
    assert battery_state(battery(share), 7) is None


def finite(value: Any) -> bool:
    if isinstance(value, tuple):
        return all(map(finite, value))
    return value is None or math.isfinite(value)


CONVERTERS = {
    Odometry_: (lambda sample: robot_state(sample, 7, "odom", Attitude(1, 0.0, None, None)), odometry()),
    Imu_: (lambda sample: attitude(sample, 7), imu()),
    BatteryState_: (lambda sample: battery_state(sample, 7), battery()),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", CONVERTERS, ids=lambda kind: kind.__name__)
def test_any_changed_bytes_are_refused_or_become_finite_values(kind: type) -> None:
    """Bytes of a valid message with some of them replaced: they reach the conversion far more often than any bytes."""
    convert, valid = CONVERTERS[kind]
    good = valid.serialize()

    @settings(max_examples=300)
    @given(st.lists(st.tuples(st.integers(4, len(good) - 1), st.binary(min_size=1, max_size=8)), max_size=6))
    @example([])
    def holds(changes: list[tuple[int, bytes]]) -> None:
        data = bytearray(good)
        for at, replacement in changes:
            data[at : at + len(replacement)] = replacement
        try:
            sample = kind.deserialize(bytes(data))
        except Exception:  # noqa: BLE001 - as `take_each`, which counts what does not decode
            return
        found = convert(sample)
        assert found is None or finite(astuple(found))

    holds()
