"""Waypoint guidance: points written at the anchor, seen from where the robot is now (paper appendix C).

A policy that is guided by waypoints reads what the language model wrote instead of its keys and values.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from edge.core.geometry import SE2
from edge.state.reasoning_text import WAYPOINT_TIMES_S, Waypoints

STRAIGHT_AHEAD: Waypoints = tuple((time_s / 2, 0.0) for time_s in WAYPOINT_TIMES_S)
"""At 0.5 m/s: what graphs are warmed up and timed with."""


def waypoints_now(waypoints: Waypoints, offset: SE2) -> npt.NDArray[np.float32]:
    """Waypoints (x m, y m) of the anchor's robot frame → [1, points, 2] in the current one; `offset` is the motion."""
    cos, sin = math.cos(offset.theta_rad), math.sin(offset.theta_rad)
    relative = [(x - offset.x_m, y - offset.y_m) for x, y in waypoints]
    points = [(cos * dx + sin * dy, cos * dy - sin * dx) for dx, dy in relative]
    return np.array([points], dtype=np.float32)
