"""Destinations of people: places of the scene and points spread over the floor, or the points of its routes."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, hypot, pi, sin

import numpy as np

from sim_hil.crowd.walkable_map import CrowdMap
from sim_hil.scene.scene import Place, Scene, Vec2

_REACH_M = 1.3  # largest distance from a place to walkable floor
_QUEUE_STEP_M = 0.75
_SIDE_M = 0.8
_WANDER_M2, _WANDER_MIN, _WANDER_MAX = 35.0, 10, 20
_PLACES_MIN, _PLACES_MAX = 10, 40  # limited, because each needs a distance field over the whole floor
_WANDER_GAP_M = 0.55
_JUNCTION_M = 2.6  # a junction has more than two free directions of this length


@dataclass(frozen=True)
class Spot:
    """Destination; `slots`: points where people stand or sit, m, in order of service; they face `heading_rad`.

    `kind`: way (walked through), stand, sit, queue or door. `reach`: the walkable point in front of it.
    """

    kind: str
    reach: Vec2
    slots: tuple[Vec2, ...]
    heading_rad: float


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
