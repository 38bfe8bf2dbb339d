"""Planar poses: `T_a_b` is the pose of frame b expressed in frame a (x forward, y left, θ counter-clockwise, SI)."""

from __future__ import annotations

import math
from dataclasses import dataclass


def wrap_angle(angle_rad: float) -> float:
    """Return the same angle in [-π, π)."""
    return (angle_rad + math.pi) % (2 * math.pi) - math.pi


@dataclass(frozen=True)
class SE2:
    """A planar rigid motion; `T_a_b @ T_b_c` is `T_a_c`."""

    x_m: float
    y_m: float
    theta_rad: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.x_m) and math.isfinite(self.y_m) and math.isfinite(self.theta_rad)):
            raise ValueError(f"pose ({self.x_m}, {self.y_m}, {self.theta_rad}) is not finite")

    def __matmul__(self, other: SE2) -> SE2:
        c, s = math.cos(self.theta_rad), math.sin(self.theta_rad)
        return SE2(
            self.x_m + c * other.x_m - s * other.y_m,
            self.y_m + s * other.x_m + c * other.y_m,
            wrap_angle(self.theta_rad + other.theta_rad),
        )

    def inverse(self) -> SE2:
        """`T_b_a` of a `T_a_b`."""
        c, s = math.cos(self.theta_rad), math.sin(self.theta_rad)
        return SE2(-c * self.x_m - s * self.y_m, s * self.x_m - c * self.y_m, wrap_angle(-self.theta_rad))

    def as_tuple(self) -> tuple[float, float, float]:
        """(x m, y m, θ rad)."""
        return (self.x_m, self.y_m, self.theta_rad)


def interpolate(T_w_a: SE2, T_w_b: SE2, fraction: float) -> SE2:
    """Interpolate two poses: straight line in x and y, shortest arc in θ; fraction in [0, 1]."""
    turn = wrap_angle(T_w_b.theta_rad - T_w_a.theta_rad)
    return SE2(
        T_w_a.x_m + fraction * (T_w_b.x_m - T_w_a.x_m),
        T_w_a.y_m + fraction * (T_w_b.y_m - T_w_a.y_m),
        wrap_angle(T_w_a.theta_rad + fraction * turn),
    )
