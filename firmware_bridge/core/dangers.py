"""Derives from the newest reports the reason against arming or driving. Pure: no clock, no I/O."""

from __future__ import annotations

import math
from typing import Final

from firmware_bridge.core.config import SafetyConfig
from firmware_bridge.core.robot_state import BatteryState, RobotState
from firmware_bridge.core.robot_table import RobotTable
from firmware_bridge.core.step_types import Inputs

_NS_PER_S: Final = 1_000_000_000
_NEVER_NS: Final = -(2**62)
_STILL_MPS: Final = 0.05  # fault matrix row 38: stopped means slower than this for half a second
_STILL_RADPS: Final = 0.2  # our choice: well above what a standing robot's gyroscope shows
_STILL_NS: Final = 500_000_000
_CONFIRM_NS: Final = 200_000_000
"""Time without a report of motion after which a robot counts as still: one report can be a change of direction."""
_SEEN_NS: Final = 200_000_000  # a report older than this proves nothing about motion
TILT_RAD: Final = math.radians(30.0)  # fault matrix row 64
REMOTE_NS: Final = _NS_PER_S  # our choice: a remote counts as in use for this long after its last input
_COMMANDER_NS: Final = 2 * _NS_PER_S  # twice as long as a Go2 holds a Move
_BATTERY_NS: Final = 10 * _NS_PER_S  # our choice: ten of the bridge's own battery reads

Reason = tuple[str, str]
"""Pair of a cause (of link.CAUSES) and a sentence for the operator."""
NO_STATE: Final = ("state_silent", "the robot reports no state")
NO_BATTERY: Final = ("battery_low", "no battery report")


class DangerWatch:
    """The robot's newest reports and the dangers in them that forbid motion now."""

    def __init__(self, safety: SafetyConfig, table: RobotTable, state_timeout_ns: int) -> None:
        self.robot: RobotState | None = None
        self.version: str | None = None
        self.first_report_ns: int | None = None
        self._safety = safety
        self._table = table
        self._state_timeout_ns = state_timeout_ns
        self._battery: BatteryState | None = None
        self._unsafe: str | None = None
        self._estop = self._writes_fail = False
        self._foreign, self._foreign_ns = "", _NEVER_NS
        self._publishers: str | None = None
        self._remote_ns = self._remote_estop_ns = self._moving_ns = _NEVER_NS

    def note(self, inputs: Inputs, now_ns: int) -> None:
        """Take the report of one step."""
        report = inputs.robot
        if report.state is not None:
            self.robot, self.first_report_ns = report.state, self.first_report_ns or now_ns
            self._moving_ns = now_ns if is_moving(report.state) else self._moving_ns
        self._remote_ns = now_ns if report.remote_in_use else self._remote_ns
        self._remote_estop_ns = now_ns if report.remote_estop else self._remote_estop_ns
        if report.denied is not None:
            self._foreign, self._foreign_ns = f"the robot denies {report.denied}: its lease is held", now_ns
        elif report.foreign is not None:
            self._foreign, self._foreign_ns = report.foreign, now_ns
        self._battery = report.battery or self._battery
        self._unsafe = report.unsafe
        self.version = report.version or self.version
        self._publishers, self._writes_fail, self._estop = report.publishers, report.writes_fail, inputs.estop

    def danger(self, now_ns: int) -> Reason | None:
        """Return what forbids motion in every state, apart from a latched emergency stop."""
        robot = self.fresh(now_ns, self._state_timeout_ns)
        if self._estop:
            return "estop", "emergency stop pressed at the local input, or its file cannot be read"
        if now_ns - self._remote_estop_ns < REMOTE_NS:
            return "estop", "emergency stop pressed on the remote"
        if now_ns - self._remote_ns < REMOTE_NS:
            return "remote_takeover", "a person uses the robot's remote"
        if now_ns - self._foreign_ns < _COMMANDER_NS:
            return "second_commander", f"another client commands the robot ({self._foreign})"
        if self._publishers is not None:
            return "second_publisher", f"{self._publishers}: two robots or a forger are on this network"
        if self._writes_fail:
            return "link_down", "the network does not take commands for the robot"
        if robot is not None and max(abs(robot.roll_rad), abs(robot.pitch_rad)) > TILT_RAD:
            roll, pitch = math.degrees(robot.roll_rad), math.degrees(robot.pitch_rad)
            return "tipped", f"the robot is tipped over or carried (roll {roll:.0f}, pitch {pitch:.0f} degrees)"
        if robot is not None and robot.error_code not in self._safety.accepted_error_codes:
            return "robot_error", f"the robot reports error {robot.error_code}"
        if self._unsafe is not None:
            return "unsafe_robot", self._unsafe
        return None

    def obstacle(self, now_ns: int) -> Reason | None:
        """Return what else forbids arming once nothing forbids motion."""
        battery, least, table = self._battery, self._safety.battery_min_percent, self._table
        if self.fresh(now_ns, self._state_timeout_ns) is None:
            return NO_STATE
        if least > 0 and (battery is None or now_ns - battery.received_ns > _BATTERY_NS):
            return NO_BATTERY
        if battery is not None and battery.soc_percent < least:
            return "battery_low", f"the battery has {battery.soc_percent} %, at least {least} % are needed"
        if self.version not in (None, table.version):
            return "wrong_robot", f"{table.identity} is {self.version}, the robot file expects {table.version}"
        return None

    def fresh(self, now_ns: int, timeout_ns: int) -> RobotState | None:
        """Return the robot's newest report if it is not older than this."""
        return None if self.robot is None or now_ns - self.robot.received_ns > timeout_ns else self.robot

    def moved_lately(self, now_ns: int) -> bool:
        """Return whether the robot has reported motion within the last half second."""
        return now_ns - self._moving_ns < _STILL_NS

    def motion(self, now_ns: int, since_ns: int = _NEVER_NS) -> tuple[str, float]:
        """Return one of link.MOTIONS and the robot's speed in m/s (-1: unknown).

        "still" needs a report that is fresh, was received after `since_ns`, comes from the only publisher, and follows
        200 ms without a report of motion.
        """
        robot = self.fresh(now_ns, _SEEN_NS)
        if robot is None or robot.received_ns <= since_ns:
            return "unknown", -1.0
        moves = is_moving(robot) or now_ns - self._moving_ns < _CONFIRM_NS
        motion = "moving" if moves else "still" if self._publishers is None else "unknown"
        return motion, math.hypot(robot.vx_mps, robot.vy_mps)


def is_moving(robot: RobotState) -> bool:
    """Return whether a report shows a robot that walks or turns."""
    return math.hypot(robot.vx_mps, robot.vy_mps) >= _STILL_MPS or abs(robot.wz_radps) >= _STILL_RADPS


def is_driven(robot: RobotState, table: RobotTable) -> bool:
    """Return whether a report shows motion or a mode that implies it."""
    return is_moving(robot) or robot.mode in table.moving_modes
