"""Motion of a wheeled base: odometry from wheel speeds, and checks that command, wheels and gyroscope agree. Pure."""

from __future__ import annotations

import math
from typing import Final

from firmware_bridge.core.config_can import CanAgreement

ERROR_COMMAND: Final = 1
"""Error code: the wheels do not do what the base was commanded (blocked, broken encoder, runaway drive)."""
ERROR_GYRO: Final = 2
"""Error code: the base turns otherwise than its wheels (slip, broken encoder or gyroscope)."""
ERROR_FAULTS: Final = 101
"""Error code of the first signal in `can.faults`; the next ones follow."""


class WheelOdometry:
    """Pose of a base with two driven wheels, from their speeds over the floor."""

    def __init__(self, track_m: float) -> None:
        self._track_m = track_m
        self.T_odom_base = (0.0, 0.0, 0.0)

    def velocity(self, left_mps: float, right_mps: float) -> tuple[float, float]:
        """Return forward speed and yaw rate, m/s and rad/s."""
        return (left_mps + right_mps) / 2, (right_mps - left_mps) / self._track_m

    def advance(self, left_mps: float, right_mps: float, duration_s: float) -> None:
        """Move on for that time, along a chord at the mean heading."""
        vx, wz = self.velocity(left_mps, right_mps)
        x, y, theta = self.T_odom_base
        middle = theta + wz * duration_s / 2
        step = vx * duration_s
        turned = math.remainder(theta + wz * duration_s, math.tau)
        self.T_odom_base = (x + step * math.cos(middle), y + step * math.sin(middle), turned)


class AgreementCheck:
    """Finds wheels that contradict the command or the gyroscope for longer than the robot file permits."""

    def __init__(self, limits: CanAgreement) -> None:
        self._limits = limits
        self._agreed_ns: dict[int, int] = {}

    def check(
        self, now_ns: int, moved: tuple[float, float], commanded: tuple[float, float] | None, gyro_radps: float | None
    ) -> tuple[int, ...]:
        """Return the error codes. `moved`, `commanded`: forward speed and yaw rate; None: unknown."""
        limits, (vx, wz) = self._limits, moved
        follows = commanded is None or not (
            self._differs(vx, commanded[0], limits.vx_mps) or self._differs(wz, commanded[1], limits.wz_radps)
        )
        turns = gyro_radps is None or not self._differs(wz, gyro_radps, limits.wz_radps)
        found: tuple[int, ...] = ()
        for code, agrees, most_s in ((ERROR_COMMAND, follows, limits.command_s), (ERROR_GYRO, turns, limits.gyro_s)):
            since_ns = now_ns if agrees else self._agreed_ns.get(code, now_ns)
            self._agreed_ns[code] = since_ns
            if now_ns - since_ns > most_s * 1e9:
                found += (code,)
        return found

    def _differs(self, found: float, expected: float, constant: float) -> bool:
        return abs(found - expected) > constant + self._limits.share * abs(expected)
