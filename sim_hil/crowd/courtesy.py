"""Stepping aside: a standing person makes room for a robot that waits in front, so that nobody blocks it forever."""

from __future__ import annotations

import numpy as np

from sim_hil.crowd.senses import ObservedRobot
from sim_hil.crowd.state import Activity, Array, Crowd, Ints
from sim_hil.crowd.walkable_map import CrowdMap

_AHEAD_M, _HALF_WAY_M = 1.8, 0.6  # length and half width of the area in which a person blocks the robot
_SLOW_MPS = 0.25  # robot speed below which it counts as waiting
_NOTICE_S = 1.2  # waiting time, in addition to a share of the patience, after which a person steps aside
_ASIDE_M, _FURTHER_M = 0.95, 1.3
_STAY_ASIDE_S = 7.0
_PACE_MPS = 0.55
_BACK_M = (0.7, 1.3)
_STAY_BACK_S = 3.0


class Courtesy:
    """For every person: time spent blocking the robot, and the point to step to."""

    def __init__(self, count: int) -> None:
        self._waits_s = np.zeros(count)
        self._until_s = np.zeros(count)
        self._x, self._y = np.zeros(count), np.zeros(count)

    def update(self, crowd: Crowd, ways: CrowdMap, robot: ObservedRobot, dt: float) -> None:
        """Update the blocking times and choose where due persons step to."""
        rx, ry = crowd.x - robot.x, crowd.y - robot.y
        ahead, left = rx * robot.c + ry * robot.s, ry * robot.c - rx * robot.s
        stands = crowd.vx * crowd.vx + crowd.vy * crowd.vy < 0.04
        stands &= (crowd.activity != Activity.SIT) & crowd.aware
        waits = abs(robot.vx * robot.c + robot.vy * robot.s) < _SLOW_MPS
        blocks = stands & (ahead > 0.0) & (ahead < _AHEAD_M) & (np.abs(left) < _HALF_WAY_M) & waits
        self._waits_s = np.where(blocks, self._waits_s + dt, np.maximum(self._waits_s - dt, 0.0))
        due = blocks & (self._waits_s > _NOTICE_S + 0.4 * crowd.patience_s) & (crowd.now_s > self._until_s)
        for person in np.flatnonzero(due):
            self._step_aside(int(person), float(left[person]), crowd, ways, robot)

    def _step_aside(self, person: int, left: float, crowd: Crowd, ways: CrowdMap, robot: ObservedRobot) -> None:
        nearer = 1.0 if left >= 0 else -1.0
        # Candidates: the nearer side, the other side, and if neither has room, further ahead of the robot.
        moves = [(0.0, nearer * _ASIDE_M - left), (0.5, nearer * _ASIDE_M - left), (0.0, -nearer * _ASIDE_M - left)]
        moves += [(_FURTHER_M, 0.0), (_FURTHER_M, 0.8), (_FURTHER_M, -0.8)]
        x = crowd.x[person] + np.array([robot.c * u - robot.s * v for u, v in moves])
        y = crowd.y[person] + np.array([robot.s * u + robot.c * v for u, v in moves])
        here_x, here_y = np.full(len(moves), crowd.x[person]), np.full(len(moves), crowd.y[person])
        free = (ways.gaps_at(x, y) > 0.3) & ways.sees(here_x, here_y, x, y)
        others = np.hypot(x[:, None] - crowd.x, y[:, None] - crowd.y)
        others[:, person] = np.inf
        free &= others.min(axis=1) > 0.55
        if free.any():
            best = int(np.argmax(free))
            self._x[person], self._y[person] = x[best], y[best]
            self._until_s[person] = crowd.now_s + _STAY_ASIDE_S
            self._waits_s[person] = 0.0

    def step_back(self, person: int, crowd: Crowd, ways: CrowdMap) -> None:
        """Send a person in a jam for a moment to the nearby point with most free space."""
        angles = np.arange(8) * (np.pi / 4)
        x = crowd.x[person] + np.outer(_BACK_M, np.cos(angles)).ravel()
        y = crowd.y[person] + np.outer(_BACK_M, np.sin(angles)).ravel()
        here_x, here_y = np.full(len(x), crowd.x[person]), np.full(len(y), crowd.y[person])
        others = np.hypot(x[:, None] - crowd.x, y[:, None] - crowd.y)
        others[:, person] = np.inf
        room = np.minimum(others.min(axis=1), 1.2) + np.minimum(ways.gaps_at(x, y), 0.6)
        room[(ways.gaps_at(x, y) < 0.3) | (others.min(axis=1) < 0.5) | ~ways.sees(here_x, here_y, x, y)] = -1.0
        best = int(np.argmax(room))
        if room[best] > 0.0:
            self._x[person], self._y[person] = x[best], y[best]
            self._until_s[person] = crowd.now_s + _STAY_BACK_S

    def override(self, crowd: Crowd, preferred_vx: Array, preferred_vy: Array) -> None:
        """Override the preferred velocities of people who step aside."""
        who: Ints = np.flatnonzero(self._until_s > crowd.now_s)
        if len(who):
            dx, dy = self._x[who] - crowd.x[who], self._y[who] - crowd.y[who]
            gap = np.sqrt(dx * dx + dy * dy) + 1e-9
            pace = np.where(gap > 0.15, np.minimum(_PACE_MPS, 0.2 + gap), 0.0) / gap
            preferred_vx[who], preferred_vy[who] = dx * pace, dy * pace
