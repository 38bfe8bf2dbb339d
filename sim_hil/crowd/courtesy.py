"""Courtesy and jams: people make room for a waiting robot, and avoid passages where slow people stand."""

from __future__ import annotations

import numpy as np

from sim_hil.crowd.senses import ObservedRobot
from sim_hil.crowd.state import Activity, Array, Crowd, Flags, Ints
from sim_hil.crowd.walkable_map import CrowdMap

_AHEAD_M, _HALF_WAY_M = 1.8, 0.6  # length and half width of the area in which a person blocks the robot
_SLOW_MPS = 0.25  # robot speed below which it counts as waiting
_NOTICE_S = 1.2  # waiting time, in addition to a share of the patience, after which a person steps aside
_ASIDE_M, _FURTHER_M = 0.95, 1.3
_STAY_ASIDE_S = 7.0
_PACE_MPS = 0.55
_BACK_M = (0.7, 1.3)
_STAY_BACK_S = 3.0
_JAM_MPS = 0.4
_JAM_MEAN_S = 1.5  # time constant of the mean speed, so that a short stop does not count as a jam
_NEAR_M = 1.6
_MANY = 4.0  # number of slow people within _NEAR_M that make a jam
_LOOK_STEPS = 7  # look-ahead along the route, in steps of about 1.3 m
_RECONSIDER_S, _TURN_SHARE = 1.0, 0.35  # period of the decision before a jam, and share of people who turn round


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


class Jams:
    """Positions of slow people, and the jams that they form."""

    def __init__(self, count: int) -> None:
        self._paces = np.full(count, 1.0)
        self._x, self._y = np.zeros(0), np.zeros(0)
        self._due_s = 0.0

    def update(self, crowd: Crowd, dt: float) -> None:
        """Update the mean speeds after `dt` seconds; sitting people do not count."""
        self._paces += (np.sqrt(crowd.vx * crowd.vx + crowd.vy * crowd.vy) - self._paces) * (dt / _JAM_MEAN_S)
        slow = (self._paces < _JAM_MPS) & (crowd.activity != Activity.SIT)
        self._x, self._y = crowd.x[slow], crowd.y[slow]

    def crowding(self, x: Array, y: Array) -> Array:
        """Return the number of slow people within 1.6 m of each point."""
        dx, dy = self._x - x[:, None], self._y - y[:, None]
        return np.asarray((dx * dx + dy * dy < _NEAR_M * _NEAR_M).sum(axis=1), dtype=np.float64)

    def prices(self, ways: CrowdMap, spots: int, x: float, y: float) -> Array:
        """Return for each spot the factor by which a jam on the first 9 m of its route lowers its weight; 1: no jam."""
        everywhere = np.arange(spots)
        at_x, at_y = np.full(spots, x), np.full(spots, y)
        worst = np.zeros(spots)
        for _ in range(_LOOK_STEPS):
            at_x, at_y = ways.ahead(everywhere, at_x, at_y)
            # Neighbours of the person count equally on every route, so they do not matter.
            worst = np.maximum(worst, self.crowding(at_x, at_y))
        return np.asarray(1.0 + (worst / _MANY) ** 4)

    def turn_round(self, crowd: Crowd, ways: CrowdMap, rng: np.random.Generator) -> Ints:
        """Return the people who approach a jam, are not in it yet, and turn round."""
        if crowd.now_s < self._due_s:
            return np.zeros(0, dtype=np.int64)
        self._due_s = crowd.now_s + _RECONSIDER_S
        who = np.flatnonzero(crowd.activity == Activity.WALK)
        if not len(who) or len(self._x) < _MANY:
            return np.zeros(0, dtype=np.int64)
        outside: Flags = self.crowding(crowd.x[who], crowd.y[who]) < _MANY
        x, y = crowd.x[who], crowd.y[who]
        jammed = np.zeros(len(who), dtype=np.bool_)
        for step in range(3):
            x, y = ways.ahead(crowd.spot[who], x, y)
            if step:
                jammed |= self.crowding(x, y) >= _MANY
        coming = who[outside & jammed]
        return np.asarray(coming[rng.uniform(size=len(coming)) < _TURN_SHARE])
