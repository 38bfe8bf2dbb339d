"""Triangle meshes grouped by texture: quads, boxes, prisms and ellipsoids, with one surface per texture.

Faces are visible from their outer side only. This module is independent of the renderer; a stage draws the surfaces.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import cos, pi, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from sim_hil.world.drawing.textures import Colour, Image

Vec3 = tuple[float, float, float]
Vec2 = tuple[float, float]


class Frame:
    """Upright frame to build in (x forward, y left, z up), given in the parent's coordinates."""

    def __init__(self, origin: Vec3 = (0.0, 0.0, 0.0), heading_rad: float = 0.0) -> None:
        self.origin, self.heading_rad = origin, heading_rad
        self._c, self._s = cos(heading_rad), sin(heading_rad)

    def point(self, p: Sequence[float]) -> Vec3:
        """Return the parent coordinates of a point."""
        (x, y, z), (u, v, w) = self.origin, p
        return (x + self._c * u - self._s * v, y + self._s * u + self._c * v, z + w)

    def direction(self, d: Sequence[float]) -> Vec3:
        """Return a direction in parent coordinates."""
        u, v, w = d
        return (self._c * u - self._s * v, self._s * u + self._c * v, w)

    def at(self, p: Sequence[float], heading_rad: float = 0.0) -> Frame:
        """Return a child frame with origin `p`, rotated by `heading_rad`."""
        return Frame(self.point(p), self.heading_rad + heading_rad)


@dataclass
class Surface:
    """Triangles that share a texture; a plain surface has no texture, but a colour per vertex."""

    image: Image | None
    vertices: list[Vec3] = field(default_factory=list)
    indices: list[int] = field(default_factory=list)
    uvs: list[Vec2] = field(default_factory=list)  # in units of texture repetitions; unused for a plain surface
    normals: list[Vec3] = field(default_factory=list)
    colours: list[Colour] = field(default_factory=list)  # for a plain surface only

    def arrays(self) -> tuple[NDArray[np.float32], NDArray[np.uint32], NDArray[np.float32], NDArray[np.float32]]:
        """Return vertices [n, 3], indices [3 m], uvs [n, 2] and normals [n, 3]."""
        shapes = ((self.vertices, 3), (self.uvs, 2), (self.normals, 3))
        vertices, uvs, normals = (np.array(values, np.float32).reshape(-1, size) for values, size in shapes)
        return vertices, np.array(self.indices, np.uint32), uvs, normals


class MeshBuilder:
    """Mesh that collects faces by texture; `detail` below 1 gives round parts fewer sides, for distant objects."""

    def __init__(self, detail: float = 1.0) -> None:
        self._detail = detail
        self._pictures: dict[str, Image] = {}
        self._textured: dict[str, Surface] = {}
        self._plain = Surface(None)

    def picture(self, name: str, image: Image) -> str:
        """Register an image under a name, to be used as `texture`."""
        self._pictures[name] = image
        return name

    def has_picture(self, name: str) -> bool:
        """Return whether an image with that name is registered."""
        return name in self._pictures

    def surfaces(self) -> Iterator[Surface]:
        """Return the surfaces: first the plain faces, then one surface per texture."""
        if self._plain.indices:
            yield self._plain
        yield from self._textured.values()

    def empty(self) -> bool:
        """Whether the mesh has no faces."""
        return not self._plain.indices and not self._textured

    def bounds(self) -> tuple[float, float, float, float]:
        """Return the extent (x0, y0, x1, y1), m. Raises ValueError for an empty mesh."""
        corners = np.concatenate([np.array(surface.vertices) for surface in self.surfaces()])
        (x0, y0), (x1, y1) = corners[:, :2].min(axis=0), corners[:, :2].max(axis=0)
        return (float(x0), float(y0), float(x1), float(y1))

    def quad(self, texture: str, corners: Sequence[Vec3], repeat: Vec2 = (1.0, 1.0), origin: Vec2 = (0.0, 0.0)) -> None:
        """Add a textured quad; corners for the viewer: bottom left, bottom right, top right, top left."""
        (u, v), (a, b) = repeat, origin
        self.patch(texture, corners, ((a, b), (a + u, b), (a + u, b + v), (a, b + v)))

    def patch(self, texture: str, corners: Sequence[Vec3], uvs: Sequence[Vec2]) -> None:
        """Add a textured convex face, corners counter-clockwise for the viewer."""
        surface = self._textured.get(texture)
        if surface is None:
            surface = self._textured[texture] = Surface(self._pictures[texture])
        surface.uvs.extend(uvs)
        _fan(surface, corners, (_normal(corners),) * len(corners))

    def face(self, colour: Colour, corners: Sequence[Vec3], normals: Sequence[Vec3] | None = None) -> None:
        """Add a plain convex face, corners counter-clockwise for the viewer."""
        self._plain.colours.extend((colour,) * len(corners))
        self._plain.uvs.extend(((0.0, 0.0),) * len(corners))
        _fan(self._plain, corners, normals if normals is not None else (_normal(corners),) * len(corners))

    def box(
        self, frame: Frame, centre: Sequence[float], size: Sequence[float], colour: Colour,
        front: str = "", sides: str = "", back: str = "", top: str = "", bottom: bool = True,
    ) -> None:  # fmt: skip
        """Add a box in a frame; faces may be textured (front +x, sides +y and -y). `bottom`: include that face."""
        (x, y, z), (a, b, c) = centre, (extent / 2 for extent in size)

        def at(i: int, j: int, k: int) -> Vec3:
            return frame.point((x + i * a, y + j * b, z + k * c))

        faces = [
            (front, (at(1, -1, -1), at(1, 1, -1), at(1, 1, 1), at(1, -1, 1))),
            (back, (at(-1, 1, -1), at(-1, -1, -1), at(-1, -1, 1), at(-1, 1, 1))),
            (sides, (at(1, 1, -1), at(-1, 1, -1), at(-1, 1, 1), at(1, 1, 1))),
            (sides, (at(-1, -1, -1), at(1, -1, -1), at(1, -1, 1), at(-1, -1, 1))),
            (top, (at(-1, 1, 1), at(-1, -1, 1), at(1, -1, 1), at(1, 1, 1))),
        ]
        if bottom:
            faces.append(("", (at(-1, 1, -1), at(1, 1, -1), at(1, -1, -1), at(-1, -1, -1))))
        for texture, corners in faces:
            if texture:
                self.quad(texture, corners)
            else:
                self.face(colour, corners)

    def wheel(
        self, frame: Frame, centre: Sequence[float], radius: float, width: float, colour: Colour, sides: int = 10
    ) -> None:
        """Add an upright disc with its axis along y."""
        sides = max(round(sides * self._detail), 5)
        (x, y, z), turns = centre, [2 * pi * (k + 0.5) / sides for k in range(sides)]
        right, left = (
            [frame.point((x + radius * cos(t), y + side * width / 2, z + radius * sin(t))) for t in turns]
            for side in (-1, 1)
        )
        for k in range(sides):
            n = (k + 1) % sides
            self.face(colour, (right[k], left[k], left[n], right[n]))
        self.face(colour, right)
        self.face(colour, left[::-1])

    def prism(
        self, frame: Frame, rings: Sequence[tuple[Sequence[float], float, float]], colour: Colour, sides: int = 8
    ) -> None:
        """Add a closed tube through elliptic rings: (x, y, z) of the centre, radius along x, radius along y.
        Rings are ordered upwards; a limb, a torso, a bottle or a pot consists of a few rings.
        """
        sides = max(round(sides * self._detail), 4)
        around = [(cos(t), sin(t)) for t in (2 * pi * (k + 0.5) / sides for k in range(sides))]
        loops = [[frame.point((x + rx * c, y + ry * s, z)) for c, s in around] for (x, y, z), rx, ry in rings]
        outward = [frame.direction((c, s, 0.0)) for c, s in around]
        for lower, upper in itertools.pairwise(loops):
            for k in range(sides):
                n = (k + 1) % sides
                normals = (outward[k], outward[n], outward[n], outward[k])
                self.face(colour, (lower[k], lower[n], upper[n], upper[k]), normals)
        self.face(colour, loops[-1])
        self.face(colour, tuple(reversed(loops[0])))

    def ball(
        self, frame: Frame, centre: Sequence[float], radii: Sequence[float], colour: Colour,
        sides: int = 8, levels: int = 6,
    ) -> None:  # fmt: skip
        """Add an ellipsoid as a stack of rings."""
        rings = []
        levels = max(round(levels * self._detail), 3)
        for level in range(levels):
            angle = pi / 2 * 0.92 * (2 * level / (levels - 1) - 1)
            width = cos(angle)
            z = centre[2] + radii[2] * sin(angle)
            rings.append(((centre[0], centre[1], z), radii[0] * width, radii[1] * width))
        self.prism(frame, rings, colour, sides)


def _fan(surface: Surface, corners: Sequence[Vec3], normals: Sequence[Vec3]) -> None:
    first = len(surface.vertices)
    surface.vertices.extend(corners)
    surface.normals.extend(normals)
    for k in range(1, len(corners) - 1):
        surface.indices.extend((first, first + k, first + k + 1))


def _normal(corners: Sequence[Vec3]) -> Vec3:
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = corners[:3]
    ux, uy, uz, vx, vy, vz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = sqrt(x * x + y * y + z * z) or 1.0
    return (x / length, y / length, z / length)
