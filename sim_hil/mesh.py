"""Triangle meshes gathered by texture: quads, boxes, prisms and balls, as few bodies as there are textures.

The software renderer pays for every body and draws primitive capsules as rough prisms; one mesh a texture is faster and
looks better. Plain colours become cells of one palette texture. Faces are drawn from their outer side only.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from math import cos, pi, sin
from pathlib import Path

import numpy as np
import pybullet
from numpy.typing import NDArray

from sim_hil.textures import Colour, Image, palette, write_png

Vec3 = tuple[float, float, float]
Vec2 = tuple[float, float]
_PALETTE = "palette"


class Frame:
    """A pose to build in: origin, and unit axes forward (front), left and up, in the parent's coordinates."""

    def __init__(self, origin: Vec3 = (0.0, 0.0, 0.0), heading_rad: float = 0.0) -> None:
        self.origin = np.array(origin)
        c, s = cos(heading_rad), sin(heading_rad)
        self.axes = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))

    def point(self, p: Sequence[float]) -> Vec3:
        """Parent coordinates of a point of this frame."""
        x, y, z = self.origin + self.axes @ np.asarray(p, dtype=np.float64)
        return (float(x), float(y), float(z))


class MeshBuilder:
    """Collects faces; `pictures` maps a texture's name to its RGB picture."""

    def __init__(self) -> None:
        self.pictures: dict[str, Image] = {}
        self._faces: dict[str, tuple[list[Vec3], list[int], list[Vec2], list[Vec3]]] = {}
        self._colours: list[Colour] = []

    def picture(self, name: str, image: Image) -> str:
        """Register a picture under a name, to be used as `texture`."""
        self.pictures[name] = image
        return name

    def _cell(self, colour: Colour) -> int:
        if colour not in self._colours:
            self._colours.append(colour)
        return self._colours.index(colour)

    def _append(self, texture: str, corners: Sequence[Vec3], uvs: Sequence[Vec2], normals: Sequence[Vec3]) -> None:
        vertices, indices, all_uvs, all_normals = self._faces.setdefault(texture, ([], [], [], []))
        first = len(vertices)
        vertices.extend(corners)
        all_uvs.extend(uvs)
        all_normals.extend(normals)
        for k in range(1, len(corners) - 1):
            indices.extend((first, first + k, first + k + 1))

    def quad(self, texture: str, corners: Sequence[Vec3], repeat: Vec2 = (1.0, 1.0)) -> None:
        """A textured quad; corners as its viewer sees them: bottom left, bottom right, top right, top left."""
        u, v = repeat
        self._append(texture, corners, ((0, 0), (u, 0), (u, v), (0, v)), (_normal(corners),) * 4)

    def face(self, colour: Colour, corners: Sequence[Vec3], normals: Sequence[Vec3] | None = None) -> None:
        """A plain convex face, corners counter-clockwise as its viewer sees them."""
        cell = float(self._cell(colour))
        spread = normals if normals is not None else (_normal(corners),) * len(corners)
        self._append(_PALETTE, corners, ((cell, 0.5),) * len(corners), spread)

    def box(
        self,
        frame: Frame,
        centre: Sequence[float],
        size: Sequence[float],
        colour: Colour,
        front: str = "",
        sides: str = "",
    ) -> None:
        """A box in a frame; its +x face may show a picture, and so may its +y and -y faces."""
        (x, y, z), (a, b, c) = centre, (extent / 2 for extent in size)
        at = lambda i, j, k: frame.point((x + i * a, y + j * b, z + k * c))  # noqa: E731 - eight corners, one rule
        faces = (
            (front, (at(1, -1, -1), at(1, 1, -1), at(1, 1, 1), at(1, -1, 1))),
            ("", (at(-1, 1, -1), at(-1, -1, -1), at(-1, -1, 1), at(-1, 1, 1))),
            (sides, (at(1, 1, -1), at(-1, 1, -1), at(-1, 1, 1), at(1, 1, 1))),
            (sides, (at(-1, -1, -1), at(1, -1, -1), at(1, -1, 1), at(-1, -1, 1))),
            ("", (at(-1, -1, 1), at(1, -1, 1), at(1, 1, 1), at(-1, 1, 1))),
            ("", (at(-1, 1, -1), at(1, 1, -1), at(1, -1, -1), at(-1, -1, -1))),
        )
        for texture, corners in faces:
            if texture:
                self.quad(texture, corners)
            else:
                self.face(colour, corners)

    def prism(
        self, frame: Frame, rings: Sequence[tuple[Sequence[float], float, float]], colour: Colour, sides: int = 8
    ) -> None:
        """A tube through elliptic rings ((x, y, z) of the middle, radius along x, radius along y), closed at both ends.

        Rings go upwards; a limb, a torso, a bottle or a pot is a few of them.
        """
        loops = []
        for (x, y, z), rx, ry in rings:
            angles = [2 * pi * (k + 0.5) / sides for k in range(sides)]
            loops.append([frame.point((x + rx * cos(t), y + ry * sin(t), z)) for t in angles])
        around = [2 * pi * (k + 0.5) / sides for k in range(sides)]
        outward = [tuple(float(v) for v in frame.axes @ (cos(t), sin(t), 0.0)) for t in around]
        for lower, upper in itertools.pairwise(loops):
            for k in range(sides):
                n = (k + 1) % sides
                normals = (outward[k], outward[n], outward[n], outward[k])
                self.face(colour, (lower[k], lower[n], upper[n], upper[k]), normals)  # type: ignore[arg-type]
        self.face(colour, loops[-1])
        self.face(colour, tuple(reversed(loops[0])))

    def ball(
        self, frame: Frame, centre: Sequence[float], radii: Sequence[float], colour: Colour, sides: int = 8
    ) -> None:
        """An ellipsoid as a stack of rings."""
        rings = []
        for angle in np.linspace(-pi / 2 * 0.92, pi / 2 * 0.92, 6):
            width = cos(angle)
            z = centre[2] + radii[2] * sin(angle)
            rings.append(((centre[0], centre[1], z), radii[0] * width, radii[1] * width))
        self.prism(frame, rings, colour, sides)

    def bodies(self, client: int, folder: Path, prefix: str) -> list[int]:
        """Create one collision-free body a texture in `client`; textures pass through PNG files in `folder`."""
        made = []
        for texture, (vertices, indices, uvs, normals) in self._faces.items():
            if texture == _PALETTE:
                image = palette(self._colours)
                uvs = [((cell + 0.5) / len(self._colours), v) for cell, v in uvs]
            else:
                image = self.pictures[texture]
            path = write_png(image, folder / f"{prefix}{len(made)}.png")
            handle = pybullet.loadTexture(str(path), physicsClientId=client)
            shape = pybullet.createVisualShape(
                pybullet.GEOM_MESH, vertices=vertices, indices=indices, uvs=uvs, normals=normals,
                physicsClientId=client,
            )  # fmt: skip
            body = int(pybullet.createMultiBody(0, -1, shape, physicsClientId=client))
            pybullet.changeVisualShape(body, -1, textureUniqueId=handle, physicsClientId=client)
            made.append(body)
        return made


def _normal(corners: Sequence[Vec3]) -> Vec3:
    a, b, c = (np.asarray(corner) for corner in corners[:3])
    n: NDArray[np.float64] = np.cross(b - a, c - a)
    length = float(np.linalg.norm(n)) or 1.0
    return (float(n[0]) / length, float(n[1]) / length, float(n[2]) / length)
