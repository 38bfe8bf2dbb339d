"""Jams of slow people in a passage: walkers detect them from some metres away, turn round or choose another goal."""

from __future__ import annotations

import numpy as np

from sim_hil.crowd.state import Activity, Array, Crowd, Flags, Ints
from sim_hil.crowd.walkable_map import CrowdMap

_SLOW_MPS = 0.4
_PACE_S = 1.5  # time constant of the mean speed, so that a short stop does not count as a jam
_NEAR_M = 1.6
_MANY = 4.0  # number of slow people within _NEAR_M that make a jam
_LOOK_STEPS = 7  # look-ahead along the route, in steps of about 1.3 m
_RECONSIDER_S, _TURN_SHARE = 1.0, 0.35  # period of the decision before a jam, and share of people who turn round


class Jams:
    """Positions of slow people, and the jams that they form."""

    def __init__(self, count: int) -> None:
        self._paces = np.full(count, 1.0)
        self._x, self._y = np.zeros(0), np.zeros(0)
        self._due_s = 0.0

    def update(self, crowd: Crowd, dt: float) -> None:
        """Update the mean speeds after `dt` seconds; sitting people do not count."""
        self._paces += (np.sqrt(crowd.vx * crowd.vx + crowd.vy * crowd.vy) - self._paces) * (dt / _PACE_S)
        slow = (self._paces < _SLOW_MPS) & (crowd.activity != Activity.SIT)
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
