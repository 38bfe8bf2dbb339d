"""The paper's evaluation metrics, equations 6 to 9, of one episode's planar trajectory; pure functions."""

from __future__ import annotations

from math import hypot
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Vec2 = tuple[float, float]

FRAME_HZ: Final = 30
"""The paper's simulation rate: trajectories, collisions and ends are looked at so often."""


def navigation_error_m(position_xy: Vec2, goal_xy: Vec2) -> float:
    """NE, equation 7: planar distance from where the robot ended to the goal, m."""
    return hypot(position_xy[0] - goal_xy[0], position_xy[1] - goal_xy[1])


def is_success(position_xy: Vec2, goal_xy: Vec2, threshold_m: float) -> bool:
    """S, equation 6: whether the robot ended closer to the goal than the threshold (the paper's is 1.5 m)."""
    return navigation_error_m(position_xy, goal_xy) < threshold_m


def path_length_m(positions_xy: Array) -> float:
    """PL, equation 8: summed planar distance between successive positions [n, 2], m; recorded at FRAME_HZ."""
    if len(positions_xy) < 2:
        return 0.0
    steps = np.diff(positions_xy, axis=0)
    return float(np.sum(np.hypot(steps[:, 0], steps[:, 1])))


def spl(success: bool, shortest_m: float, path_m: float) -> float:
    """One episode's term of SPL, equation 9, 0..1; `shortest_m` is the shortest feasible path's length.

    Raises ValueError unless `shortest_m` is positive.
    """
    if not shortest_m > 0:
        raise ValueError(f"spl: expected a shortest path of more than 0 m, found {shortest_m}")
    return shortest_m / max(shortest_m, path_m) if success else 0.0
