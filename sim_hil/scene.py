"""A scene as data: floor, walls, objects and people's routes, read from sim_hil/scenes/<name>.toml and checked."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from math import cos, hypot, radians, sin
from pathlib import Path
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]
SCENES = Path(__file__).with_name("scenes")

# What an object can be; the second set hangs on a wall or ceiling, out of the way of feet, and stops nobody.
SOLID_KINDS = frozenset(
    ("vending_machine", "bench", "plant", "water_dispenser", "trash_bin", "fire_extinguisher", "cabinet")
)
FLAT_KINDS = frozenset(("door", "notice_board", "sign", "window", "light"))
TEXTURES = frozenset(("floor_tiles", "wall_wainscot", "ceiling_panels"))


class SceneError(ValueError):
    """A scene file that cannot be used; one line: what, expected, found."""


@dataclass(frozen=True)
class Footprint:
    """Outline of a wall or object on the floor: polygon [(x, y), ...] in world m, for top-down pictures."""

    label: str
    kind: str
    polygon: tuple[Vec2, ...]


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
        _check_texture(f"wall {self.label}", self.texture)

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
class SceneObject:
    """A thing: `position_m` is the middle of its underside, its front looks along `heading_rad`.

    `size_m` is depth (front to back), width and height.
    """

    label: str
    kind: str
    position_m: Vec3
    heading_rad: float
    size_m: Vec3
    colour: Vec3
    text: str

    def __post_init__(self) -> None:
        if self.kind not in SOLID_KINDS | FLAT_KINDS:
            raise SceneError(f"object {self.label}: unknown kind {self.kind!r}, expected one of "
                             f"{', '.join(sorted(SOLID_KINDS | FLAT_KINDS))}")  # fmt: skip
        if min(self.size_m) <= 0:
            raise SceneError(f"object {self.label}: size_m must be positive, found {self.size_m}")
        if not all(0 <= channel <= 1 for channel in self.colour):
            raise SceneError(f"object {self.label}: colour must be within 0..1, found {self.colour}")

    @property
    def solid(self) -> bool:
        """Whether it stops a robot or a person."""
        return self.kind in SOLID_KINDS

    @property
    def box(self) -> Box:
        """Bounding box."""
        x, y, z = self.position_m
        return Box((x, y, z + self.size_m[2] / 2), (cos(self.heading_rad), sin(self.heading_rad)), self.size_m)


@dataclass(frozen=True)
class Route:
    """Way points, m, that a person walks to and fro."""

    points_m: tuple[Vec2, ...]

    def __post_init__(self) -> None:
        if len(self.points_m) < 2 or any(a == b for a, b in zip(self.points_m, self.points_m[1:], strict=False)):
            raise SceneError("route: expected at least two different points")


@dataclass(frozen=True)
class Scene:
    """A world: the robot starts at `start` (x m, y m, theta rad) and is done at `goal_xy`, m."""

    name: str
    start: Vec3
    goal_xy: Vec2
    floor_min_m: Vec2
    floor_max_m: Vec2
    floor_texture: str
    ceiling_height_m: float  # 0 = open sky
    walls: tuple[Wall, ...]
    objects: tuple[SceneObject, ...]
    routes: tuple[Route, ...]

    def __post_init__(self) -> None:
        (x0, y0), (x1, y1) = self.floor_min_m, self.floor_max_m
        if x0 >= x1 or y0 >= y1:
            raise SceneError("floor: min_m must lie below max_m")
        for what, (x, y) in (("start", self.start[:2]), ("goal_xy", self.goal_xy)):
            if not (x0 <= x <= x1 and y0 <= y <= y1):
                raise SceneError(f"{what}: ({x}, {y}) is not on the floor")
        labels = [wall.label for wall in self.walls] + [thing.label for thing in self.objects]
        if len(labels) != len(set(labels)):
            raise SceneError("labels of walls and objects must be unique")
        _check_texture("floor", self.floor_texture)

    def footprints(self) -> list[Footprint]:
        """Outlines of all walls and objects, for a top-down picture."""
        outlines = [Footprint(wall.label, "wall", wall.box.corners()) for wall in self.walls]
        return outlines + [Footprint(thing.label, thing.kind, thing.box.corners()) for thing in self.objects]

    def obstacles(self) -> list[tuple[str, Box]]:
        """Label and box of everything that stops a robot or a person."""
        walls = [(wall.label, wall.box) for wall in self.walls]
        return walls + [(thing.label, thing.box) for thing in self.objects if thing.solid]

    def without(self, label: str) -> Scene:
        """The same scene lacking one object; raises KeyError when there is none of that label."""
        rest = tuple(thing for thing in self.objects if thing.label != label)
        if len(rest) == len(self.objects):
            raise KeyError(label)
        return Scene(**{**self.__dict__, "objects": rest})


def _check_texture(what: str, texture: str) -> None:
    if texture not in TEXTURES:
        raise SceneError(f"{what}: unknown texture {texture!r}, expected one of {', '.join(sorted(TEXTURES))}")


class _Table:
    """A TOML table that insists on every key being known and of the right shape."""

    def __init__(self, what: str, table: object) -> None:
        if not isinstance(table, Mapping):
            raise SceneError(f"{what}: expected a table, found {type(table).__name__}")
        self._what, self._rest = what, dict(table)

    def take(self, key: str, default: Any = None) -> Any:
        if key not in self._rest and default is None:
            raise SceneError(f"{self._what}: key {key!r} is missing")
        return self._rest.pop(key, default)

    def text(self, key: str, default: str | None = None) -> str:
        value = self.take(key, default)
        if not isinstance(value, str):
            raise SceneError(f"{self._what}: {key} must be text, found {value!r}")
        return value

    def number(self, key: str, default: float | None = None) -> float:
        return _number(f"{self._what}: {key}", self.take(key, default))

    def vector(self, key: str, length: int, default: tuple[float, ...] | None = None) -> tuple[Any, ...]:
        return _vector(f"{self._what}: {key}", self.take(key, default), length)

    def tables(self, key: str) -> list[Any]:
        value = self.take(key, [])
        if not isinstance(value, list):
            raise SceneError(f"{self._what}: {key} must be an array of tables")
        return value

    def done(self) -> None:
        if self._rest:
            raise SceneError(f"{self._what}: unknown key {sorted(self._rest)[0]!r}")


def _number(what: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or value != value or abs(value) > 1e6:
        raise SceneError(f"{what} must be a finite number, found {value!r}")
    return float(value)


def _vector(what: str, value: object, length: int) -> tuple[float, ...]:
    if not isinstance(value, list | tuple) or len(value) != length:
        raise SceneError(f"{what} must be {length} numbers, found {value!r}")
    return tuple(_number(what, item) for item in value)


def _wall(index: int, raw: object) -> Wall:
    table = _Table(f"walls[{index}]", raw)
    wall = Wall(
        label=table.text("label"),
        start_m=table.vector("start_m", 2),
        end_m=table.vector("end_m", 2),
        thickness_m=table.number("thickness_m", 0.15),
        height_m=table.number("height_m", 2.6),
        texture=table.text("texture", "wall_wainscot"),
    )
    table.done()
    return wall


def _object(index: int, raw: object) -> SceneObject:
    table = _Table(f"objects[{index}]", raw)
    thing = SceneObject(
        label=table.text("label"),
        kind=table.text("kind"),
        position_m=table.vector("position_m", 3),
        heading_rad=radians(table.number("heading_deg")),
        size_m=table.vector("size_m", 3),
        colour=table.vector("colour", 3),
        text=table.text("text", ""),
    )
    table.done()
    return thing


def _route(index: int, raw: object) -> Route:
    table = _Table(f"routes[{index}]", raw)
    points = table.take("points_m")
    if not isinstance(points, list):
        raise SceneError(f"routes[{index}]: points_m must be an array of points")
    route = Route(tuple(_vector(f"routes[{index}]: point", point, 2) for point in points))  # type: ignore[misc]
    table.done()
    return route


def parse_scene(text: str, source: str) -> Scene:
    """Build a scene from TOML text; `source` names it in errors. Raises SceneError."""
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SceneError(f"{source}: not valid TOML: {error}") from error
    try:
        table = _Table("scene", raw)
        floor = _Table("floor", table.take("floor"))
        start = table.vector("start", 3)
        scene = Scene(
            name=table.text("name"),
            start=start,  # type: ignore[arg-type]
            goal_xy=table.vector("goal_xy", 2),
            floor_min_m=floor.vector("min_m", 2),
            floor_max_m=floor.vector("max_m", 2),
            floor_texture=floor.text("texture", "floor_tiles"),
            ceiling_height_m=table.number("ceiling_height_m", 0.0),
            walls=tuple(_wall(i, item) for i, item in enumerate(table.tables("walls"))),
            objects=tuple(_object(i, item) for i, item in enumerate(table.tables("objects"))),
            routes=tuple(_route(i, item) for i, item in enumerate(table.tables("routes"))),
        )
        floor.done()
        table.done()
    except SceneError as error:
        raise SceneError(f"{source}: {error}") from error
    return scene


def scene_names() -> list[str]:
    """Names that load_scene knows."""
    return sorted(path.stem for path in SCENES.glob("*.toml"))


def load_scene(name: str) -> Scene:
    """Load the scene of that name; raises SceneError, naming the known ones, when there is none."""
    if name not in scene_names():
        raise SceneError(f"unknown scene {name!r}, expected one of {', '.join(scene_names())}")
    path = SCENES / f"{name}.toml"
    return parse_scene(path.read_text(encoding="utf-8"), path.name)
