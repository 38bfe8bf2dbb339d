"""Terrain: ramps, bumps, kerbs and platforms as exact convex solids."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from math import cos, pi, sin

from sim_hil.scene.parts import FLOOR_TEXTURES, Vec2, Vec3, check_choice
from sim_hil.scene.table import SceneError

TERRAIN_KINDS = frozenset(("ramp", "bump", "kerb", "platform"))
_BUMP_SEGMENTS = 12


@dataclass(frozen=True)
class ConvexPiece:
    """Convex solid given by its vertices in the world, m, for a physics engine."""

    label: str
    vertices_m: tuple[Vec3, ...]


@dataclass(frozen=True)
class Terrain:
    """Solid ground, up to `rise_m` above `position_m` (centre of its underside), m.

    `size_m`: length along `heading_rad`, and width. A ramp rises from its back to its front, where it drops off; a bump
    follows half a sine wave along its length; kerbs and platforms are flat.
    """

    label: str
    kind: str
    position_m: Vec3
    heading_rad: float
    size_m: Vec2
    rise_m: float
    texture: str

    def __post_init__(self) -> None:
        check_choice(f"terrain {self.label}", "kind", self.kind, TERRAIN_KINDS)
        check_choice(f"terrain {self.label}", "texture", self.texture, FLOOR_TEXTURES)
        if min(self.size_m) <= 0 or self.rise_m <= 0:
            raise SceneError(
                f"terrain {self.label}: size_m and rise_m must be positive, found {self.size_m}, {self.rise_m}"
            )

    def profile(self) -> tuple[Vec2, ...]:
        """Top line along the heading from back to front: (distance from the middle, height over the underside), m."""
        half, rise = self.size_m[0] / 2, self.rise_m
        if self.kind == "ramp":
            return ((-half, 0.0), (half, rise))
        if self.kind == "bump":
            shares = [k / _BUMP_SEGMENTS for k in range(_BUMP_SEGMENTS + 1)]
            return tuple((half * (2 * share - 1), rise * max(sin(pi * share), 0.0)) for share in shares)
        return ((-half, rise), (half, rise))

    def piece(self) -> ConvexPiece:
        """The solid as its corners."""
        line = [(-self.size_m[0] / 2, 0.0), *self.profile(), (self.size_m[0] / 2, 0.0)]
        half = self.size_m[1] / 2
        unique = sorted(set(line))
        return ConvexPiece(self.label, tuple(self.point(u, side * half, h) for u, h in unique for side in (-1, 1)))

    def point(self, u: float, v: float, h: float) -> Vec3:
        """World coordinates, m, of a point along the heading, to the left and up from the middle of the underside."""
        (x, y, z), c, s = self.position_m, cos(self.heading_rad), sin(self.heading_rad)
        return (x + c * u - s * v, y + s * u + c * v, z + h)

    def height_m(self, x: float, y: float) -> float | None:
        """Height of its top above the world's floor there; None beside it."""
        (px, py, pz), c, s = self.position_m, cos(self.heading_rad), sin(self.heading_rad)
        u, v = c * (x - px) + s * (y - py), -s * (x - px) + c * (y - py)
        if abs(v) > self.size_m[1] / 2 or abs(u) > self.size_m[0] / 2:
            return None
        line = self.profile()
        for (a, low), (b, high) in itertools.pairwise(line):
            if u <= b:
                return pz + low + (high - low) * (u - a) / (b - a)
        return pz + line[-1][1]

    def corners(self) -> tuple[Vec2, ...]:
        """Outline on the floor, counter-clockwise."""
        a, b = self.size_m[0] / 2, self.size_m[1] / 2
        return tuple(self.point(u, v, 0)[:2] for u, v in ((-a, -b), (a, -b), (a, b), (-a, b)))
