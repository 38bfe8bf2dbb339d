"""What a Go2 reports, checked field by field: the robot is an untrusted peer (faults table, "Unitree, known hazards").

A report with one impossible number is dropped whole; the reader counts it and, without better ones, reports silence.
"""

from __future__ import annotations

import math
from typing import Final

from firmware_bridge.core.robot_state import BatteryState, RobotState, within
from firmware_bridge.unitree.messages.idl import SportModeState_
from firmware_bridge.unitree.messages.idl_low import LowState_
from firmware_bridge.unitree.messages.ids import LAST_MODE

# Far beyond what the machine can do, far below what would break arithmetic: these find garbage, not bad driving.
MAX_POSITION_M: Final = 1e6
MAX_SPEED_MPS: Final = 20.0
MAX_TURN_RADPS: Final = 50.0
MAX_ANGLE_RAD: Final = 2 * math.pi
MAX_VOLTAGE_V: Final = 100.0
MAX_CURRENT_A: Final = 200.0
_NORM_TOLERANCE: Final = 0.05
_NS_PER_S: Final = 1_000_000_000


def robot_state(sample: SportModeState_, received_ns: int, velocity_frame: str) -> RobotState | None:
    """Convert a `rt/sportmodestate` sample; None when a field of it cannot be true.

    `velocity_frame` is the frame of `sample.velocity`: the maker's simulator reports it in the odometry frame.
    """
    imu, stamp = sample.imu_state, sample.stamp
    (x_m, y_m, z_m), (roll_rad, pitch_rad, theta_rad) = sample.position, imu.rpy
    vx_mps, vy_mps, vz_mps = sample.velocity
    possible = (
        within(MAX_POSITION_M, x_m, y_m, z_m)
        and within(MAX_SPEED_MPS, vx_mps, vy_mps, vz_mps)
        and within(MAX_ANGLE_RAD, roll_rad, pitch_rad, theta_rad)
        and within(MAX_TURN_RADPS, sample.yaw_speed, *imu.gyroscope)
        and within(_NORM_TOLERANCE, math.hypot(*imu.quaternion) - 1.0)
        and (sample.mode <= LAST_MODE and stamp.sec >= 0 and stamp.nanosec < _NS_PER_S)
    )
    if not possible:
        return None
    if velocity_frame == "odom":
        cos, sin = math.cos(theta_rad), math.sin(theta_rad)
        vx_mps, vy_mps = cos * vx_mps + sin * vy_mps, cos * vy_mps - sin * vx_mps
    motion = (received_ns, (x_m, y_m, theta_rad), vx_mps, vy_mps, sample.yaw_speed)
    attitude = (z_m, roll_rad, pitch_rad, imu.gyroscope[2])
    fr, fl, rr, rl = sample.foot_force
    stamp_ns = stamp.sec * _NS_PER_S + stamp.nanosec
    return RobotState(*motion, sample.mode, sample.error_code, stamp_ns, *attitude, (fr, fl, rr, rl))


def battery_state(sample: LowState_, received_ns: int) -> BatteryState | None:
    """Battery part of a low state; None when a field of it cannot be true."""
    soc, voltage_v, current_a = sample.bms_state.soc, sample.power_v, sample.power_a
    possible = soc <= 100 and 0 <= voltage_v <= MAX_VOLTAGE_V and within(MAX_CURRENT_A, current_a)
    return BatteryState(received_ns, soc, voltage_v, current_a) if possible else None
