"""Dead reckoning between two words of the camera: the robot's increments and its gyro, with what is known of them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from edge.core.geometry import SE2, wrap_angle
from edge.odometry import pose_chain
from edge.odometry.gate import Increment
from edge.odometry.pose_chain import HEADING, SCALE, SIDEWAYS, Array, Node


@dataclass(frozen=True)
class OdometryModel:
    """How reports become motion: parameters as known now, and the size of what they do not explain.

    `heading`: the gyro's bias, rad/s, or without a gyro the odometry's yaw drift, rad/m. `scale`: reported over
    true forward motion less one. `sideways`: what is reported to the left per metre driven forward.
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

    def corrected(self, increment: Increment) -> tuple[float, float, float, float]:
        """Forward m, left m and turn rad as they were by these parameters; and the turn's derivative by `heading`."""
        if increment.still:
            return 0.0, 0.0, 0.0, 0.0
        forward = increment.dx_m / (1.0 + self.scale)
        left = increment.dy_m / self.scale_y - self.sideways * forward
        if self.has_gyro:
            return forward, left, increment.turn_rad - self.heading * increment.dt_s, increment.dt_s
        distance = math.hypot(forward, left)
        return forward, left, increment.odometry_rad / self.scale_yaw - self.heading * distance, distance


class Cursor(NamedTuple):
    """A place in the chain, and how far the robot has driven since the camera last had a say."""

    node: Node
    unseen_m: float


class Interval(NamedTuple):
    """Motion over some increments in the frame at their beginning, [3] (x m, y m, θ rad).

    `uncorrected` [2], m: as the robot reported it. `gains` [3, 4]: how the parameters enter the reports.
    `white` [3, 3]: covariance of what they do not explain.
    """

    motion: Array
    uncorrected: Array
    gains: Array
    white: Array
    distance_m: float
    odometry_rad: float
    still: bool


def grown(distance_m: float) -> float:
    """Variance of the odometry's error over a distance, for a rate of one: it errs alike over a metre, then afresh."""
    return distance_m * distance_m if distance_m < 1.0 else 2.0 * distance_m - 1.0


def advance(cursor: Cursor, increment: Increment, model: OdometryModel) -> Cursor:
    """Dead-reckon one increment: the error grows with the gyro's time and the odometry's road."""
    forward, left, turn, gain = model.corrected(increment)
    unseen_m = cursor.unseen_m + math.hypot(forward, left)
    share = grown(unseen_m) - grown(cursor.unseen_m)
    if increment.still:
        variance_rad2 = 0.0
    elif model.has_gyro:
        variance_rad2 = model.gyro_noise_radps_rthz**2 * increment.dt_s
    else:
        variance_rad2 = model.rate_rad_per_m**2 * share
    node = pose_chain.extend(
        cursor.node, increment.end_ns, forward, left, turn, model.rate_m_per_m**2 * share, variance_rad2, gain
    )
    return Cursor(node, unseen_m)


def integrate(increments: list[Increment], model: OdometryModel) -> Interval:
    """Add up increments, with the derivatives by the parameters."""
    x = y = theta = turned = distance = plain_x = plain_y = odometry = seconds = 0.0
    gains = np.zeros((3, pose_chain.PARAMETERS))
    still = True
    for increment in increments:
        forward, left, turn, gain = model.corrected(increment)
        c, s = math.cos(theta + 0.5 * turn), math.sin(theta + 0.5 * turn)
        dx, dy = c * forward - s * left, s * forward + c * left
        x, y, theta = x + dx, y + dy, theta + turn
        if not increment.still:
            still = False
            plain_x += c * increment.dx_m - s * increment.dy_m
            plain_y += s * increment.dx_m + c * increment.dy_m
            seconds += increment.dt_s
        odometry += increment.odometry_rad
        distance += math.hypot(forward, left)
        gains[:2, HEADING] += (-dy * turned, dx * turned)
        gains[:2, SCALE] += (c * forward, s * forward)
        gains[:2, SIDEWAYS] += (-s * forward, c * forward)
        turned += gain
    gains[2, HEADING] = turned
    variance_m2 = model.rate_m_per_m**2 * grown(distance) + 1e-8
    if model.has_gyro:
        variance_rad2 = model.gyro_noise_radps_rthz**2 * seconds + 1e-10
    else:
        variance_rad2 = model.rate_rad_per_m**2 * grown(distance) + 1e-10
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
    """Increments that follow each other from `begin_ns` on: before, between and after two instants, cut at them."""
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
    """Dead-reckoned nodes after `start`, moved so that they lead to `end`, each by its share of the time."""
    back = start.pose.inverse()
    reached, wanted = back @ nodes[-1].pose, back @ end.pose
    dx, dy = wanted.x_m - reached.x_m, wanted.y_m - reached.y_m
    turn = wrap_angle(wanted.theta_rad - reached.theta_rad)
    bent: list[Node] = []
    for node in nodes[:-1]:
        shape = pose_chain.between(start, end, node.stamp_ns)
        f = (node.stamp_ns - start.stamp_ns) / (end.stamp_ns - start.stamp_ns)
        plain = back @ node.pose
        pose = start.pose @ SE2(plain.x_m + f * dx, plain.y_m + f * dy, plain.theta_rad + f * turn)
        bent.append(Node(node.stamp_ns, *pose.as_tuple(), shape.white, shape.sensitivity, shape.parameters))
    return [*bent, end]
