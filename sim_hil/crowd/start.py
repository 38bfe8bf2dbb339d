"""Start positions of people: on free floor, apart from each other and from the robot's start."""

from __future__ import annotations

from math import hypot, pi

import numpy as np
from numpy.typing import NDArray

from sim_hil.crowd.state import Activity, Crowd
from sim_hil.crowd.walkable_map import CrowdMap
from sim_hil.scene.scene import Scene

_APART_M, _CLOSER_M = 1.1, 0.6  # least distance between people, and the one for a crowded floor
_TRIES, _EASY_TRIES = 400, 300
_GROUP_M = 4.0


class Start:
    """Placement of people one after another, in order of index. Raises ValueError if there is no room."""

    def __init__(self, scene: Scene, clear_m: float, ways: CrowdMap, crowd: Crowd, rng: np.random.Generator) -> None:
        self._crowd, self._rng, self._scene, self._clear_m = crowd, rng, scene, clear_m
        x, y, gaps = ways.walkable()
        free = (gaps >= min(0.4, float(gaps.max()))) & self._far(x, y)
        self._x, self._y = x[free], y[free]

    def _far(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.asarray(np.hypot(x - self._scene.start[0], y - self._scene.start[1]) > self._clear_m)

    def fits(self, person: int, x: float, y: float, apart_m: float = _APART_M) -> bool:
        """Return whether a person may start at a point."""
        crowd = self._crowd
        if hypot(x - self._scene.start[0], y - self._scene.start[1]) <= self._clear_m:
            return False
        others = np.hypot(crowd.x[:person] - x, crowd.y[:person] - y)
        return bool(person == 0 or others.min() > apart_m)

    def no_room(self) -> ValueError:
        """Return the error for a scene without room."""
        return ValueError(f"people: no room for another person in scene {self._scene.name}")

    def anywhere(self, person: int) -> None:
        """Place a person at a random free point with a random heading."""
        crowd, rng = self._crowd, self._rng
        for attempt in range(_TRIES if len(self._x) else 0):
            k = int(rng.integers(len(self._x)))
            x, y = float(self._x[k]), float(self._y[k])
            if self.fits(person, x, y, _APART_M if attempt < _EASY_TRIES else _CLOSER_M):
                crowd.x[person], crowd.y[person], crowd.heading[person] = x, y, rng.uniform(-pi, pi)
                return
        raise self.no_room()

    def beside(self, person: int, leader: int) -> None:
        """Place a person near the leader of the group."""
        crowd = self._crowd
        distance = np.hypot(self._x - crowd.x[leader], self._y - crowd.y[leader])
        near = np.flatnonzero((distance < _GROUP_M) & (distance > _CLOSER_M))
        for k in near[np.argsort(distance[near], kind="stable")]:
            if self.fits(person, float(self._x[k]), float(self._y[k]), _CLOSER_M):
                crowd.x[person], crowd.y[person] = self._x[k], self._y[k]
                break
        else:
            self.anywhere(person)
        crowd.heading[person] = crowd.heading[leader]
        crowd.activity[person] = Activity.FOLLOW
