"""Wheel odometry of a differential base, from its encoders and its calibration of the wheels. Pure.

It integrates wheel rotations, so it includes slip of the tyres and errors of the calibration. It uses no ground truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, floor, isfinite, pi, sin
from typing import Final

import numpy as np

from edge.core.geometry import SE2
from sim_hil.robots.carter.urdf import TRACK_M, WHEEL_RADIUS_M

COUNTS_PER_TURN: Final = 4096  # our choice: an encoder of 12 bits on the wheel
# Our choice, of the size that tyres differ by: 0.2 % between two of a kind, 0.5 % for both, 1 % of the track where the
# tyre's width hides the point that it turns about. 0.2 % between the wheels turns the report by 0.28 degrees a metre.
_SCALE_SIGMA: Final = 0.005
_MISMATCH_SIGMA: Final = 0.002
_TRACK_SIGMA: Final = 0.01


@dataclass(frozen=True)
class WheelCalibration:
    """Assumed dimensions of the wheels, m."""

    left_radius_m: float = WHEEL_RADIUS_M
    right_radius_m: float = WHEEL_RADIUS_M
    track_m: float = TRACK_M

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (isfinite(value) and value > 0):
                raise ValueError(f"wheel calibration: {name}: expected a number above 0, found {value}")

    @staticmethod
    def drawn(seed: int) -> WheelCalibration:
        """Return a calibration with typical errors; deterministic per seed."""
        rng = np.random.default_rng((seed, 0x0D0))
        scale, mismatch, track = (float(value) for value in rng.standard_normal(3))
        radius = WHEEL_RADIUS_M * (1 + _SCALE_SIGMA * scale)
        half = _MISMATCH_SIGMA * mismatch / 2
        return WheelCalibration(radius * (1 - half), radius * (1 + half), TRACK_M * (1 + _TRACK_SIGMA * track))


@dataclass(frozen=True)
class OdometrySample:
    """Odometry report: `T_odom_base`, body velocity from the wheel speeds, distance travelled, encoder counts."""

    T_odom_base: SE2
    v_mps: float
    w_radps: float
    distance_m: float
    left_counts: int
    right_counts: int


def _counts(angle_rad: float) -> int:
    return floor(angle_rad * COUNTS_PER_TURN / (2 * pi))


class WheelOdometry:
    """Integrator of encoder counts, starting at the origin; call `step` after every physics step."""

    def __init__(self, calibration: WheelCalibration | None = None) -> None:
        calibration = calibration or WheelCalibration()
        self._calibration = calibration
        self._left_m = 2 * pi * calibration.left_radius_m / COUNTS_PER_TURN
        self._right_m = 2 * pi * calibration.right_radius_m / COUNTS_PER_TURN
        self._left = self._right = 0
        self._x = self._y = self._theta = self._way = 0.0

    def step(self, left_rad: float, right_rad: float) -> None:
        """Add the wheels' angles."""
        left, right = _counts(left_rad), _counts(right_rad)
        left_m, right_m = (left - self._left) * self._left_m, (right - self._right) * self._right_m
        self._left, self._right = left, right
        moved, turned = (left_m + right_m) / 2, (right_m - left_m) / self._calibration.track_m
        # The chord of the arc, along its middle heading: exact for a turn at a steady rate to the third order.
        middle = self._theta + turned / 2
        self._x += moved * cos(middle)
        self._y += moved * sin(middle)
        self._theta += turned
        self._way += abs(moved)

    def sample(self, left_radps: float, right_radps: float) -> OdometrySample:
        """Return the report; speeds come from the motors, because the counts of one step are too coarse."""
        wheels = self._calibration
        left, right = left_radps * wheels.left_radius_m, right_radps * wheels.right_radius_m
        pose = SE2(self._x, self._y, self._theta)
        return OdometrySample(
            pose, (left + right) / 2, (right - left) / wheels.track_m, self._way, self._left, self._right
        )
