"""Observations of a policy, one every 0.1 s: an image, and odometry with the drift of the paper's table 14."""

from __future__ import annotations

from dataclasses import dataclass
from math import sin
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.core.geometry import SE2
from sim_hil.robots.odometry_noise import LEVELS, OdometryNoise

CAMERA_ASPECT: Final = 16 / 9
"""Width by height of the rendered view, before it is scaled to the policy's input size."""


@dataclass(frozen=True)
class Observation:
    """Observation at one instant.

    `image`: uint8 RGB [height, width, 3], None without a camera. `state`: body velocity (vx m/s, vy m/s, wz rad/s) by
    odometry, mean since the last observation. `T_odom_base`: pose relative to the start by odometry. `collided`:
    whether the robot has touched an object or a person so far; `touching`: whether it does now. Both mean physical
    contact; the benchmark also counts a person within 0.5 m as a collision.
    """

    time_s: float
    image: NDArray[np.uint8] | None
    state: tuple[float, float, float]
    T_odom_base: SE2
    collided: bool
    touching: bool


class Odometer:
    """Simulated odometry: turns true poses at 30 Hz into drifting ones. Raises ValueError for an unknown level."""

    def __init__(self, level: str, seed: int, T_world_base: SE2) -> None:
        if level not in LEVELS:
            raise ValueError(f"drift: expected one of {', '.join(LEVELS)}, found {level!r}")
        self._noise = OdometryNoise(LEVELS[level], seed)
        self._last = T_world_base
        self._mark = self._noise.pose
        self._elapsed_s = 0.0

    @property
    def pose(self) -> SE2:
        """The newest reported `T_odom_base`."""
        return self._noise.pose

    def step(self, T_world_base: SE2, dt_s: float) -> None:
        """Add the true pose `dt_s` after the previous one."""
        self._noise.step(self._last.inverse() @ T_world_base, dt_s)
        self._last = T_world_base
        self._elapsed_s += dt_s

    def velocity(self) -> tuple[float, float, float]:
        """Return the mean body velocity (vx m/s, vy m/s, wz rad/s) since the last call; zero before the first step."""
        if self._elapsed_s == 0.0:
            return (0.0, 0.0, 0.0)
        moved, elapsed_s = self._mark.inverse() @ self._noise.pose, self._elapsed_s
        self._mark, self._elapsed_s = self._noise.pose, 0.0
        # The robot drove an arc: rotate its chord by half the arc's angle to obtain the motion along the body axes.
        along = SE2(0.0, 0.0, -0.5 * moved.theta_rad) @ SE2(moved.x_m, moved.y_m, 0.0)
        stretch = _arc_over_chord(moved.theta_rad)
        return (along.x_m * stretch / elapsed_s, along.y_m * stretch / elapsed_s, moved.theta_rad / elapsed_s)


def _arc_over_chord(angle_rad: float) -> float:
    half = 0.5 * angle_rad
    return 1.0 if abs(half) < 1e-6 else half / sin(half)
