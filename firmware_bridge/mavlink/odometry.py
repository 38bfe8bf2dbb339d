"""Newest motion and battery reports of a rover, joined to a `RobotState`. Pure.

ODOMETRY is preferred; an autopilot without it (ArduPilot) reports LOCAL_POSITION_NED and ATTITUDE. EXTENDED_SYS_STATE
is not used: a rover's landed state says nothing about its motion.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Final

from firmware_bridge.core.robot_state import BatteryState, RobotState, StampOrder, reported_code
from firmware_bridge.mavlink.clock import VehicleClock
from firmware_bridge.mavlink.inputs import (
    Attitude,
    Motion,
    attitude_of,
    battery_of,
    battery_of_status,
    is_estimate_good,
    motion_of_odometry,
    motion_of_position,
)
from firmware_bridge.mavlink.mode_watch import ModeWatch
from firmware_bridge.mavlink.wire import Message

CRITICAL, BAD_ESTIMATE, JUMPED, NO_HEARTBEAT = 1, 2, 3, 4
ERROR_NAMES: Final[Mapping[int, str]] = {
    CRITICAL: "a failsafe is active",
    BAD_ESTIMATE: "its estimator has no attitude, velocity or position, or reports a GPS glitch",
    JUMPED: "its odometry has jumped (reset_counter)",
    NO_HEARTBEAT: "no heartbeat for 3.5 s",
}
"""Values of RobotState.error_code, all our own."""
_ODOMETRY, _ATTITUDE, _POSITION, _SYS_STATUS, _BATTERY, _ESTIMATOR, _EKF = 331, 30, 32, 1, 147, 230, 193
_PREFERRED_NS: Final = 1_000_000_000  # time without ODOMETRY after which LOCAL_POSITION_NED counts
_ATTITUDE_NS: Final = 200_000_000
_SAME_TIME_NS: Final = 50_000_000  # stamps this close belong together: a base changes its yaw rate by 0.2 rad/s in it
_JUMP_NS: Final = 1_000_000_000  # a jump stays an error for this long, so that no step of the rules misses it
_ESTIMATE_NS: Final = 5_000_000_000  # flags older than this are forgotten: not every firmware sends them again
_STILL_MPS: Final = 0.05
_STILL_RADPS: Final = 0.2
_NEVER_NS: Final = -(2**62)


class OdometryInput:
    """Takes the autopilot's reports and gives at most one new state a step."""

    def __init__(self, accepted: Collection[int] = (0,)) -> None:
        """`accepted`: error codes of the robot file that hide no other one."""
        self._accepted = accepted
        self._order = StampOrder()
        self._newest: tuple[int, Motion] | None = None
        self._attitude: tuple[int, Attitude] | None = None
        self._battery: BatteryState | None = None
        self._battery_ns = self._odometry_ns = self._state_ns = _NEVER_NS
        self._last: RobotState | None = None
        self._resets: int | None = None
        self._jump_ns = self._bad_ns = _NEVER_NS
        self.late = 0

    @property
    def dropped(self) -> int:
        """Count of reports that came late or out of order."""
        return self.late + self._order.dropped

    def take(self, message: Message, now_ns: int, clock: VehicleClock) -> bool:
        """Take one report; return whether it can be true."""
        number = message.get_msgId()
        if number == _ATTITUDE:
            attitude = attitude_of(message)
            if attitude is not None and clock.is_timely(attitude.stamp_ns, now_ns):
                self._attitude = now_ns, attitude
            return attitude is not None
        if number == _BATTERY:
            battery = battery_of(message, now_ns) if message.id == 0 else None
            self._battery_ns = now_ns if battery is not None else self._battery_ns
            self._battery = battery or self._battery
        elif number == _SYS_STATUS:
            if now_ns - self._battery_ns > 10 * _PREFERRED_NS:  # both are the same battery
                self._battery = battery_of_status(message, now_ns) or self._battery
        elif number in (_ESTIMATOR, _EKF):
            good = is_estimate_good(message.flags, is_ekf=number == _EKF)
            self._bad_ns = _NEVER_NS if good else now_ns
        else:
            return self._take_motion(message, number, now_ns, clock)
        return True

    def _take_motion(self, message: Message, number: int, now_ns: int, clock: VehicleClock) -> bool:
        if number == _ODOMETRY:
            motion = motion_of_odometry(message)
        elif number != _POSITION or now_ns - self._odometry_ns < _PREFERRED_NS:
            return True
        else:
            attitude = self._attitude
            if attitude is None or now_ns - attitude[0] > _ATTITUDE_NS:
                return True
            motion = motion_of_position(message, attitude[1])
        if motion is None:
            return False
        if not clock.is_timely(motion.stamp_ns, now_ns):
            self.late += 1
            return True
        state = self._state_of(motion, now_ns)
        if self._order.accept(state):
            self._odometry_ns = now_ns if number == _ODOMETRY else self._odometry_ns
            if number == _ODOMETRY:
                self._jump_ns = now_ns if self._resets not in (None, motion.resets) else self._jump_ns
                self._resets = motion.resets
            self._newest, self._state_ns = (now_ns, motion), now_ns
        return True

    def _state_of(self, motion: Motion, now_ns: int, mode: int = 0, error: int = 0) -> RobotState:
        attitude = None if self._attitude is None else self._attitude[1]
        together = attitude is not None and abs(motion.stamp_ns - attitude.stamp_ns) <= _SAME_TIME_NS
        gyro_radps = attitude.wz_radps if together and attitude is not None else motion.wz_radps
        velocity = (motion.vx_mps, motion.vy_mps, motion.wz_radps)
        tilt = (motion.position_z_m, motion.roll_rad, motion.pitch_rad, gyro_radps)
        return RobotState(now_ns, motion.T_odom_base, *velocity, mode, error, motion.stamp_ns, *tilt, (0, 0, 0, 0))

    def state(self, watch: ModeWatch, *, lost: bool) -> RobotState | None:
        """Return the newest state since the last call; None without one, and before the first heartbeat."""
        newest, self._newest = self._newest, None
        if newest is None or watch.mode is None:
            return None
        received_ns, motion = newest
        found = {
            NO_HEARTBEAT: lost,
            JUMPED: received_ns - self._jump_ns < _JUMP_NS,
            BAD_ESTIMATE: received_ns - self._bad_ns < _ESTIMATE_NS,
            CRITICAL: watch.is_critical(),
        }
        error = reported_code([code for code, is_present in found.items() if is_present], self._accepted)
        self._last = self._state_of(motion, received_ns, watch.mode, error)
        return self._last

    def take_battery(self) -> BatteryState | None:
        """Return the newest battery report since the last call."""
        battery, self._battery = self._battery, None
        return battery

    def is_silent(self, now_ns: int, silent_ns: int) -> bool:
        """Return whether no odometry came within `silent_ns`."""
        return now_ns - self._state_ns > silent_ns

    def stands(self, now_ns: int) -> bool:
        """Return whether a fresh report shows that the rover stands still."""
        last = self._last
        if last is None or now_ns - last.received_ns > _ATTITUDE_NS:
            return False
        return max(abs(last.vx_mps), abs(last.vy_mps)) < _STILL_MPS and abs(last.wz_radps) < _STILL_RADPS
