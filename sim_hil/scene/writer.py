"""A scene written as a TOML file: `parse_scene` of it gives an equal scene."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from math import degrees, radians
from typing import Any

import tomli_w

from sim_hil.scene.scene import Scene


def scene_to_toml(scene: Scene) -> str:
    """Return the text of a scene file, all numbers exact."""
    floor = {"min_m": scene.floor_min_m, "max_m": scene.floor_max_m, "texture": scene.floor_texture}
    parts = {
        "floors": scene.floors,
        "terrain": scene.terrain,
        "walls": scene.walls,
        "objects": scene.objects,
        "areas": scene.areas,
        "places": scene.places,
        "routes": scene.routes,
    }
    content = {
        "name": scene.name,
        "start": scene.start,
        "goal_xy": scene.goal_xy,
        "ceiling_height_m": scene.ceiling_height_m,
        "ceiling_texture": scene.ceiling_texture,
        "sky": scene.sky,
        "floor": floor,
        **{name: _tables(items) for name, items in parts.items() if items},
    }
    return tomli_w.dumps(content)


def _tables(parts: Iterable[Any]) -> list[dict[str, Any]]:
    return [_table(asdict(part)) for part in parts]


def _table(part: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys of one part, with the heading in degrees if that is exact."""
    table = dict(part)
    heading_rad = table.pop("heading_rad", None)
    if heading_rad is None:
        return table
    exact = degrees(heading_rad)
    for heading_deg in (round(exact, 3), exact):
        if radians(heading_deg) == heading_rad:
            return {**table, "heading_deg": heading_deg}
    return {**table, "heading_rad": heading_rad}
