"""Destinations and start positions of people: places, points spread over the floor, or points of the scene's routes."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, hypot, pi, sin

import numpy as np

from sim_hil.crowd.state import Activity, Crowd
from sim_hil.crowd.walkable_map import CrowdMap
from sim_hil.scene.scene import Place, Scene, Vec2

_REACH_M = 1.3  # largest distance from a place to walkable floor
_QUEUE_STEP_M = 0.75
_SIDE_M = 0.8
_WANDER_M2, _WANDER_MIN, _WANDER_MAX = 35.0, 10, 20
_PLACES_MIN, _PLACES_MAX = 10, 40  # limited, because each needs a distance field over the whole floor
_WANDER_GAP_M = 0.55
_JUNCTION_M = 2.6  # a junction has more than two free directions of this length
_APART_M, _CLOSER_M = 1.1, 0.6  # least distance between people, and the one for a crowded floor
_TRIES, _EASY_TRIES = 400, 300
_GROUP_M = 4.0


@dataclass(frozen=True)
class Spot:
    """Destination; `slots`: points where people stand or sit, m, in order of service; they face `heading_rad`.

    `kind`: way (walked through), stand, sit, queue or door. `reach`: the walkable point in front of it.
    """

    kind: str
    reach: Vec2
    slots: tuple[Vec2, ...]
    heading_rad: float


@dataclass(frozen=True)
class Destinations:
    """A scene's map with the paths to all its spots, which takes most of the time to make a crowd."""

    ways: CrowdMap
    spots: tuple[Spot, ...]
    routes: tuple[tuple[int, ...], ...]
    """Routes of the scene as indices of spots; empty where people choose freely."""

    @staticmethod
    def of(scene: Scene, people: int, rng: np.random.Generator) -> Destinations:
        """Compute them for a number of people. Raises ValueError if the scene has no walkable floor."""
        ways = CrowdMap(scene)
        if scene.routes and not scene.places:
            spots, routes = route_spots(scene)
        else:
            spots, routes = spots_of(scene, ways, people, rng), []
        ways.set_destinations([spot.reach for spot in spots])
        return Destinations(ways, tuple(spots), tuple(map(tuple, routes)))


def spots_of(scene: Scene, ways: CrowdMap, people: int, rng: np.random.Generator) -> list[Spot]:
    """Return the destinations for a number of people: a random subset of the places, and points on the floor."""
    most = int(np.clip(people + _PLACES_MIN, _PLACES_MIN, _PLACES_MAX))
    drawn = sorted(rng.permutation(len(scene.places))[:most].tolist())
    places = (scene.places[k] for k in drawn)
    found = (_of_place(place, ways) for place in places if place.kind == "door" or not _at_junction(scene, place, ways))
    return [spot for spot in found if spot is not None] + _scattered(ways, rng)


def _of_place(place: Place, ways: CrowdMap) -> Spot | None:
    x, y = place.position_m
    reach = ways.point(int(ways.nodes_at(np.array((x,)), np.array((y,)))[0]))
    if hypot(reach[0] - x, reach[1] - y) > _REACH_M:
        return None
    if place.kind == "sit":
        return Spot("sit", reach, ((x, y),), place.heading_rad)
    if place.kind == "queue":
        return Spot("queue", reach, _in_line(place, ways), place.heading_rad)
    slots = [slot for slot in _abreast(place) if _gap(ways, slot) > 0.27]
    return Spot(place.kind, reach, tuple(slots) or (reach,), place.heading_rad)


def _at_junction(scene: Scene, place: Place, ways: CrowdMap) -> bool:
    """Return whether a place lies at a junction of corridors, where a standing person blocks the others."""
    x, y = place.position_m
    area = scene.area_at(x, y)
    if area is None or area.kind != "corridor":
        return False
    here = np.full(4, x), np.full(4, y)
    there = x + _JUNCTION_M * np.array((1.0, 0.0, -1.0, 0.0)), y + _JUNCTION_M * np.array((0.0, 1.0, 0.0, -1.0))
    return int(ways.sees(*here, *there).sum()) > 2


def _in_line(place: Place, ways: CrowdMap) -> tuple[Vec2, ...]:
    """Return the slots of a queue against the heading; it bends where the straight line is blocked."""
    x, y = place.position_m
    slots, turn = [(x, y)], place.heading_rad + pi
    while len(slots) < place.capacity:
        for bend in (0.0, 0.5, -0.5, 1.0, -1.0, pi / 2, -pi / 2):
            angle = turn + bend
            slot = (slots[-1][0] + _QUEUE_STEP_M * cos(angle), slots[-1][1] + _QUEUE_STEP_M * sin(angle))
            apart = all(hypot(slot[0] - a, slot[1] - b) > 0.9 * _QUEUE_STEP_M for a, b in slots)
            if apart and _gap(ways, slot) > 0.32:
                slots.append(slot)
                turn = angle
                break
        else:
            break
    return tuple(slots)


def _abreast(place: Place) -> list[Vec2]:
    """Return slots side by side at the place, starting in the middle."""
    (x, y), c, s = place.position_m, cos(place.heading_rad), sin(place.heading_rad)
    sides = [((k + 1) // 2) * (1 if k % 2 else -1) * _SIDE_M for k in range(place.capacity)]
    return [(x - s * side, y + c * side) for side in sides]


def _gap(ways: CrowdMap, point: Vec2) -> float:
    return float(ways.gaps_at(np.array((point[0],)), np.array((point[1],)))[0])


def _scattered(ways: CrowdMap, rng: np.random.Generator) -> list[Spot]:
    """Return points to walk to, as far apart as possible."""
    x, y, gaps = ways.walkable()
    wide = gaps >= min(_WANDER_GAP_M, float(gaps.max()))
    x, y = x[wide], y[wide]
    count = int(np.clip(len(x) * ways.cell_m2 / _WANDER_M2, _WANDER_MIN, _WANDER_MAX))
    first = int(rng.integers(len(x)))
    chosen, distance = [first], np.hypot(x - x[first], y - y[first])
    while len(chosen) < min(count, len(x)):
        furthest = int(np.argmax(distance))
        chosen.append(furthest)
        np.minimum(distance, np.hypot(x - x[furthest], y - y[furthest]), out=distance)
    points = [(float(x[k]), float(y[k])) for k in chosen]
    return [Spot("way", point, (point,), float("nan")) for point in points]


def route_spots(scene: Scene) -> tuple[list[Spot], list[list[int]]]:
    """Return the points of a scene's routes as spots, and each route as their indices."""
    spots: list[Spot] = []
    routes = []
    for route in scene.routes:
        routes.append(list(range(len(spots), len(spots) + len(route.points_m))))
        spots += [Spot("way", point, (point,), float("nan")) for point in route.points_m]
    return spots, routes


class Start:
    """Placement of people one after another, in order of index. Raises ValueError if there is no room."""

    def __init__(self, scene: Scene, clear_m: float, ways: CrowdMap, crowd: Crowd, rng: np.random.Generator) -> None:
        self._crowd, self._rng, self._scene, self._clear_m = crowd, rng, scene, clear_m
        x, y, gaps = ways.walkable()
        far = np.hypot(x - scene.start[0], y - scene.start[1]) > clear_m
        free = (gaps >= min(0.4, float(gaps.max()))) & far
        self._x, self._y = x[free], y[free]

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
