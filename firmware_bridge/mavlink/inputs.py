"""Reports of an autopilot as the bridge's own values, checked field by field. Pure.

MAVLink's axes are x forward, y right, z down, with a yaw that grows to the right; the bridge's are x forward, y left,
z up, with a yaw that grows to the left. A report with one impossible number is dropped whole.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from firmware_bridge.core.robot_state import BatteryState, within
from firmware_bridge.mavlink.wire import Message

# Far beyond what a rover can do, far below what would break arithmetic: these find garbage, not bad driving.
MAX_POSITION_M: Final = 1e6
MAX_SPEED_MPS: Final = 30.0
MAX_TURN_RADPS: Final = 50.0
MAX_VOLTAGE_V: Final = 1000.0
MAX_CURRENT_A: Final = 1000.0
_MAX_ANGLE_RAD: Final = 2 * math.pi
_NORM_TOLERANCE: Final = 0.05
_FRAMES: Final = (1, 20)  # MAV_FRAME_LOCAL_NED, MAV_FRAME_LOCAL_FRD; PX4 reports the velocity in them too
_BODY_FRAMES: Final = (8, 12)  # MAV_FRAME_BODY_NED in older firmware, MAV_FRAME_BODY_FRD
_FAILED_QUALITY: Final = -1
_NO_VOLTAGE: Final = 65535
_MAX_CELLS: Final = 10
# Bits of ESTIMATOR_STATUS and EKF_STATUS_REPORT, equal in both.
_ATTITUDE: Final = 1
_VELOCITY: Final = 2
_POSITION: Final = 8 | 16  # relative or absolute
_CONSTANT_POSITION: Final = 128  # nothing but the assumption that the rover stands
_ESTIMATOR_FAULTS: Final = 1024 | 2048  # of ESTIMATOR_STATUS: GPS glitch, accelerometer error
_EKF_FAULTS: Final = 1024 | 32768  # of EKF_STATUS_REPORT: not initialised, GPS glitch


@dataclass(frozen=True)
class Motion:
    """One odometry report in the bridge's axes; `stamp_ns`: the rover's clock; `resets`: its counter of jumps."""

    stamp_ns: int
    T_odom_base: tuple[float, float, float]
    vx_mps: float
    vy_mps: float
    wz_radps: float
    position_z_m: float
    roll_rad: float
    pitch_rad: float
    resets: int = 0


@dataclass(frozen=True)
class Attitude:
    """One ATTITUDE in the bridge's axes."""

    stamp_ns: int
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    wz_radps: float


def motion_of_odometry(message: Message) -> Motion | None:
    """Convert an ODOMETRY; None when a field cannot be true, for other frames, and for an estimator that has failed.

    The velocity is in the body frame, or in the frame of the pose; the rates are those of the body in both cases.
    """
    size = math.hypot(*message.q)
    frame, child = message.frame_id, message.child_frame_id
    frames = frame in _FRAMES and child in (*_BODY_FRAMES, frame)
    if not within(_NORM_TOLERANCE, size - 1.0) or not frames or message.quality == _FAILED_QUALITY:
        return None
    w, x, y, z = (each / size for each in message.q)
    velocity = (message.vx, message.vy, message.vz)
    if child == frame:
        velocity = _into_body((w, x, y, z), velocity)
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    motion = Motion(
        message.time_usec * 1000,
        (message.x, -message.y, -yaw),
        velocity[0],
        -velocity[1],
        -message.yawspeed,
        -message.z,
        roll,
        -pitch,
        message.reset_counter,
    )
    return motion if _is_possible(motion) else None


def motion_of_position(message: Message, attitude: Attitude) -> Motion | None:
    """Convert a LOCAL_POSITION_NED with the newest attitude; None when a field cannot be true."""
    theta = attitude.yaw_rad
    cos, sin = math.cos(theta), math.sin(theta)
    north, west = message.vx, -message.vy
    motion = Motion(
        message.time_boot_ms * 1_000_000,
        (message.x, -message.y, theta),
        cos * north + sin * west,
        cos * west - sin * north,
        attitude.wz_radps,
        -message.z,
        attitude.roll_rad,
        attitude.pitch_rad,
    )
    return motion if _is_possible(motion) else None


def attitude_of(message: Message) -> Attitude | None:
    """Convert an ATTITUDE; None when a field cannot be true."""
    angles, rates = (message.roll, message.pitch, message.yaw), (message.rollspeed, message.pitchspeed)
    if not (within(_MAX_ANGLE_RAD, *angles) and within(MAX_TURN_RADPS, *rates, message.yawspeed)):
        return None
    return Attitude(message.time_boot_ms * 1_000_000, message.roll, -message.pitch, -message.yaw, -message.yawspeed)


def battery_of(message: Message, received_ns: int) -> BatteryState | None:
    """Convert a BATTERY_STATUS; None for an unknown charge and when a field cannot be true."""
    cells = [each for each in message.voltages[:_MAX_CELLS] if 0 < each < _NO_VOLTAGE]
    return _battery(received_ns, message.battery_remaining, sum(cells) / 1e3, message.current_battery)


def battery_of_status(message: Message, received_ns: int) -> BatteryState | None:
    """Convert the battery part of a SYS_STATUS; None for an unknown charge and when a field cannot be true."""
    millivolts = 0 if message.voltage_battery == _NO_VOLTAGE else message.voltage_battery
    return _battery(received_ns, message.battery_remaining, millivolts / 1e3, message.current_battery)


def is_estimate_good(flags: int, *, is_ekf: bool) -> bool:
    """Return whether an estimator has attitude, velocity and position and reports no fault of a sensor.

    `is_ekf`: the flags are those of EKF_STATUS_REPORT, else of ESTIMATOR_STATUS.
    """
    whole = flags & _ATTITUDE and flags & _VELOCITY and flags & _POSITION
    bad = _CONSTANT_POSITION | (_EKF_FAULTS if is_ekf else _ESTIMATOR_FAULTS)
    return bool(whole) and not flags & bad


def _battery(received_ns: int, percent: int, voltage_v: float, centiamperes: int) -> BatteryState | None:
    current_a = 0.0 if centiamperes == -1 else centiamperes / 100  # -1: the autopilot does not measure it
    possible = 0 <= percent <= 100 and within(MAX_VOLTAGE_V, voltage_v) and within(MAX_CURRENT_A, current_a)
    return BatteryState(received_ns, percent, voltage_v, current_a) if possible else None


def _into_body(q: tuple[float, float, float, float], vector: tuple[float, float, float]) -> tuple[float, float, float]:
    """Rotate a vector of the local frame into the body frame by the unit quaternion of the rover's attitude."""
    w, x, y, z = q
    a, b, c = vector
    # Twice the product of the inverse rotation's axis and the vector.
    i, j, k = 2 * (z * b - y * c), 2 * (x * c - z * a), 2 * (y * a - x * b)
    return (
        a + w * i + z * j - y * k,
        b + w * j + x * k - z * i,
        c + w * k + y * i - x * j,
    )


def _is_possible(motion: Motion) -> bool:
    x_m, y_m, theta_rad = motion.T_odom_base
    return (
        within(MAX_POSITION_M, x_m, y_m, motion.position_z_m)
        and within(MAX_SPEED_MPS, motion.vx_mps, motion.vy_mps)
        and within(MAX_TURN_RADPS, motion.wz_radps)
        and within(_MAX_ANGLE_RAD, theta_rad, motion.roll_rad, motion.pitch_rad)
        and 0 <= motion.stamp_ns < 2**63
    )
