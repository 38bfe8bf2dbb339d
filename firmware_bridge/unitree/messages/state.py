"""What a Go2 reports, checked field by field: the robot is an untrusted peer (faults table, "Unitree, known hazards").

A report with one impossible number is dropped whole; the reader counts it and, without better ones, reports silence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

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
_CLOCK_RESTART_NS: Final = _NS_PER_S
_CLOCK_DRIFT: Final = 1000  # 1 ms a second, ten times what a quartz does
_MAX_AHEAD_NS: Final = 500_000_000  # our choice: far above the jitter of a loaded robot, too short to hide a report


@dataclass(frozen=True)
class RobotState:
    """One odometry report: `T_odom_base` = (x_m, y_m, theta_rad), velocity in the body frame.

    `received_ns` is our monotonic clock, `robot_stamp_ns` the robot's own clock (0: it fills in none). `foot_forces`
    are the raw readings of FR, FL, RR, RL. `wz_radps` is the robot's estimate, `gyro_wz_radps` its gyroscope.
    """

    received_ns: int
    T_odom_base: tuple[float, float, float]
    vx_mps: float
    vy_mps: float
    wz_radps: float
    mode: int
    error_code: int
    robot_stamp_ns: int
    position_z_m: float
    roll_rad: float
    pitch_rad: float
    gyro_wz_radps: float
    foot_forces: tuple[int, int, int, int]


@dataclass(frozen=True)
class BatteryState:
    """Charge, voltage and current (as the robot signs it) of the robot's battery."""

    received_ns: int
    soc_percent: int
    voltage_v: float
    current_a: float


def within(bound: float, *values: float) -> bool:
    """Whether every value is finite and at most `bound` in size."""
    return all(abs(value) <= bound for value in values)  # False for NaN


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


class StampOrder:
    """Lets a robot's reports through in the order in which the robot made them, each of them once.

    A stamp that is ahead of our clock, compared with the reports so far, is from the future: it would hide every
    genuine report after it. A robot whose clock starts over is believed after one second without anything acceptable;
    one that fills in no stamp at all is believed as it comes.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._stamp_ns = -1
        self._received_ns = 0
        self._offset_ns = 0  # of the robot's clock to ours

    def accept(self, state: RobotState) -> bool:
        """Whether `state` is newer than every earlier one and not from the future."""
        stamp_ns, passed_ns = state.robot_stamp_ns, state.received_ns - self._received_ns
        offset_ns = stamp_ns - state.received_ns
        restarted = passed_ns > _CLOCK_RESTART_NS and stamp_ns != self._stamp_ns
        # The offset follows as slowly as two clocks drift: a forger must not creep into the future step by step.
        drift_ns = passed_ns // _CLOCK_DRIFT
        ahead = self._stamp_ns >= 0 and offset_ns > self._offset_ns + drift_ns + _MAX_AHEAD_NS
        old = stamp_ns <= self._stamp_ns and not stamp_ns == self._stamp_ns == 0
        if (old or ahead) and not restarted:
            self.dropped += 1
            return False
        followed_ns = min(max(offset_ns, self._offset_ns - drift_ns), self._offset_ns + drift_ns)
        self._offset_ns = followed_ns if self._stamp_ns >= 0 and not restarted else offset_ns
        self._stamp_ns, self._received_ns = stamp_ns, state.received_ns
        return True
