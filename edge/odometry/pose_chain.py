"""A chain of dead-reckoned poses from which the uncertainty of the motion between any two of them can be told.

The error of a pose is kept as a left perturbation, true = Exp(ξ) estimate, seen from the chain's origin: there the
errors of increments simply add up (right-invariant error; Barrau and Bonnabel, "The invariant extended Kalman filter as
a stable observer", IEEE TAC 2017). So the white part of the error between two poses is the difference of two sums, and
so is its sensitivity to the parameters that err alike all the time (gyro bias, scales).
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from edge.core.geometry import SE2, interpolate, wrap_angle

Array = npt.NDArray[np.float64]
PARAMETERS = 4
HEADING, SCALE, SIDEWAYS, VISUAL = range(PARAMETERS)
"""Gyro bias (or odometry yaw drift), forward scale, sideways share of forward motion, visual scale."""


class Node(NamedTuple):
    """One pose of the chain: x m, y m, θ rad, white covariance (xx, xy, xθ, yy, yθ, θθ), sensitivities (3 × 4)."""

    stamp_ns: int
    x_m: float
    y_m: float
    theta_rad: float
    white: tuple[float, ...]
    sensitivity: tuple[float, ...]
    parameters: Array
    """Covariance [4, 4] of the parameters' error at this time."""

    @property
    def pose(self) -> SE2:
        """`T_odom_base`."""
        return SE2(self.x_m, self.y_m, self.theta_rad)


def origin(stamp_ns: int, pose: tuple[float, float, float], parameters: Array) -> Node:
    """The start of a chain."""
    return Node(stamp_ns, *pose, (0.0,) * 6, (0.0,) * (3 * PARAMETERS), parameters)


def extend(
    node: Node, end_ns: int, dx_m: float, dy_m: float, turn_rad: float,
    variance_m2: float, variance_rad2: float, heading_gain: float,
) -> Node:  # fmt: skip
    """The pose after a small increment (body frame at its middle); a few µs.

    `heading_gain`: derivative of the turn by the heading parameter (s for a gyro bias, m for a drift per metre).
    """
    middle = node.theta_rad + 0.5 * turn_rad
    c, s = math.cos(middle), math.sin(middle)
    x, y = node.x_m + c * dx_m - s * dy_m, node.y_m + s * dx_m + c * dy_m
    q, w = variance_rad2, variance_m2
    xx, xy, xt, yy, yt, tt = node.white
    white = (xx + w + y * y * q, xy - x * y * q, xt + y * q, yy + w + x * x * q, yt - x * q, tt + q)
    old = node.sensitivity
    sensitivity = (
        old[0] - y * heading_gain, old[1] - c * dx_m, old[2] + s * dx_m, old[3],
        old[4] + x * heading_gain, old[5] - s * dx_m, old[6] - c * dx_m, old[7],
        old[8] - heading_gain, old[9], old[10], old[11],
    )  # fmt: skip
    return Node(end_ns, x, y, wrap_angle(node.theta_rad + turn_rad), white, sensitivity, node.parameters)


def add_interval(node: Node, end_ns: int, motion: Array, covariance: Array, gains: Array, parameters: Array) -> Node:
    """The pose after an interval whose motion (x m, y m, θ rad in the frame of `node`) and error are known.

    `covariance` [3, 3] is the white part of that error; `gains` [3, 4] its derivative by the parameters' error.
    """
    pose = node.pose @ SE2(float(motion[0]), float(motion[1]), float(motion[2]))
    # From an error in coordinates to a left perturbation in the node's frame, and from there to the origin's.
    to_origin = _adjoint(node.pose) @ np.array(((1.0, 0.0, motion[1]), (0.0, 1.0, -motion[0]), (0.0, 0.0, 1.0)))
    white = _full(node.white) + to_origin @ covariance @ to_origin.T
    sensitivity = np.reshape(node.sensitivity, (3, PARAMETERS)) + to_origin @ gains
    return Node(end_ns, *pose.as_tuple(), _upper(white), tuple(map(float, sensitivity.ravel())), parameters)


def between(before: Node, after: Node, stamp_ns: int) -> Node:
    """The chain at an instant between two nodes, in a straight line."""
    span_ns = after.stamp_ns - before.stamp_ns
    f = 0.0 if span_ns <= 0 else min(max((stamp_ns - before.stamp_ns) / span_ns, 0.0), 1.0)
    pose = interpolate(before.pose, after.pose, f)
    white = tuple(a + f * (b - a) for a, b in zip(before.white, after.white, strict=True))
    sensitivity = tuple(a + f * (b - a) for a, b in zip(before.sensitivity, after.sensitivity, strict=True))
    return Node(stamp_ns, *pose.as_tuple(), white, sensitivity, before.parameters)


def at(nodes: Sequence[Node], stamp_ns: int) -> Node | None:
    """The chain at an instant: interpolated; its end after the end; None before its beginning or while it is empty."""
    if not nodes or stamp_ns < nodes[0].stamp_ns:
        return None
    index = bisect_right(nodes, stamp_ns, key=lambda node: node.stamp_ns)
    return nodes[-1] if index == len(nodes) else between(nodes[index - 1], nodes[index], stamp_ns)


def relative(anchor: Node, now: Node) -> tuple[SE2, Array]:
    """Pose of `now` in the frame of `anchor`, and the covariance [3, 3] of its error over (x m, y m, θ rad).

    The parameters' covariance is the mean of that at both ends: exact while they do not change in between.
    """
    motion = anchor.pose.inverse() @ now.pose
    gains = np.reshape(np.subtract(now.sensitivity, anchor.sensitivity), (3, PARAMETERS))
    parameters = 0.5 * (anchor.parameters + now.parameters)
    error = _full(now.white) - _full(anchor.white) + gains @ parameters @ gains.T
    # From the origin's perturbation to that in the anchor's frame, and from there to an error in coordinates.
    to_anchor = np.array(((1.0, 0.0, -motion.y_m), (0.0, 1.0, motion.x_m), (0.0, 0.0, 1.0)))
    to_anchor = to_anchor @ _adjoint(anchor.pose.inverse())
    covariance = to_anchor @ error @ to_anchor.T
    return motion, 0.5 * (covariance + covariance.T)


def _adjoint(pose: SE2) -> Array:
    c, s = math.cos(pose.theta_rad), math.sin(pose.theta_rad)
    return np.array(((c, -s, pose.y_m), (s, c, -pose.x_m), (0.0, 0.0, 1.0)))


def _full(white: tuple[float, ...]) -> Array:
    xx, xy, xt, yy, yt, tt = white
    return np.array(((xx, xy, xt), (xy, yy, yt), (xt, yt, tt)))


def _upper(matrix: Array) -> tuple[float, ...]:
    return tuple(float(matrix[i, j]) for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
