"""A scene as data: floor, walls, objects, terrain, routes and places of people; reads, checks and writes TOML files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, asdict, dataclass, fields
from math import degrees, radians
from pathlib import Path
from typing import Any

import tomli_w

from firmware_bridge.system.input_file import parse_toml, read_text
from sim_hil.scene.kinds import KINDS
from sim_hil.scene.parts import (
    CEILING_TEXTURES,
    FLOOR_TEXTURES,
    TEXTURES,
    WALL_TEXTURES,
    Area,
    Box,
    Floor,
    Place,
    Route,
    SceneObject,
    Terrain,
    Vec2,
    Vec3,
    Wall,
    check_choice,
)
from sim_hil.scene.table import SceneError, Table

__all__ = [
    "CEILING_TEXTURES", "FLOOR_TEXTURES", "KINDS", "SCENES", "SKY", "TEXTURES",
    "WALL_TEXTURES", "Area", "Box", "Floor", "Place", "Route", "Scene", "SceneError",
    "SceneObject", "Terrain", "Vec2", "Vec3", "Wall", "load_scene", "parse_scene", "scene_names", "scene_to_toml",
]  # fmt: skip

SCENES = Path(__file__).parents[1] / "scenes"
MAX_FLOOR_M2 = 250_000.0
"""Largest floor, m²: navigation grids of 25 million cells take 1 GB. The largest shipped one has 7200 m²."""
SKY: Vec3 = (0.60, 0.76, 0.92)
# Sections of a scene file in the order in which they are written; the keys are the fields of their class.
_SECTIONS: dict[str, type[Any]] = {
    "floors": Floor, "terrain": Terrain, "walls": Wall, "objects": SceneObject, "areas": Area, "places": Place,
    "routes": Route,
}  # fmt: skip
# Defaults of a file, in addition to those of the classes; an object's size and colour default to those of its kind.
_DEFAULTS: dict[str, dict[str, Any]] = {
    "walls": {"thickness_m": 0.15, "height_m": 2.6, "texture": "wall_wainscot"},
    "objects": {"text": ""},
}
_OMITTED_IF_EMPTY = ("text", "landmark")


@dataclass(frozen=True)
class Scene:
    """A static world; the robot starts at `start` (x m, y m, theta rad), its goal is `goal_xy`, m."""

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
    floors: tuple[Floor, ...] = ()
    terrain: tuple[Terrain, ...] = ()
    areas: tuple[Area, ...] = ()
    places: tuple[Place, ...] = ()
    ceiling_texture: str = "ceiling_panels"
    sky: Vec3 = SKY

    def __post_init__(self) -> None:
        (x0, y0), (x1, y1) = self.floor_min_m, self.floor_max_m
        if x0 >= x1 or y0 >= y1:
            raise SceneError("floor: min_m must lie below max_m")
        if (x1 - x0) * (y1 - y0) > MAX_FLOOR_M2:
            raise SceneError(f"floor: expected at most {MAX_FLOOR_M2:g} m², found {(x1 - x0) * (y1 - y0):g} m²")
        for what, (x, y) in (("start", self.start[:2]), ("goal_xy", self.goal_xy)):
            if not (x0 <= x <= x1 and y0 <= y <= y1):
                raise SceneError(f"{what}: ({x}, {y}) is not on the floor")
        if not all(0 <= channel <= 1 for channel in self.sky):
            raise SceneError(f"sky: colour must be within 0..1, found {self.sky}")
        solids = [part.label for parts in (self.walls, self.objects, self.terrain) for part in parts]
        for what, labels in (
            ("walls, objects and terrain", solids),
            ("areas", [area.label for area in self.areas]),
            ("places", [place.label for place in self.places]),
        ):
            if len(labels) != len(set(labels)):
                twice = next(label for label in labels if labels.count(label) > 1)
                raise SceneError(f"labels of {what} must be unique, found {twice!r} twice")
        check_choice("floor", "texture", self.floor_texture, FLOOR_TEXTURES)
        check_choice("scene", "ceiling_texture", self.ceiling_texture, CEILING_TEXTURES)

    def obstacles(self) -> list[tuple[str, Box]]:
        """Return label and box of every obstacle; an object with several boxes occurs several times.

        Terrain is not included, because robots and people walk on it.
        """
        walls = [(wall.label, wall.box) for wall in self.walls]
        return walls + [(thing.label, box) for thing in self.objects for box in thing.boxes]

    def ground_height_m(self, x: float, y: float) -> float:
        """Return the height of the ground at a point, m: the highest terrain, or 0."""
        heights = (terrain.height_m(x, y) for terrain in self.terrain)
        return max((height for height in heights if height is not None), default=0.0)

    def area_at(self, x: float, y: float) -> Area | None:
        """Return the first named area that contains a point, m; None outside all areas."""
        return next((area for area in self.areas if area.contains(x, y)), None)

    def landmarks(self) -> list[SceneObject]:
        """Return the objects that instructions may name."""
        return [thing for thing in self.objects if thing.landmark]


def parse_scene(text: str, source: str) -> Scene:
    """Build a scene from TOML text; `source` names it in errors. Raises SceneError."""
    try:
        raw = parse_toml(text)
    except ValueError as error:
        raise SceneError(f"{source}: not valid TOML: {error}") from error
    try:
        table = Table("scene", raw)
        floor = Table("floor", table.take("floor"))
        scene = Scene(
            name=table.text("name"),
            start=table.vector("start", 3),
            goal_xy=table.vector("goal_xy", 2),
            floor_min_m=floor.vector("min_m", 2),
            floor_max_m=floor.vector("max_m", 2),
            floor_texture=floor.text("texture", "floor_tiles"),
            ceiling_height_m=table.number("ceiling_height_m", 0.0),
            ceiling_texture=table.text("ceiling_texture", "ceiling_panels"),
            sky=table.vector("sky", 3, SKY),
            **{name: tuple(_read(name, item) for item in table.tables(name)) for name in _SECTIONS},
        )
        floor.done()
        table.done()
    except SceneError as error:
        raise SceneError(f"{source}: {error}") from error
    return scene


def scene_names() -> list[str]:
    """Return the names of the shipped scenes."""
    return sorted(path.stem for path in SCENES.glob("*.toml"))


def load_scene(name_or_path: str | Path) -> Scene:
    """Load a shipped scene by name, or any scene by the path of its TOML file. Raises SceneError."""
    path = SCENES / f"{name_or_path}.toml"
    if str(name_or_path) not in scene_names():
        path = Path(name_or_path)
        if path.suffix != ".toml":
            raise SceneError(
                f"unknown scene {str(name_or_path)!r}, expected one of {', '.join(scene_names())},"
                " or the path of a scene file that ends in .toml"
            )
    try:
        text = read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"{path}: cannot be read as a scene file: {error}") from error
    return parse_scene(text, path.name)


def _read(section: str, table: Table) -> Any:
    """Read one part of a scene from a table of its section. Raises SceneError."""
    values: dict[str, Any] = {}
    defaults = _DEFAULTS.get(section, {})
    scalars: dict[str, Callable[..., Any]] = {"str": table.text, "float": table.number, "int": table.whole}
    for key, kind, default in _fields(section):
        default = defaults.get(key, default)
        if section == "objects" and key in ("size_m", "colour"):
            check_choice(f"{table.what}: {values['label']}", "kind", values["kind"], KINDS)
            default = getattr(KINDS[values["kind"]], key)
        if key == "heading_rad":
            values[key] = table.heading(default)
        elif section == "floors" and key == "polygon":
            values[key] = _floor_polygon(table)
        elif kind == "tuple[Vec2, ...]":
            values[key] = table.points(key)
        elif kind in ("Vec2", "Vec3"):
            values[key] = table.vector(key, int(kind[-1]), default)
        else:
            values[key] = scalars[kind](key, default)
    part = _SECTIONS[section](**values)
    table.done()
    return part


def _fields(section: str) -> list[tuple[str, str, Any]]:
    """Return name, type and default (None: required) of a section's fields, in the order of the file."""
    found = [(f.name, str(f.type), None if f.default is MISSING else f.default) for f in fields(_SECTIONS[section])]
    return sorted(found, key=lambda entry: entry[0] not in ("label", "kind", "name"))


def _floor_polygon(table: Table) -> tuple[Vec2, ...]:
    """Read the outline of a floor patch: `polygon`, or the corners `min_m` and `max_m`."""
    if "polygon" in table:
        return table.points("polygon")
    if "min_m" not in table:
        raise SceneError(f"{table.what}: expected polygon, or min_m and max_m, found neither")
    (x0, y0), (x1, y1) = table.vector("min_m", 2), table.vector("max_m", 2)
    return ((x0, y0), (x1, y0), (x1, y1), (x0, y1))


def scene_to_toml(scene: Scene) -> str:
    """Return the text of a scene file; `parse_scene` of it gives an equal scene."""
    keys = ("name", "start", "goal_xy", "ceiling_height_m", "ceiling_texture", "sky")
    content: dict[str, Any] = {key: getattr(scene, key) for key in keys}
    content["floor"] = {key: getattr(scene, f"floor_{key}") for key in ("min_m", "max_m", "texture")}
    for section in _SECTIONS:
        if parts := getattr(scene, section):
            content[section] = [_table(asdict(part)) for part in parts]
    return tomli_w.dumps(content)


def _table(part: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys of one part, with the heading in degrees if that is exact to the last bit."""
    table = {key: value for key, value in part.items() if value or key not in _OMITTED_IF_EMPTY}
    if "heading_rad" not in table:
        return table
    heading_rad = table.pop("heading_rad")
    exact = degrees(heading_rad)
    for heading_deg in (round(exact, 3), exact):
        if radians(heading_deg) == heading_rad:
            return {**table, "heading_deg": heading_deg}
    return {**table, "heading_rad": heading_rad}
