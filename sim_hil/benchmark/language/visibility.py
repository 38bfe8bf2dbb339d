"""What the robot's camera can see: size of a landmark in its image, and people, by ray casting.

Fast enough to check every landmark of a suite.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import cos, radians, sin, tan

import numpy as np
from numpy.typing import NDArray

from sim_hil.scene.scene import Scene, SceneObject

Array = NDArray[np.float64]

PICTURE_PX = 128  # side of the policy's square image, to which a 16:9 view is scaled
HFOV_RAD = radians(100.0)
ASPECT = 16 / 9
EYE_M = 0.36  # height of the robot's camera
_SAMPLES = 6  # rays along each side of a face
_PERSON_M = (0.3, 1.0, 1.6)  # heights at which a person is looked for


class Sightlines:
    """Lines of sight in one scene."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        rows = []
        owners: list[str] = []
        for label, box in scene.obstacles():
            rows.append((*box.centre_m, *box.axis, *box.size_m))
            owners.append(label)
        self._owners = np.array(owners, dtype=object)
        self._boxes = np.array(rows, dtype=np.float64).reshape(-1, 8)

    def pixels(self, eye: tuple[float, float, float], heading_rad: float, thing: SceneObject, range_m: float) -> float:
        """Return the visible area of an object's bounding box, px of a 128 x 128 image; 0 beyond the range."""
        c, s = cos(heading_rad), sin(heading_rad)
        dx, dy = thing.position_m[0] - eye[0], thing.position_m[1] - eye[1]
        reach = float(np.hypot(*thing.size_m[:2])) / 2
        if np.hypot(dx, dy) - reach > range_m or dx * c + dy * s + reach < 0:
            return 0.0
        points, areas = _faces(thing, eye)
        origin = np.array(eye)
        away = points - origin
        depth = away[:, 0] * c + away[:, 1] * s
        across = -away[:, 0] * s + away[:, 1] * c
        half_x = tan(HFOV_RAD / 2)
        half_y = half_x / ASPECT
        near = depth > 0.05
        inside = near & (np.abs(across) < half_x * depth) & (np.abs(away[:, 2]) < half_y * depth)
        inside &= np.linalg.norm(away, axis=1) < range_m
        if not inside.any():
            return 0.0
        seen = inside.copy()
        seen[inside] = ~_blocked(origin, points[inside], self._boxes[self._owners != thing.label])
        # A patch of area A whose normal meets the ray covers fx fy A |n . d| / depth^3 of the picture.
        scale = (PICTURE_PX / 2) ** 2 / (half_x * half_y)
        return float(np.sum(scale * areas[seen] / depth[seen] ** 3))

    def most_pixels(self, path: Iterable[tuple[float, float, float]], thing: SceneObject, range_m: float) -> float:
        """Return the largest area of an object in the images along poses (x m, y m, heading rad), px."""
        return max((self.pixels((x, y, EYE_M), heading, thing, range_m) for x, y, heading in path), default=0.0)

    def persons(self, eye: tuple[float, float, float], people: Array) -> NDArray[np.bool_]:
        """Return for each person [n, 2 or more] (x m, y m) whether the line to a part of the body is free."""
        points = np.array([(row[0], row[1], height_m) for row in people for height_m in _PERSON_M]).reshape(-1, 3)
        if not len(points):
            return np.zeros(0, bool)
        blocked = _blocked(np.array(eye), points, self._boxes)
        return np.asarray(~blocked.reshape(-1, len(_PERSON_M)).all(axis=1))


def _faces(thing: SceneObject, eye: tuple[float, float, float]) -> tuple[Array, Array]:
    """Return points on the faces towards the eye, and each one's area times |n . d| (d: from the eye to the point)."""
    depth, width, height = thing.size_m
    c, s = cos(thing.heading_rad), sin(thing.heading_rad)
    base = np.array(thing.position_m)
    ahead, left, up = np.array((c, s, 0.0)), np.array((-s, c, 0.0)), np.array((0.0, 0.0, 1.0))
    middle = base + up * height / 2
    steps = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    u, v = (grid.ravel()[:, None] for grid in np.meshgrid(steps, steps))
    points, areas = [], []
    for normal, reach, a, la, b, lb in (
        (ahead, depth, left, width, up, height), (-ahead, depth, left, width, up, height),
        (left, width, ahead, depth, up, height), (-left, width, ahead, depth, up, height),
        (up, height, ahead, depth, left, width),
    ):  # fmt: skip
        face = middle + normal * (reach / 2 + 0.005) + u * a * la + v * b * lb
        toward = (np.array(eye) - face) @ normal
        keep = toward > 0
        points.append(face[keep])
        areas.append(la * lb / _SAMPLES**2 * toward[keep])
    return np.concatenate(points), np.concatenate(areas)


def _blocked(origin: Array, points: Array, boxes: Array) -> NDArray[np.bool_]:
    """Return for each point whether a box lies between it and the origin (slab test in each box's frame)."""
    ray = points - origin  # [n, 3]
    boxes = boxes[_between(origin, ray, boxes)]
    if not len(boxes):
        return np.zeros(len(points), bool)
    cx, cy, cz, ax, ay = (boxes[:, i] for i in range(5))
    dx, dy, dz = origin[0] - cx, origin[1] - cy, origin[2] - cz
    starts = (dx * ax + dy * ay, -dx * ay + dy * ax, dz)  # [m] each
    runs = (
        np.outer(ray[:, 0], ax) + np.outer(ray[:, 1], ay),
        np.outer(ray[:, 1], ax) - np.outer(ray[:, 0], ay),
        np.repeat(ray[:, 2:3], len(boxes), axis=1),
    )  # [n, m] each
    enter, leave = np.full(runs[0].shape, -np.inf), np.full(runs[0].shape, np.inf)
    for start, run, size in zip(starts, runs, boxes[:, 5:8].T, strict=True):
        run = np.where(np.abs(run) < 1e-9, 1e-9, run)
        first, second = (-size / 2 - start) / run, (size / 2 - start) / run
        enter = np.maximum(enter, np.minimum(first, second))
        leave = np.minimum(leave, np.maximum(first, second))
    hit = (enter < leave) & (leave > 0) & (enter < 0.995)
    return np.asarray(hit.any(axis=1))


def _between(origin: Array, ray: Array, boxes: Array) -> NDArray[np.bool_]:
    """Return which boxes come near the bundle of rays in the floor plan; the others cannot block any."""
    middle = ray[:, :2].mean(axis=0)
    ahead = middle / max(float(np.hypot(*middle)), 1e-9)
    along, across = ray[:, :2] @ ahead, ray[:, 1] * ahead[0] - ray[:, 0] * ahead[1]
    gap = boxes[:, :2] - origin[:2]
    reach = np.hypot(boxes[:, 5], boxes[:, 6]) / 2 + 1e-6
    deep, aside = gap @ ahead, gap[:, 1] * ahead[0] - gap[:, 0] * ahead[1]
    near = (deep > min(float(along.min()), 0.0) - reach) & (deep < max(float(along.max()), 0.0) + reach)
    return np.asarray(
        near & (aside > min(float(across.min()), 0.0) - reach) & (aside < max(float(across.max()), 0.0) + reach)
    )
