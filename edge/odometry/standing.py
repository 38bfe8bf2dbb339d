"""When the robot stands still: then nothing moves but the noise, and the gyro shows its bias."""

from __future__ import annotations

import math

from edge.odometry.gate import Increment, OdometryInputs


class StillCheck:
    """Every sign that the protocol carries must say so for a while: speed, turn, position, command, and feet."""

    def __init__(
        self,
        *,
        after_ns: int,
        max_mps: float,
        max_radps: float,
        max_m: float,
        max_command_mps: float,
        foot_share: float,
    ) -> None:
        self._after_ns = after_ns
        self._max_mps, self._max_radps, self._max_m = max_mps, max_radps, max_m
        self._max_command_mps = max_command_mps
        self._foot_share = foot_share
        self._since_ns: int | None = None
        self._at = (0.0, 0.0)
        self._turned_rad = 0.0
        self._seconds = 0.0

    def step(self, report: OdometryInputs, increment: Increment, gyro_bias_radps: float) -> bool:
        """Whether the robot stands, by this report and those before it."""
        x, y, _ = report.T_odom_base
        if self._since_ns is not None:
            quiet = self._quiet(report, gyro_bias_radps) and math.dist(self._at, (x, y)) <= self._max_m
            if quiet:
                self._turned_rad += increment.turn_rad
                self._seconds += increment.dt_s
                return report.received_ns - self._since_ns >= self._after_ns
        self._since_ns = report.received_ns if self._quiet(report, gyro_bias_radps) else None
        self._at, self._turned_rad, self._seconds = (x, y), 0.0, 0.0
        return False

    def take_rate(self) -> tuple[float, float] | None:
        """Mean yaw rate at rest, rad/s, and over how many s, once there is enough of it; each is given only once."""
        if self._seconds * 1e9 < self._after_ns:
            return None
        taken = (self._turned_rad / self._seconds, self._seconds)
        self._turned_rad = self._seconds = 0.0
        return taken

    def _quiet(self, report: OdometryInputs, gyro_bias_radps: float) -> bool:
        rate = report.wz_radps if report.gyro_wz_radps is None else report.gyro_wz_radps - gyro_bias_radps
        if math.hypot(report.vx_mps, report.vy_mps) > self._max_mps or abs(rate) > self._max_radps:
            return False
        if report.commanded is not None and max(map(abs, report.commanded)) > self._max_command_mps:
            return False
        feet = report.foot_forces
        # A robot without foot sensors reports zeros.
        return feet is None or not any(feet) or min(feet) * len(feet) >= self._foot_share * sum(feet)
