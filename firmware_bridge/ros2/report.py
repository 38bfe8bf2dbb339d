"""What a ROS 2 base reports, checked field by field: its publishers are untrusted.

A message with one impossible number is dropped whole; the link counts it. Frames: `T_odom_base` is the pose in the
header's frame; REP 103 axes, x forward, y left, z up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from firmware_bridge.core.robot_state import BatteryState, RobotState, within
from firmware_bridge.ros2.messages.common import Quaternion_, Time_
from firmware_bridge.ros2.messages.navigation import Odometry_
from firmware_bridge.ros2.messages.sensors import BatteryState_, Imu_
from firmware_bridge.ros2.table import MODE

# Far beyond what the machine can do, far below what would break arithmetic: these find garbage, not bad driving.
MAX_POSITION_M: Final = 1e6
MAX_SPEED_MPS: Final = 20.0
MAX_TURN_RADPS: Final = 50.0
MAX_VOLTAGE_V: Final = 1000.0
MAX_CURRENT_A: Final = 1000.0
_NORM_TOLERANCE: Final = 0.05
_NO_FEET: Final = (0, 0, 0, 0)
_UNKNOWN: Final = -1.0  # first covariance of a quantity that an Imu message does not contain
_NS_PER_S: Final = 1_000_000_000


@dataclass(frozen=True)
class Attitude:
    """One IMU report; `roll_rad` and `pitch_rad` are None where the IMU estimates no orientation."""

    received_ns: int
    wz_radps: float
    roll_rad: float | None
    pitch_rad: float | None


def robot_state(
    sample: Odometry_, received_ns: int, velocity_frame: str, attitude: Attitude | None = None
) -> RobotState | None:
    """Convert an Odometry; None when a field of it cannot be true.

    `velocity_frame`: "body" for the message's definition (the twist is in the child frame), "odom" for a base that
    reports it in the header's frame. `attitude`: the IMU's newest report, for gyroscope, roll and pitch; without it
    there is no gyroscope, and the odometry's own orientation stands for roll and pitch.
    """
    position, twist = sample.pose.pose.position, sample.twist.twist
    rpy, stamp_ns = rpy_rad(sample.pose.pose.orientation), stamp_ns_of(sample.header.stamp)
    linear, angular = twist.linear, twist.angular
    possible = (
        within(MAX_POSITION_M, position.x, position.y, position.z)
        and within(MAX_SPEED_MPS, linear.x, linear.y, linear.z)
        and within(MAX_TURN_RADPS, angular.x, angular.y, angular.z)
    )
    if rpy is None or stamp_ns is None or not possible:
        return None
    roll_rad, pitch_rad, theta_rad = rpy
    vx_mps, vy_mps = linear.x, linear.y
    if velocity_frame == "odom":
        cos, sin = math.cos(theta_rad), math.sin(theta_rad)
        vx_mps, vy_mps = cos * vx_mps + sin * vy_mps, cos * vy_mps - sin * vx_mps
    gyro_wz_radps = None if attitude is None else attitude.wz_radps
    if attitude is not None and attitude.roll_rad is not None and attitude.pitch_rad is not None:
        roll_rad, pitch_rad = attitude.roll_rad, attitude.pitch_rad
    pose = (position.x, position.y, theta_rad)
    motion = (received_ns, pose, vx_mps, vy_mps, angular.z)
    return RobotState(*motion, MODE, 0, stamp_ns, position.z, roll_rad, pitch_rad, gyro_wz_radps, _NO_FEET)


def attitude(sample: Imu_, received_ns: int) -> Attitude | None:
    """Convert an Imu; None when a field of it cannot be true. The IMU's axes must be those of the base."""
    rates, accelerations = sample.angular_velocity, sample.linear_acceleration
    if not within(MAX_TURN_RADPS, rates.x, rates.y, rates.z):
        return None
    if not all(map(math.isfinite, (accelerations.x, accelerations.y, accelerations.z))):
        return None
    if sample.angular_velocity_covariance[0] == _UNKNOWN:
        return None  # without a gyroscope it is of no use here
    q = sample.orientation
    if sample.orientation_covariance[0] == _UNKNOWN or not any((q.x, q.y, q.z, q.w)):
        return Attitude(received_ns, rates.z, None, None)
    rpy = rpy_rad(q)
    return None if rpy is None else Attitude(received_ns, rates.z, rpy[0], rpy[1])


def battery_state(sample: BatteryState_, received_ns: int) -> BatteryState | None:
    """Convert a BatteryState; None when a field of it cannot be true or the charge is not measured.

    Voltage and current are 0 where the base does not measure them (NaN).
    """
    voltage_v, current_a = (0.0 if math.isnan(value) else value for value in (sample.voltage, sample.current))
    possible = 0.0 <= sample.percentage <= 1.0 and 0.0 <= voltage_v <= MAX_VOLTAGE_V  # False for NaN
    if not possible or not within(MAX_CURRENT_A, current_a):
        return None
    percent = int(100 * sample.percentage + 0.001)  # a 32-bit 0.29 is a little less than 0.29
    return BatteryState(received_ns, percent, voltage_v, current_a)


def stamp_ns_of(stamp: Time_) -> int | None:
    """Return a header's stamp in ns; None when it cannot be one."""
    if stamp.sec < 0 or stamp.nanosec >= _NS_PER_S:
        return None
    return stamp.sec * _NS_PER_S + stamp.nanosec


def rpy_rad(q: Quaternion_) -> tuple[float, float, float] | None:
    """Return roll, pitch and yaw of a quaternion, rad, after normalising it; None when it is none."""
    if not within(1.0 + _NORM_TOLERANCE, q.x, q.y, q.z, q.w):  # also finite, so that the norm is
        return None
    norm = math.hypot(q.x, q.y, q.z, q.w)
    if abs(norm - 1.0) > _NORM_TOLERANCE:
        return None
    x, y, z, w = q.x / norm, q.y / norm, q.z / norm, q.w / norm
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
