"""Dead reckoning: a chain of poses that gives the uncertainty of the motion between any two of them.

The error of a pose is a left perturbation, true = Exp(ξ) estimate, in the chain's origin, where the errors of
increments add up (right-invariant error; Barrau and Bonnabel, "The invariant extended Kalman filter as a stable
observer", IEEE TAC 2017). The white part of the error between two poses is therefore the difference of two sums, and so
is its sensitivity to the constant parameters (gyro bias, scales).
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from edge.core.geometry import SE2, interpolate, wrap_angle
from edge.odometry.gate import Increment

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
    """Covariance [4, 4] of the parameters' error at this instant."""

    @property
    def pose(self) -> SE2:
        """`T_odom_base`."""
        return SE2(self.x_m, self.y_m, self.theta_rad)


def origin(stamp_ns: int, pose: tuple[float, float, float], parameters: Array) -> Node:
    """Return the start of a chain."""
    return Node(stamp_ns, *pose, (0.0,) * 6, (0.0,) * (3 * PARAMETERS), parameters)


def extend(
    node: Node, end_ns: int, dx_m: float, dy_m: float, turn_rad: float,
    variance_m2: float, variance_rad2: float, heading_gain: float,
) -> Node:  # fmt: skip
    """Append a small increment (body frame at its middle); takes a few µs.

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
    """Append an interval with given motion (x m, y m, θ rad in the frame of `node`) and error.

    `covariance` [3, 3] is the white part of that error; `gains` [3, 4] its derivative by the parameters' error.
    """
    pose = node.pose @ SE2(float(motion[0]), float(motion[1]), float(motion[2]))
    # From an error in coordinates to a left perturbation in the node's frame, and from there to the origin's.
    to_origin = _adjoint(node.pose) @ np.array(((1.0, 0.0, motion[1]), (0.0, 1.0, -motion[0]), (0.0, 0.0, 1.0)))
    white = _full(node.white) + to_origin @ covariance @ to_origin.T
    sensitivity = np.reshape(node.sensitivity, (3, PARAMETERS)) + to_origin @ gains
    return Node(end_ns, *pose.as_tuple(), _upper(white), tuple(map(float, sensitivity.ravel())), parameters)


def between(before: Node, after: Node, stamp_ns: int) -> Node:
    """Interpolate the chain linearly at an instant between two nodes."""
    span_ns = after.stamp_ns - before.stamp_ns
    f = 0.0 if span_ns <= 0 else min(max((stamp_ns - before.stamp_ns) / span_ns, 0.0), 1.0)
    pose = interpolate(before.pose, after.pose, f)
    white = tuple(a + f * (b - a) for a, b in zip(before.white, after.white, strict=True))
    sensitivity = tuple(a + f * (b - a) for a, b in zip(before.sensitivity, after.sensitivity, strict=True))
    return Node(stamp_ns, *pose.as_tuple(), white, sensitivity, before.parameters)


def at(nodes: Sequence[Node], stamp_ns: int) -> Node | None:
    """Return the chain at an instant, interpolated; after the end its end; None before its start or while empty."""
    if not nodes or stamp_ns < nodes[0].stamp_ns:
        return None
    index = bisect_right(nodes, stamp_ns, key=lambda node: node.stamp_ns)
    return nodes[-1] if index == len(nodes) else between(nodes[index - 1], nodes[index], stamp_ns)


def relative(anchor: Node, now: Node) -> tuple[SE2, Array]:
    """Return the pose of `now` in the frame of `anchor`, and its error covariance [3, 3] over (x m, y m, θ rad).

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


@dataclass(frozen=True)
class OdometryModel:
    """Model from reports to motion: current parameters, and the size of the unexplained error.

    `heading`: the gyro's bias, rad/s, or without a gyro the odometry's yaw drift, rad/m. `scale`: reported over
    true forward motion less one. `sideways`: motion reported to the left per metre driven forward.
    """

    has_gyro: bool
    heading: float
    scale: float
    sideways: float
    scale_y: float
    scale_yaw: float
    gyro_noise_radps_rthz: float
    rate_m_per_m: float
    rate_rad_per_m: float
    rate_rad_per_rtrad: float
    """Error of the odometry's turn per square root of the turn: without a gyro."""

    def corrected(self, increment: Increment) -> tuple[float, float, float, float]:
        """Return corrected forward m, left m and turn rad, and the turn's derivative by `heading`."""
        if increment.still:
            return 0.0, 0.0, 0.0, 0.0
        forward = increment.dx_m / (1.0 + self.scale)
        left = (increment.dy_m - self.sideways * forward) / self.scale_y
        if self.has_gyro:
            return forward, left, increment.turn_rad - self.heading * increment.dt_s, increment.dt_s
        distance = math.hypot(forward, left)
        return forward, left, increment.odometry_rad / self.scale_yaw - self.heading * distance, distance


class Cursor(NamedTuple):
    """A node of the chain, and the distance driven since the last visual correction."""

    node: Node
    unseen_m: float


class Interval(NamedTuple):
    """Motion over some increments in the frame at their beginning, [3] (x m, y m, θ rad).

    `uncorrected` [2], m: as the robot reported it. `gains` [3, 4]: derivative by the parameters.
    `white` [3, 3]: covariance of the unexplained error.
    """

    motion: Array
    uncorrected: Array
    gains: Array
    white: Array
    distance_m: float
    odometry_rad: float
    still: bool


def grown(distance_m: float) -> float:
    """Return the odometry's error variance over a distance at rate 1: constant error per metre, independent metres."""
    return distance_m * distance_m if distance_m < 1.0 else 2.0 * distance_m - 1.0


def advance(cursor: Cursor, increment: Increment, model: OdometryModel) -> Cursor:
    """Dead-reckon one increment: the error grows with the gyro's time and the odometry's distance."""
    forward, left, turn, gain = model.corrected(increment)
    unseen_m = cursor.unseen_m + math.hypot(forward, left)
    share = grown(unseen_m) - grown(cursor.unseen_m)
    if increment.still:
        variance_rad2 = 0.0
    elif model.has_gyro:
        variance_rad2 = model.gyro_noise_radps_rthz**2 * increment.dt_s
    else:
        variance_rad2 = model.rate_rad_per_m**2 * share + model.rate_rad_per_rtrad**2 * abs(turn)
    node = extend(
        cursor.node, increment.end_ns, forward, left, turn, model.rate_m_per_m**2 * share, variance_rad2, gain
    )
    return Cursor(node, unseen_m)


def integrate(increments: list[Increment], model: OdometryModel) -> Interval:
    """Sum increments and their derivatives by the parameters."""
    x = y = theta = turned = turns = distance = plain_x = plain_y = odometry = seconds = 0.0
    gains = np.zeros((3, PARAMETERS))
    still = True
    for increment in increments:
        forward, left, turn, gain = model.corrected(increment)
        c, s = math.cos(theta + 0.5 * turn), math.sin(theta + 0.5 * turn)
        dx, dy = c * forward - s * left, s * forward + c * left
        x, y, theta, turns = x + dx, y + dy, theta + turn, turns + abs(turn)
        if not increment.still:
            still = False
            plain_x += c * increment.dx_m - s * increment.dy_m
            plain_y += s * increment.dx_m + c * increment.dy_m
            seconds += increment.dt_s
        odometry += increment.odometry_rad
        distance += math.hypot(forward, left)
        gains[:2, HEADING] += (-dy * turned, dx * turned)
        gains[:2, SCALE] += (c * forward, s * forward)
        gains[:2, SIDEWAYS] += (-s * forward / model.scale_y, c * forward / model.scale_y)
        turned += gain
    gains[2, HEADING] = turned
    variance_m2 = model.rate_m_per_m**2 * grown(distance) + 1e-8
    if model.has_gyro:
        variance_rad2 = model.gyro_noise_radps_rthz**2 * seconds + 1e-10
    else:
        variance_rad2 = model.rate_rad_per_m**2 * grown(distance) + model.rate_rad_per_rtrad**2 * turns + 1e-10
    return Interval(
        motion=np.array((x, y, theta)),
        uncorrected=np.array((plain_x, plain_y)),
        gains=gains,
        white=np.diag((variance_m2, variance_m2, variance_rad2)),
        distance_m=distance,
        odometry_rad=odometry,
        still=still,
    )


def split(
    pending: Iterable[Increment], begin_ns: int, start_ns: int, end_ns: int
) -> tuple[list[Increment], list[Increment], list[Increment]]:
    """Split consecutive increments from `begin_ns` on at two instants: before, between and after."""
    parts: tuple[list[Increment], list[Increment], list[Increment]] = ([], [], [])
    for increment in pending:
        for index, edge_ns in enumerate((start_ns, end_ns)):
            if begin_ns < edge_ns < increment.end_ns:
                share = (edge_ns - begin_ns) / (increment.end_ns - begin_ns)
                first, increment = _cut(increment, share, edge_ns)
                parts[index].append(first)
                begin_ns = edge_ns
        parts[(increment.end_ns > start_ns) + (increment.end_ns > end_ns)].append(increment)
        begin_ns = increment.end_ns
    return parts


def _cut(increment: Increment, share: float, at_ns: int) -> tuple[Increment, Increment]:
    def part(share: float, end_ns: int) -> Increment:
        return Increment(
            end_ns, increment.dt_s * share, increment.dx_m * share, increment.dy_m * share,
            increment.odometry_rad * share, increment.turn_rad * share, increment.still,
        )  # fmt: skip

    return part(share, at_ns), part(1.0 - share, increment.end_ns)


def bent(nodes: list[Node], start: Node, end: Node) -> list[Node]:
    """Shift the dead-reckoned nodes after `start` so that they end at `end`, each by its share of the time."""
    back = start.pose.inverse()
    reached, wanted = back @ nodes[-1].pose, back @ end.pose
    dx, dy = wanted.x_m - reached.x_m, wanted.y_m - reached.y_m
    turn = wrap_angle(wanted.theta_rad - reached.theta_rad)
    bent: list[Node] = []
    for node in nodes[:-1]:
        shape = between(start, end, node.stamp_ns)
        f = (node.stamp_ns - start.stamp_ns) / (end.stamp_ns - start.stamp_ns)
        plain = back @ node.pose
        pose = start.pose @ SE2(plain.x_m + f * dx, plain.y_m + f * dy, plain.theta_rad + f * turn)
        bent.append(Node(node.stamp_ns, *pose.as_tuple(), shape.white, shape.sensitivity, shape.parameters))
    return [*bent, end]
