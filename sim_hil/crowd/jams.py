"""Crowds that stand in a passage: seen from some metres away, and a reason to turn round or to go elsewhere first."""

from __future__ import annotations

import numpy as np

from sim_hil.crowd.state import Array, Crowd, Doing, Flags, Ints
from sim_hil.crowd.walkable_map import CrowdMap

_SLOW_MPS = 0.4
_PACE_S = 1.5  # paces are remembered about so long: who gives way for a moment is no jam
_NEAR_M = 1.6
_MANY = 4.0  # so many slow people within that make a jam
_LOOK_STEPS = 7  # of the way ahead, about 1.3 m each
_RECONSIDER_S, _TURN_SHARE = 1.0, 0.35  # how often who comes up to a jam thinks of it, and turns round


class Jams:
    """Knows who gets on slowly, and so where many do."""

    def __init__(self, count: int) -> None:
        self._paces = np.full(count, 1.0)
        self._x, self._y = np.zeros(0), np.zeros(0)
        self._due_s = 0.0

    def update(self, crowd: Crowd, dt: float) -> None:
        """Look at everybody's pace, after `dt` seconds more; who sits is in nobody's way."""
        self._paces += (np.sqrt(crowd.vx * crowd.vx + crowd.vy * crowd.vy) - self._paces) * (dt / _PACE_S)
        slow = (self._paces < _SLOW_MPS) & (crowd.doing != Doing.SIT)
        self._x, self._y = crowd.x[slow], crowd.y[slow]

    def crowding(self, x: Array, y: Array) -> Array:
        """[points]: how many slow people stand within 1.6 m of each point."""
        dx, dy = self._x - x[:, None], self._y - y[:, None]
        return np.asarray((dx * dx + dy * dy < _NEAR_M * _NEAR_M).sum(axis=1), dtype=np.float64)

    def prices(self, ways: CrowdMap, spots: int, x: float, y: float) -> Array:
        """[spots]: by how much a jam on the first 9 m of the way to each makes it less attractive; 1 for none."""
        everywhere = np.arange(spots)
        at_x, at_y = np.full(spots, x), np.full(spots, y)
        worst = np.zeros(spots)
        for _ in range(_LOOK_STEPS):
            at_x, at_y = ways.ahead(everywhere, at_x, at_y)
            # One's own neighbours count on every way alike, so they decide nothing.
            worst = np.maximum(worst, self.crowding(at_x, at_y))
        return np.asarray(1.0 + (worst / _MANY) ** 4)

    def turn_round(self, crowd: Crowd, ways: CrowdMap, rng: np.random.Generator) -> Ints:
        """Who comes up to a jam, is not in it yet, and would rather go elsewhere."""
        if crowd.now_s < self._due_s:
            return np.zeros(0, dtype=np.int64)
        self._due_s = crowd.now_s + _RECONSIDER_S
        who = np.flatnonzero(crowd.doing == Doing.WALK)
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
