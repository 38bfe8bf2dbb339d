"""Perception of the robot: which people see it, for how long, and which have lost sight of it."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, hypot, sin

import numpy as np

from sim_hil.crowd.state import Array, Crowd
from sim_hil.crowd.walkable_map import CrowdMap

NEAR_M = 0.75  # distance from its body within which everybody notices the robot, regardless of heading
_HEARING_M, _HEARING_SHARE = 1.7, 0.3  # range of hearing, and its rate of noticing relative to sight
_FORGET_S = 2.5
_FASTEST_MPS = 3.0


@dataclass(frozen=True)
class ObservedRobot:
    """Observed robot: centre, m; unit heading; velocity, m/s; a capsule with half length `axis_m`."""

    x: float
    y: float
    c: float
    s: float
    vx: float
    vy: float
    axis_m: float

    def nearest(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Return the offsets from the nearest point of the robot's body axis to points, and their lengths, m."""
        rx, ry = x - self.x, y - self.y
        along = np.clip(rx * self.c + ry * self.s, -self.axis_m, self.axis_m)
        rx -= along * self.c
        ry -= along * self.s
        return rx, ry, np.sqrt(rx * rx + ry * ry)


class RobotWatch:
    """Tracker of the robot's pose that estimates its velocity."""

    def __init__(self, axis_m: float) -> None:
        self._axis_m = axis_m
        self._last: tuple[float, float] | None = None
        self._vx = self._vy = 0.0

    def step(self, x: float, y: float, heading: float, dt: float) -> ObservedRobot:
        """Add the current pose and return the observed robot."""
        if self._last is not None:
            vx, vy = (x - self._last[0]) / dt, (y - self._last[1]) / dt
            if hypot(vx, vy) > _FASTEST_MPS:  # teleported
                vx = vy = 0.0
            # Smoothing over about 0.15 s, because a walking robot sways.
            self._vx += (vx - self._vx) * 0.2
            self._vy += (vy - self._vy) * 0.2
        self._last = (x, y)
        return ObservedRobot(x, y, cos(heading), sin(heading), self._vx, self._vy, self._axis_m)


def notice(crowd: Crowd, ways: CrowdMap, robot: ObservedRobot, dt: float) -> None:
    """Update everybody's awareness of the robot after `dt` seconds."""
    rx, ry = robot.x - crowd.x, robot.y - crowd.y
    distance = np.hypot(rx, ry)
    in_range = distance < crowd.sight_m
    in_range &= rx * np.cos(crowd.heading) + ry * np.sin(crowd.heading) > crowd.sight_cos * distance
    in_range |= distance < NEAR_M + robot.axis_m
    audible = distance < _HEARING_M
    who = np.flatnonzero(in_range | audible)
    visible = np.zeros(crowd.n, dtype=np.bool_)
    if len(who):
        robot_x, robot_y = np.full(len(who), robot.x), np.full(len(who), robot.y)
        visible[who] = ways.sees(crowd.x[who], crowd.y[who], robot_x, robot_y)
    # A robot behind a person is noticed by its sound, but later.
    crowd.seen_s = np.where(visible, crowd.seen_s + np.where(in_range, dt, _HEARING_SHARE * dt), 0.0)
    crowd.lost_s = np.where(visible, 0.0, crowd.lost_s + dt)
    crowd.aware |= crowd.seen_s >= crowd.reaction_s
    crowd.aware &= crowd.lost_s < _FORGET_S
