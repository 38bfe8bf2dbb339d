"""The paper's evaluation metrics (equations 6 to 9) of one episode's planar trajectory; pure functions."""

from __future__ import annotations

from math import hypot
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Vec2 = tuple[float, float]

FRAME_HZ: Final = 30
"""Rate at which trajectories, collisions and ends are evaluated, Hz: the paper's simulation rate."""


def navigation_error_m(position_xy: Vec2, goal_xy: Vec2) -> float:
    """Return NE (equation 7): planar distance from the robot's final position to the goal, m."""
    return hypot(position_xy[0] - goal_xy[0], position_xy[1] - goal_xy[1])


def is_success(position_xy: Vec2, goal_xy: Vec2, threshold_m: float) -> bool:
    """Return S (equation 6): whether the final position is within the threshold of the goal (the paper's is 1.5 m)."""
    return navigation_error_m(position_xy, goal_xy) < threshold_m


def path_length_m(positions_xy: Array) -> float:
    """Return PL (equation 8): summed distance between successive positions [n, 2] recorded at FRAME_HZ, m."""
    if len(positions_xy) < 2:
        return 0.0
    steps = np.diff(positions_xy, axis=0)
    return float(np.sum(np.hypot(steps[:, 0], steps[:, 1])))


def spl(success: bool, shortest_m: float, path_m: float) -> float:
    """Return one episode's term of SPL (equation 9), 0..1; `shortest_m` is the shortest feasible path's length.

    Raises ValueError unless `shortest_m` is positive.
    """
    if not shortest_m > 0:
        raise ValueError(f"spl: expected a shortest path of more than 0 m, found {shortest_m}")
    return shortest_m / max(shortest_m, path_m) if success else 0.0
