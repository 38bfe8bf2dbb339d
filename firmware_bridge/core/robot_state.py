"""What the bridge and the runner know of a robot, whatever its protocol, and how reading it fails."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final

_NS_PER_S: Final = 1_000_000_000
_CLOCK_RESTART_NS: Final = _NS_PER_S
_CLOCK_DRIFT: Final = 1000  # 1 ms a second, ten times what a quartz does
_CLOCK_BACK_NS: Final = 100_000_000
_REBOOT_NS: Final = 5 * _NS_PER_S  # our choice: a robot that was silent this long may have been switched on again
_MAX_OFF_NS: Final = 500_000_000  # our choice: far above the jitter of a loaded robot, too short to hide a report


class LinkOpenError(RuntimeError):
    """The robot's link cannot be opened; one line for the operator."""


class DdsError(LinkOpenError):
    """DDS cannot start; one line for the operator."""


class CameraError(RuntimeError):
    """No usable camera frame; one line with the reason."""


@dataclass(frozen=True)
class RobotState:
    """One odometry report: `T_odom_base` = (x_m, y_m, theta_rad), velocity in the body frame.

    `received_ns` is our monotonic clock, `robot_stamp_ns` the robot's own clock (0: it fills in none). `foot_forces`
    are the raw readings of FR, FL, RR, RL. `wz_radps` is the robot's estimate, `gyro_wz_radps` its gyroscope,
    None for a base without one.
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
    gyro_wz_radps: float | None
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


def reported_code(codes: Sequence[int], accepted: Collection[int]) -> int:
    """Return the first error code that is not accepted, so that an accepted one hides no other; 0 without any code."""
    return next((code for code in codes if code not in accepted), codes[0] if codes else 0)


class StampOrder:
    """Lets a robot's reports through in the order in which the robot made them, each of them once.

    A stamp that is ahead of our clock, compared with the reports so far, is from the future: it would hide every
    genuine report after it. One that is behind is late, as on a congested link: it shows where the robot was, and a
    stop must not be confirmed by it. A robot whose clock starts over, which goes back or follows a long silence, is
    believed after one second without anything acceptable; one that fills in no stamp at all is believed as it comes.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._stamp_ns = -1
        self._received_ns = self._seen_ns = 0
        self._is_reset = False  # whether the robot's clock may have started over since the last accepted report
        self._offset_ns = 0  # of the robot's clock to ours

    def accept(self, state: RobotState) -> bool:
        """Whether `state` is newer than every earlier one, not from the future and not late."""
        stamp_ns, passed_ns = state.robot_stamp_ns, state.received_ns - self._received_ns
        offset_ns = stamp_ns - state.received_ns
        silent_ns, self._seen_ns = state.received_ns - self._seen_ns, state.received_ns
        self._is_reset |= stamp_ns < self._stamp_ns - _CLOCK_BACK_NS or silent_ns > _REBOOT_NS
        # The offset follows as slowly as two clocks drift: a forger must not creep into the future step by step.
        drift_ns = passed_ns // _CLOCK_DRIFT
        ahead = self._stamp_ns >= 0 and offset_ns > self._offset_ns + drift_ns + _MAX_OFF_NS
        late = self._stamp_ns > 0 and offset_ns < self._offset_ns - drift_ns - _MAX_OFF_NS
        old = stamp_ns <= self._stamp_ns and not stamp_ns == self._stamp_ns == 0
        restarted = passed_ns > _CLOCK_RESTART_NS and stamp_ns != self._stamp_ns and (self._is_reset or not late)
        if (old or ahead or late) and not restarted:
            self.dropped += 1
            return False
        followed_ns = min(max(offset_ns, self._offset_ns - drift_ns), self._offset_ns + drift_ns)
        begins = self._stamp_ns == 0 < stamp_ns
        self._offset_ns = followed_ns if self._stamp_ns >= 0 and not begins and not restarted else offset_ns
        self._stamp_ns, self._received_ns, self._is_reset = stamp_ns, state.received_ns, False
        return True
