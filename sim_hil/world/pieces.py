"""Meshes of a scene divided into squares of floor, so that a renderer can skip invisible ones."""

from __future__ import annotations

from collections.abc import Callable
from math import floor

from sim_hil.world.drawing.mesh import MeshBuilder
from sim_hil.world.drawing.surfaces import surface_picture

Vec2 = tuple[float, float]


class Pieces:
    """Meshes by square of floor, created by `make`; `around` contains faces far outside the scene."""

    def __init__(self, square_m: float, make: Callable[[], MeshBuilder] = MeshBuilder) -> None:
        self._square_m, self._make = square_m, make
        self._meshes: dict[tuple[int, int], MeshBuilder] = {}
        self.around = make()

    def at(self, x: float, y: float) -> MeshBuilder:
        """Return the mesh of the square that contains a point, m."""
        square = (floor(x / self._square_m), floor(y / self._square_m))
        if square not in self._meshes:
            self._meshes[square] = self._make()
        return self._meshes[square]

    def all(self) -> list[MeshBuilder]:
        """Return all meshes, ordered by position."""
        meshes = [self._meshes[square] for square in sorted(self._meshes)]
        return [mesh for mesh in (*meshes, self.around) if not mesh.empty()]


def surface(mesh: MeshBuilder, texture: str) -> str:
    """Register a repeating texture with a mesh and return its name."""
    if not mesh.has_picture(texture):
        mesh.picture(texture, surface_picture(texture))
    return texture


def clip(polygon: list[Vec2], a: Vec2, b: Vec2, keep_left: bool) -> list[Vec2]:
    """Return the part of a convex polygon on one side of the line from `a` to `b`."""
    sign = 1.0 if keep_left else -1.0
    side = [sign * ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) for x, y in polygon]
    kept: list[Vec2] = []
    for index, (here, there) in enumerate(zip(polygon, polygon[1:] + polygon[:1], strict=True)):
        s, t = side[index], side[(index + 1) % len(side)]
        if s >= 0:
            kept.append(here)
        if (s > 0 > t) or (s < 0 < t):
            share = s / (s - t)
            kept.append((here[0] + share * (there[0] - here[0]), here[1] + share * (there[1] - here[1])))
    return kept if len(kept) >= 3 and _area(kept) > 1e-6 else []


def split(polygon: list[Vec2], cutter: list[Vec2]) -> tuple[list[Vec2], list[list[Vec2]]]:
    """Cut a convex polygon by a counter-clockwise one; return the part inside and the pieces outside."""
    inside, outside = polygon, []
    for a, b in zip(cutter, cutter[1:] + cutter[:1], strict=True):
        beyond = clip(inside, a, b, keep_left=False)
        if beyond:
            outside.append(beyond)
        inside = clip(inside, a, b, keep_left=True)
        if not inside:
            return [], [polygon]
    return inside, outside


def counter_clockwise(polygon: list[Vec2]) -> list[Vec2]:
    """Return the polygon in counter-clockwise order."""
    return polygon if _area(polygon) > 0 else polygon[::-1]


def _area(polygon: list[Vec2]) -> float:
    return sum(a[0] * b[1] - b[0] * a[1] for a, b in zip(polygon, polygon[1:] + polygon[:1], strict=True)) / 2
