"""Geometry of routes: polylines, bounding boxes, and the exits of a corridor, aisle or sidewalk to either side."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot

import numpy as np

from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Area, Scene, Vec2

LINEAR = frozenset(("corridor", "aisle", "sidewalk", "crossing"))  # areas that are followed along their length
_STEP_M = 0.1
_BODY_M = 0.3  # radius of a body that must fit through an opening
_BEYOND_M = 0.45
_SIDEWAYS_M = 1.0  # extent to one side from which a crossed corridor counts as an opening


def dense(path: Sequence[Vec2], step_m: float = 0.1) -> list[Vec2]:
    """Return points along a polyline at most about `step_m` apart, its own points included."""
    points = [path[0]]
    for a, b in itertools.pairwise(path):
        count = max(1, round(hypot(b[0] - a[0], b[1] - a[1]) / step_m))
        points += [(a[0] + (b[0] - a[0]) * k / count, a[1] + (b[1] - a[1]) * k / count) for k in range(1, count + 1)]
    return points


@dataclass(frozen=True)
class Bounds:
    """Axis-aligned bounding box of an area, m."""

    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def along_x(self) -> bool:
        """Whether it is longer along x."""
        return self.x1 - self.x0 >= self.y1 - self.y0


def bounds_of(area: Area) -> Bounds:
    """Return the axis-aligned bounding box of an area's polygon."""
    xs, ys = zip(*area.polygon, strict=True)
    return Bounds(min(xs), min(ys), max(xs), max(ys))


@dataclass(frozen=True)
class Opening:
    """An exit to one side into `area`, from `low_m` to `high_m` along the direction of travel."""

    side: str
    low_m: float
    high_m: float
    area: Area

    @property
    def middle_m(self) -> float:
        """Middle along the direction of travel, m."""
        return (self.low_m + self.high_m) / 2


@dataclass(frozen=True)
class Frame:
    """Frame of a direction of travel along x or y: `along` increases ahead, `across` to the left."""

    direction: Vec2  # a unit vector along an axis

    def along(self, p: Vec2) -> float:
        """Return the coordinate ahead, m."""
        return p[0] * self.direction[0] + p[1] * self.direction[1]

    def across(self, p: Vec2) -> float:
        """Return the coordinate to the left, m."""
        return p[1] * self.direction[0] - p[0] * self.direction[1]

    def point(self, along: float, across: float) -> Vec2:
        """Return the world point of the two coordinates."""
        dx, dy = self.direction
        return (along * dx - across * dy, along * dy + across * dx)

    def span(self, box: Bounds) -> tuple[Vec2, Vec2]:
        """(from, to) ahead and (from, to) to the left of a box."""
        corners = [(box.x0, box.y0), (box.x1, box.y1)]
        ahead = sorted(self.along(c) for c in corners)
        left = sorted(self.across(c) for c in corners)
        return (ahead[0], ahead[1]), (left[0], left[1])


def opening_class(kind: str) -> str:
    """Return the class of openings that are counted together: corridors and aisles form one class."""
    return "passage" if kind in ("corridor", "aisle") else kind


def is_open(grid: NavGrid, a: Vec2, b: Vec2) -> bool:
    """Return whether a small body fits through the straight line between two points."""
    count = max(2, int(np.hypot(b[0] - a[0], b[1] - a[1]) / 0.1) + 1)
    share = np.linspace(0, 1, count)[:, None]
    points = np.array(a) * (1 - share) + np.array(b) * share
    return bool(np.all(grid.clearances_at(points) >= _BODY_M))


def side_openings(
    scene: Scene, grid: NavGrid, frame: Frame, followed: list[Area], crossed: list[Area], side: str
) -> list[Opening]:  # fmt: skip
    """Return the openings to one side of the followed areas, in the order in which they are passed.

    `crossed`: corridors that the route crosses; they open to both sides.
    """
    sign = 1.0 if side == "left" else -1.0
    own = {area.label for area in (*followed, *crossed)}
    found: list[Opening] = []
    edges = []
    for area in followed:
        (low, high), across = frame.span(bounds_of(area))
        edge = across[1] if side == "left" else across[0]
        edges.append(edge)
        for other in scene.areas:
            if other.label in own:
                continue
            (o_low, o_high), (o_right, o_left) = frame.span(bounds_of(other))
            near = o_right if side == "left" else o_left
            if abs(near - edge) > 0.02:
                continue
            start, end = max(low, o_low), min(high, o_high)
            if end - start > 0.3:
                found += _gaps(grid, frame, (start, end), edge, sign, side, other)
    for area in crossed:
        (low, high), across = frame.span(bounds_of(area))
        reach = (across[1] - max(edges)) if side == "left" else (min(edges) - across[0])
        if edges and reach >= _SIDEWAYS_M:
            found.append(Opening(side, low, high, area))
    return sorted(found, key=lambda opening: opening.middle_m)


def _gaps(
    grid: NavGrid, frame: Frame, span: Vec2, edge: float, sign: float, side: str, area: Area
) -> list[Opening]:  # fmt: skip
    count = max(2, int((span[1] - span[0]) / _STEP_M) + 1)
    along = np.linspace(span[0], span[1], count)
    open_ = np.ones(count, bool)
    for beyond in (-_BEYOND_M, -_BEYOND_M / 2, 0.0, _BEYOND_M / 2, _BEYOND_M):
        points = np.array([frame.point(float(a), edge + sign * beyond) for a in along])
        open_ &= grid.clearances_at(points) >= _BODY_M
    found, index = [], 0
    while index < count:
        if not open_[index]:
            index += 1
            continue
        first = index
        while index < count and open_[index]:
            index += 1
        low, high = max(span[0], along[first] - _BODY_M), min(span[1], along[index - 1] + _BODY_M)
        found.append(Opening(side, float(low), float(high), area))
    return found
