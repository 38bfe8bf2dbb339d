"""A scene written as a TOML file, number by number as it is: reading it back gives the same scene."""

from __future__ import annotations

import json
from collections.abc import Iterable
from math import degrees, radians

from sim_hil.scene.scene import Scene


def scene_to_toml(scene: Scene) -> str:
    """The text of a scene file; parse_scene of it gives an equal scene."""
    lines = [
        f"name = {_text(scene.name)}",
        f"start = {_numbers(scene.start)}",
        f"goal_xy = {_numbers(scene.goal_xy)}",
        f"ceiling_height_m = {scene.ceiling_height_m!r}",
        f"ceiling_texture = {_text(scene.ceiling_texture)}",
        f"sky = {_numbers(scene.sky)}",
        "",
        "[floor]",
        f"min_m = {_numbers(scene.floor_min_m)}",
        f"max_m = {_numbers(scene.floor_max_m)}",
        f"texture = {_text(scene.floor_texture)}",
    ]
    for patch in scene.floors:
        lines += _table(
            "floors",
            f"polygon = {_points(patch.polygon)}",
            f"texture = {_text(patch.texture)}",
            _heading(patch.heading_rad),
        )
    for terrain in scene.terrain:
        lines += _table(
            "terrain",
            f"label = {_text(terrain.label)}",
            f"kind = {_text(terrain.kind)}",
            f"position_m = {_numbers(terrain.position_m)}",
            _heading(terrain.heading_rad),
            f"size_m = {_numbers(terrain.size_m)}",
            f"rise_m = {terrain.rise_m!r}",
            f"texture = {_text(terrain.texture)}",
        )
    for wall in scene.walls:
        lines += _table(
            "walls",
            f"label = {_text(wall.label)}",
            f"start_m = {_numbers(wall.start_m)}",
            f"end_m = {_numbers(wall.end_m)}",
            f"thickness_m = {wall.thickness_m!r}",
            f"height_m = {wall.height_m!r}",
            f"texture = {_text(wall.texture)}",
        )
    for thing in scene.objects:
        lines += _table(
            "objects",
            f"label = {_text(thing.label)}",
            f"kind = {_text(thing.kind)}",
            f"position_m = {_numbers(thing.position_m)}",
            _heading(thing.heading_rad),
            f"size_m = {_numbers(thing.size_m)}",
            f"colour = {_numbers(thing.colour)}",
            *([f"text = {_text(thing.text)}"] if thing.text else []),
            *([f"landmark = {_text(thing.landmark)}"] if thing.landmark else []),
        )
    for area in scene.areas:
        lines += _table(
            "areas",
            f"label = {_text(area.label)}",
            f"kind = {_text(area.kind)}",
            f"name = {_text(area.name)}",
            f"polygon = {_points(area.polygon)}",
        )
    for place in scene.places:
        lines += _table(
            "places",
            f"label = {_text(place.label)}",
            f"kind = {_text(place.kind)}",
            f"position_m = {_numbers(place.position_m)}",
            _heading(place.heading_rad),
            f"capacity = {place.capacity}",
        )
    for route in scene.routes:
        lines += _table("routes", f"points_m = {_points(route.points_m)}")
    return "\n".join(lines) + "\n"


def _table(name: str, *lines: str) -> list[str]:
    return ["", f"[[{name}]]", *lines]


def _text(value: str) -> str:
    # TOML's basic strings escape as JSON's do, but for DEL, which JSON leaves as it is.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _numbers(values: Iterable[float]) -> str:
    return "[" + ", ".join(repr(float(value)) for value in values) + "]"


def _points(points: Iterable[Iterable[float]]) -> str:
    return "[" + ", ".join(_numbers(point) for point in points) + "]"


def _heading(heading_rad: float) -> str:
    """In degrees where they say the same to the last bit, in radians otherwise."""
    exact = degrees(heading_rad)
    for value in (round(exact, 3), exact):
        if radians(value) == heading_rad:
            return f"heading_deg = {value!r}"
    return f"heading_rad = {heading_rad!r}"
