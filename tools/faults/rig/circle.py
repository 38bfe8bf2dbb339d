"""Plan of the fault harness: a circle around the odometry's origin. Pure.

Untrained weights would walk the robot into a wall; on a circle it moves without end in a small area.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from edge.core.geometry import SE2, wrap_angle

SPEED_MPS = 0.7
"""Speed above half of the robot file's limit, so that a halved limit has an effect, m/s."""
RADIUS_M = 1.0
MAX_TURN_RADPS = 0.95
_STEER_PER_S = 1.5
_APPROACH_PER_M = 1.5
_RIPPLE = 0.03
_SLOWEST = 0.1
_SLOW_DOWN = 1.2  # full speed as long as the heading is within 34 degrees


def steering(T_odom_base: SE2) -> tuple[float, float]:
    """Compute speed (m/s) and yaw rate (rad/s) towards the circle, counter-clockwise, from any pose.

    A robot with the wrong heading turns nearly on the spot, so that it stays within the area.
    """
    radius_m = math.hypot(T_odom_base.x_m, T_odom_base.y_m)
    tangent_rad = math.atan2(T_odom_base.y_m, T_odom_base.x_m) + math.pi / 2
    wanted_rad = tangent_rad + math.atan(_APPROACH_PER_M * (radius_m - RADIUS_M))
    error_rad = wrap_angle(wanted_rad - T_odom_base.theta_rad)
    speed = SPEED_MPS * min(1.0, max(_SLOWEST, _SLOW_DOWN * math.cos(error_rad)))
    turn = speed / RADIUS_M + _STEER_PER_S * error_rad
    return speed, min(max(turn, -MAX_TURN_RADPS), MAX_TURN_RADPS)


def plan(T_odom_base: SE2, steps: int, step_s: float, phase_rad: float) -> npt.NDArray[np.float32]:
    """Plan a trajectory [steps, 3] in the robot frame: an arc at constant speed with a small ripple by `phase_rad`.

    Without the ripple all plans on the circle would be equal, which the monitors take for a dead network.
    """
    speed, turn = steering(T_odom_base)
    speed *= 1.0 + _RIPPLE * math.sin(phase_rad)
    theta = turn * step_s * np.arange(1, steps + 1)
    reach = speed * step_s * np.arange(1, steps + 1)
    half = theta / 2
    chord = reach * np.sinc(half / math.pi)
    return np.stack((chord * np.cos(half), chord * np.sin(half), theta), axis=1).astype(np.float32)
