"""Parts of a scene: walls, objects, floor patches, terrain, routes and places of people, named areas."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from math import atan2, cos, hypot, pi, sin

from sim_hil.scene.kinds import KINDS
from sim_hil.scene.table import SceneError

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]

FLOOR_TEXTURES = frozenset(
    (
        "floor_tiles", "vinyl", "vinyl_green", "carpet_tiles", "carpet_blue", "wood", "marble", "concrete",
        "concrete_yellow_line", "hazard_stripes", "asphalt", "asphalt_line", "paving", "paving_light", "cobbles",
        "grass", "soil", "zebra_crossing", "kerb_stone", "tactile_paving", "metal_plate",
    )
)  # fmt: skip
WALL_TEXTURES = frozenset(
    (
        "wall_wainscot", "wall_hospital", "wall_office", "wall_glass", "wall_warehouse", "wall_brick", "wall_concrete",
        "wall_plaster", "railing",
    )
)  # fmt: skip
CEILING_TEXTURES = frozenset(("ceiling_panels", "ceiling_steel", "ceiling_plaster"))
TEXTURES = FLOOR_TEXTURES | WALL_TEXTURES | CEILING_TEXTURES
AREA_KINDS = frozenset(
    ("corridor", "room", "lobby", "aisle", "yard", "plaza", "sidewalk", "street", "crossing", "garden")
)
PLACE_KINDS = frozenset(("stand", "sit", "queue", "door"))
TERRAIN_KINDS = frozenset(("ramp", "bump", "kerb", "platform"))
_BUMP_SEGMENTS = 12


@dataclass(frozen=True)
class Box:
    """An upright box: centre m, direction of its length axis (unit x, y), and size along, across and up, m."""

    centre_m: Vec3
    axis: Vec2
    size_m: Vec3

    def corners(self) -> tuple[Vec2, ...]:
        """The four floor corners, counter-clockwise."""
        (x, y, _), (c, s) = self.centre_m, self.axis
        a, b = self.size_m[0] / 2, self.size_m[1] / 2
        return tuple((x + c * u - s * v, y + s * u + c * v) for u, v in ((-a, -b), (a, -b), (a, b), (-a, b)))


@dataclass(frozen=True)
class Wall:
    """An upright slab whose centre line runs from `start_m` to `end_m`."""

    label: str
    start_m: Vec2
    end_m: Vec2
    thickness_m: float
    height_m: float
    texture: str

    def __post_init__(self) -> None:
        if self.start_m == self.end_m or self.thickness_m <= 0 or self.height_m <= 0:
            raise SceneError(f"wall {self.label}: expected two different ends and positive thickness and height")
        check_choice(f"wall {self.label}", "texture", self.texture, WALL_TEXTURES)

    @property
    def box(self) -> Box:
        """The wall as an upright box."""
        (x0, y0), (x1, y1) = self.start_m, self.end_m
        length = hypot(x1 - x0, y1 - y0)
        return Box(
            ((x0 + x1) / 2, (y0 + y1) / 2, self.height_m / 2),
            ((x1 - x0) / length, (y1 - y0) / length),
            (length, self.thickness_m, self.height_m),
        )


@dataclass(frozen=True)
class SceneObject:
    """An object; `position_m`: centre of its underside, `heading_rad`: direction of its front.

    `size_m`: depth (front to back), width and height; `text`: printed on it; `landmark`: its name for instructions
    ("vending machine"), empty if no instruction may name it.
    """

    label: str
    kind: str
    position_m: Vec3
    heading_rad: float
    size_m: Vec3
    colour: Vec3
    text: str
    landmark: str = ""

    def __post_init__(self) -> None:
        check_choice(f"object {self.label}", "kind", self.kind, KINDS)
        if min(self.size_m) <= 0:
            raise SceneError(f"object {self.label}: size_m must be positive, found {self.size_m}")
        if not all(0 <= channel <= 1 for channel in self.colour):
            raise SceneError(f"object {self.label}: colour must be within 0..1, found {self.colour}")

    @property
    def solid(self) -> bool:
        """Whether the object is an obstacle for robots and people."""
        return KINDS[self.kind].solid

    @property
    def box(self) -> Box:
        """Bounding box of the visible object."""
        x, y, z = self.position_m
        return Box((x, y, z + self.size_m[2] / 2), (cos(self.heading_rad), sin(self.heading_rad)), self.size_m)

    @property
    def boxes(self) -> tuple[Box, ...]:
        """Collision boxes from the kind's parts; none for a flat kind."""
        (x, y, z), height = self.position_m, self.size_m[2]
        made = []
        for part in KINDS[self.kind].parts:
            depth, width = (min(self.size_m[:2]),) * 2 if part.turn_rad else self.size_m[:2]
            turn = self.heading_rad + part.turn_rad
            c, s = cos(turn), sin(turn)
            u, v = sum(part.x) / 2 * depth, sum(part.y) / 2 * width
            size = ((part.x[1] - part.x[0]) * depth, (part.y[1] - part.y[0]) * width, (part.z[1] - part.z[0]) * height)
            made.append(Box((x + c * u - s * v, y + s * u + c * v, z + sum(part.z) / 2 * height), (c, s), size))
        return tuple(made)


@dataclass(frozen=True)
class Floor:
    """Floor patch with its own texture: a convex `polygon`, m; the texture runs along `heading_rad`.

    It changes only the appearance, not the physics. Later patches cover earlier ones.
    """

    polygon: tuple[Vec2, ...]
    texture: str
    heading_rad: float = 0.0

    def __post_init__(self) -> None:
        check_choice("floors", "texture", self.texture, FLOOR_TEXTURES)
        if area_m2(self.polygon) <= 1e-6 or not is_convex(self.polygon):
            raise SceneError(f"floors: {self.texture}: expected a convex polygon, found {self.polygon}")


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

    def vertices_m(self) -> tuple[Vec3, ...]:
        """Vertices of the convex solid in the world, m, for a physics engine."""
        line = {(-self.size_m[0] / 2, 0.0), *self.profile(), (self.size_m[0] / 2, 0.0)}
        half = self.size_m[1] / 2
        return tuple(self.point(u, side * half, h) for u, h in sorted(line) for side in (-1, 1))

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


@dataclass(frozen=True)
class Area:
    """A named part of the floor: `polygon`, m; `name` for instructions ("aisle 3", "waiting room")."""

    label: str
    kind: str
    polygon: tuple[Vec2, ...]
    name: str

    def __post_init__(self) -> None:
        check_choice(f"area {self.label}", "kind", self.kind, AREA_KINDS)
        if len(self.polygon) < 3 or area_m2(self.polygon) <= 1e-6:
            raise SceneError(f"area {self.label}: expected a polygon of at least three corners, found {self.polygon}")

    def contains(self, x: float, y: float) -> bool:
        """Return whether a point (m) lies inside, by the even-odd rule."""
        inside = False
        for (ax, ay), (bx, by) in _edges(self.polygon):
            if (ay > y) != (by > y) and x < ax + (y - ay) / (by - ay) * (bx - ax):
                inside = not inside
        return inside


@dataclass(frozen=True)
class Place:
    """Destination of people: `position_m` (x, y), heading while there, and maximum number of people (`capacity`).

    Kinds: stand; sit (chair or bench); queue (place of the first person, the others stand behind it); door (people
    enter and leave).
    """

    label: str
    position_m: Vec2
    heading_rad: float
    kind: str
    capacity: int = 1

    def __post_init__(self) -> None:
        check_choice(f"place {self.label}", "kind", self.kind, PLACE_KINDS)
        if self.capacity < 1:
            raise SceneError(f"place {self.label}: capacity must be 1 or more, found {self.capacity}")


@dataclass(frozen=True)
class Route:
    """Points, m, between which a person walks back and forth."""

    points_m: tuple[Vec2, ...]

    def __post_init__(self) -> None:
        if len(self.points_m) < 2 or any(a == b for a, b in zip(self.points_m, self.points_m[1:], strict=False)):
            raise SceneError("route: expected at least two different points")


def check_choice(what: str, key: str, value: str, choices: Iterable[str]) -> None:
    """Check that a value is one of the choices. Raises SceneError."""
    if value not in choices:
        raise SceneError(f"{what}: unknown {key} {value!r}, expected one of {', '.join(sorted(choices))}")


def area_m2(polygon: tuple[Vec2, ...]) -> float:
    """Return the area of a polygon in either orientation, m2."""
    return abs(sum(ax * by - bx * ay for (ax, ay), (bx, by) in _edges(polygon))) / 2


def is_convex(polygon: tuple[Vec2, ...]) -> bool:
    """Return whether a polygon has at least three corners and is convex."""
    turned, signs = 0.0, set()
    edges = _edges(polygon)
    for (a, b), (_, c) in zip(edges, edges[1:] + edges[:1], strict=True):
        ux, uy, vx, vy = b[0] - a[0], b[1] - a[1], c[0] - b[0], c[1] - b[1]
        cross = ux * vy - uy * vx
        turned += atan2(cross, ux * vx + uy * vy)
        if abs(cross) > 1e-12:
            signs.add(cross > 0)
    return len(polygon) >= 3 and len(signs) == 1 and abs(turned) < 7.0


def _edges(polygon: tuple[Vec2, ...]) -> list[tuple[Vec2, Vec2]]:
    return list(zip(polygon, polygon[1:] + polygon[:1], strict=True))
