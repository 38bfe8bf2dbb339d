"""Drifting odometry: true planar motion in, the report of a robot with unnoticed slip out. Pure, seeded.

The paper (table 14) disturbs translation and rotation by Gaussian noise whose size at each step is proportional to the
distance travelled in it, and lets it accumulate: typical (0.02 m/m, 1 deg/m), severe (0.05 m/m, 5 deg/m). It does not
say how the noise of neighbouring steps is related, and independent steps would make the drift depend on their length.
Here the error rate itself is a Gaussian process over the travelled distance with that standard deviation and a
correlation length: the same path drifts alike at 10 Hz and at 500 Hz. A robot that turns on the spot does not drift.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np

from edge.core.geometry import SE2

CORRELATION_M: Final = 1.0  # our choice, so that the drift of one metre has about the size that the rate says


@dataclass(frozen=True)
class NoiseLevel:
    """Standard deviation of the error rates: metres per metre for each of forward and sideways, radians per metre.

    `correlation_m`: distance over which the error rate stays alike; the drift after a path s much longer than it grows
    with sqrt(2 * correlation_m * s) times the rate.
    """

    translation_m_per_m: float
    rotation_rad_per_m: float
    correlation_m: float = CORRELATION_M

    def __post_init__(self) -> None:
        rates = (self.translation_m_per_m, self.rotation_rad_per_m)
        if not all(math.isfinite(rate) and rate >= 0 for rate in rates):
            raise ValueError(f"odometry noise: expected rates of 0 or more, found {rates}")
        if not (math.isfinite(self.correlation_m) and self.correlation_m > 0):
            raise ValueError(f"odometry noise: expected a correlation length above 0 m, found {self.correlation_m}")


LEVELS: Final[Mapping[str, NoiseLevel]] = MappingProxyType(
    {
        "none": NoiseLevel(0.0, 0.0),
        "typical": NoiseLevel(0.02, math.radians(1.0)),
        "severe": NoiseLevel(0.05, math.radians(5.0)),
    }
)
"""The paper's table 14."""


@dataclass(frozen=True)
class NoisyOdometry:
    """Reported odometry: `T_odom_base`, and the body velocity of its last increment (m/s, m/s, rad/s)."""

    T_odom_base: SE2
    vx_mps: float
    vy_mps: float
    wz_radps: float


class OdometryNoise:
    """Accumulates noisy increments from `start` on. The same level, seed and steps give the same report."""

    def __init__(self, level: NoiseLevel, seed: int, start: SE2 | None = None) -> None:
        """`start`: the first `T_odom_base` (default: the origin)."""
        self._level = level
        self._rng = np.random.default_rng(seed)
        self._sigmas = (level.translation_m_per_m, level.translation_m_per_m, level.rotation_rad_per_m)
        self._rates = self._draw()
        self.pose = start or SE2(0.0, 0.0, 0.0)  # the newest report

    def step(self, T_before_after: SE2, dt_s: float) -> NoisyOdometry:
        """Report after a true increment of `dt_s` in the body frame before it. Raises ValueError if dt_s <= 0."""
        if not dt_s > 0:
            raise ValueError(f"odometry noise: expected a step of more than 0 s, found {dt_s}")
        distance_m = math.hypot(T_before_after.x_m, T_before_after.y_m)
        if distance_m > 0:
            self._walk(distance_m)
        ex, ey, eth = (rate * distance_m for rate in self._rates)
        noisy = SE2(T_before_after.x_m + ex, T_before_after.y_m + ey, T_before_after.theta_rad + eth)
        self.pose = self.pose @ noisy
        return NoisyOdometry(self.pose, noisy.x_m / dt_s, noisy.y_m / dt_s, noisy.theta_rad / dt_s)

    def _walk(self, distance_m: float) -> None:
        """Move the error rates along an Ornstein-Uhlenbeck process by a distance, exactly for any step."""
        keep = math.exp(-distance_m / self._level.correlation_m)
        fresh = math.sqrt(1.0 - keep * keep)
        drawn = self._draw()
        rx, ry, rth = (keep * rate + fresh * new for rate, new in zip(self._rates, drawn, strict=True))
        self._rates = (rx, ry, rth)

    def _draw(self) -> tuple[float, float, float]:
        x, y, theta = (float(value) for value in self._rng.standard_normal(3))
        sx, sy, stheta = self._sigmas
        return x * sx, y * sy, theta * stheta
