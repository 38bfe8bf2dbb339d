"""Tools for building one object's mesh: parts in fractions of its size, textures shared by equal objects."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from functools import lru_cache

import numpy as np

from sim_hil.scene.scene import SceneObject
from sim_hil.world.drawing.mesh import Frame, MeshBuilder, Vec3
from sim_hil.world.drawing.textures import Colour, Image, rgb

Span = tuple[float, float]
Drawing = Callable[[SceneObject], Image]

WOOD: Colour = (158, 110, 66)
STEEL: Colour = (160, 164, 170)
DARK: Colour = (34, 36, 40)
BLACK: Colour = (22, 22, 24)
WHITE: Colour = (240, 240, 238)
CARTON: Colour = (190, 146, 92)
_ON_FLOOR_M = 1e-3


class Kit:
    """Builder of an object's mesh in the object's frame: x forward, y left, z up from its underside.

    Spans and points are fractions of depth, width and height: -0.5 to 0.5 across, 0 to 1 up; radii are in m.
    """

    def __init__(self, mesh: MeshBuilder, thing: SceneObject) -> None:
        self.mesh, self.thing = mesh, thing
        self.frame = Frame(thing.position_m, thing.heading_rad)
        self.depth, self.width, self.height = thing.size_m
        self._low = thing.position_m[2] < _ON_FLOOR_M

    def paint(self, brightness: float = 1.0) -> Colour:
        """Return the object's colour, lighter or darker."""
        return rgb(self.thing.colour, brightness)

    def rng(self) -> np.random.Generator:
        """Return a random generator that is always the same for this object."""
        return np.random.default_rng(zlib.crc32(self.thing.label.encode()))

    def at(self, x: float, y: float, z: float) -> Vec3:
        """Convert fractions to a point in the object's frame, m."""
        return (x * self.depth, y * self.width, z * self.height)

    def world(self, x: float, y: float, z: float) -> Vec3:
        """Convert fractions to a point in the world, m."""
        return self.frame.point(self.at(x, y, z))

    def picture(self, drawing: Drawing) -> str:
        """Return the name of a texture for this object, drawn by a function of its size, colour and text."""
        thing = self.thing
        image = _drawn(drawing, thing.kind, thing.size_m, thing.colour, thing.text)
        return self.mesh.picture(f"{getattr(drawing, '__name__', 'picture')} {id(image)}", image)

    def part(
        self, x: Span, y: Span, z: Span, colour: Colour,
        front: str = "", sides: str = "", back: str = "", top: str = "",
    ) -> None:  # fmt: skip
        """Add a box between two points."""
        centre = self.at(sum(x) / 2, sum(y) / 2, sum(z) / 2)
        size = self.at(x[1] - x[0], y[1] - y[0], z[1] - z[0])
        hidden = self._low and z[0] <= 0
        self.mesh.box(self.frame, centre, size, colour, front, sides, back, top, bottom=not hidden)

    def whole(self, colour: Colour, front: str = "", sides: str = "", back: str = "", top: str = "") -> None:
        """Add a box of the object's size."""
        self.part((-0.5, 0.5), (-0.5, 0.5), (0.0, 1.0), colour, front, sides, back, top)

    def post(self, x: float, y: float, z: Span, radius_m: float, colour: Colour, sides: int = 6) -> None:
        """Add an upright round post."""
        rings = tuple((self.at(x, y, level), radius_m, radius_m) for level in z)
        self.mesh.prism(self.frame, rings, colour, sides)

    def rings(self, levels: tuple[tuple[float, float], ...], colour: Colour, sides: int = 12) -> None:
        """Add a body of revolution about the object's axis: (height, radius) in fractions of height and depth."""
        shaped = tuple(((0.0, 0.0, z * self.height), r * self.depth, r * self.width) for z, r in levels)
        self.mesh.prism(self.frame, shaped, colour, sides)

    def wheel(
        self, x: float, y: float, radius_m: float, width_m: float, colour: Colour = BLACK, up_m: float = 0.0
    ) -> None:
        """Add a wheel on the floor or `up_m` above it."""
        self.mesh.wheel(self.frame, (x * self.depth, y * self.width, radius_m + up_m), radius_m, width_m, colour)

    def ball(
        self, x: float, y: float, z: float, radii_m: Vec3, colour: Colour, sides: int = 8, levels: int = 6
    ) -> None:  # fmt: skip
        """Add an ellipsoid."""
        self.mesh.ball(self.frame, self.at(x, y, z), radii_m, colour, sides, levels)

    def face(self, colour: Colour, *corners: Vec3) -> None:
        """Add a plain face through points given as fractions, counter-clockwise for the viewer."""
        self.mesh.face(colour, [self.world(*corner) for corner in corners])

    def both(self, colour: Colour, under: Colour, *corners: Vec3) -> None:
        """Add a thin face that is visible from both sides."""
        points = [self.world(*corner) for corner in corners]
        self.mesh.face(colour, points)
        self.mesh.face(under, points[::-1])

    def print(self, drawing: Drawing, *corners: Vec3) -> None:
        """Add a textured quad through points given as fractions: bottom left, bottom right, top right, top left."""
        self.mesh.quad(self.picture(drawing), [self.world(*corner) for corner in corners])

    def legs(self, z: Span, inset: float, thick: Span, colour: Colour) -> None:
        """Add four legs; `thick` in fractions of depth and width."""
        (tx, ty), edge = thick, 0.5 - inset
        for sx in (-1, 1):
            for sy in (-1, 1):
                x, y = sorted((sx * edge, sx * (edge - tx))), sorted((sy * edge, sy * (edge - ty)))
                self.part((x[0], x[1]), (y[0], y[1]), z, colour)


@lru_cache(maxsize=1024)
def _drawn(drawing: Drawing, kind: str, size_m: Vec3, colour: tuple[float, float, float], text: str) -> Image:
    return drawing(SceneObject("", kind, (0.0, 0.0, 0.0), 0.0, size_m, colour, text))


def plate(drawing: Drawing, brightness: float = 0.6) -> Callable[[Kit], None]:
    """Return a builder of a box with a print on its front; `brightness` of the other sides."""
    return lambda kit: kit.whole(kit.paint(brightness), kit.picture(drawing))
