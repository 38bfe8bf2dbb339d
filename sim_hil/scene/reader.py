"""Readers from the tables of a scene file to the scene's parts; all raise SceneError."""

from __future__ import annotations

from sim_hil.scene.kinds import KINDS
from sim_hil.scene.parts import Area, Floor, Place, Route, SceneObject, Vec2, Wall, check_choice
from sim_hil.scene.table import SceneError, Table
from sim_hil.scene.terrain import Terrain


def read_wall(table: Table) -> Wall:
    """Read a wall."""
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


def read_object(table: Table) -> SceneObject:
    """Read an object; size and colour default to those of its kind."""
    label, name = table.text("label"), table.text("kind")
    check_choice(f"{table.what}: {label}", "kind", name, KINDS)
    thing = SceneObject(
        label=label,
        kind=name,
        position_m=table.vector("position_m", 3),
        heading_rad=table.heading(),
        size_m=table.vector("size_m", 3, KINDS[name].size_m),
        colour=table.vector("colour", 3, KINDS[name].colour),
        text=table.text("text", ""),
        landmark=table.text("landmark", ""),
    )
    table.done()
    return thing


def read_floor(table: Table) -> Floor:
    """Read a floor patch, given by `polygon` or by the corners `min_m` and `max_m`."""
    polygon: tuple[Vec2, ...]
    if "polygon" in table:
        polygon = table.points("polygon")
    elif "min_m" in table:
        (x0, y0), (x1, y1) = table.vector("min_m", 2), table.vector("max_m", 2)
        polygon = ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
    else:
        raise SceneError(f"{table.what}: expected polygon, or min_m and max_m, found neither")
    floor = Floor(polygon, table.text("texture"), table.heading(0.0))
    table.done()
    return floor


def read_terrain(table: Table) -> Terrain:
    """Read a piece of terrain."""
    terrain = Terrain(
        label=table.text("label"),
        kind=table.text("kind"),
        position_m=table.vector("position_m", 3),
        heading_rad=table.heading(),
        size_m=table.vector("size_m", 2),
        rise_m=table.number("rise_m"),
        texture=table.text("texture"),
    )
    table.done()
    return terrain


def read_area(table: Table) -> Area:
    """Read a named area."""
    area = Area(table.text("label"), table.text("kind"), table.points("polygon"), table.text("name"))
    table.done()
    return area


def read_place(table: Table) -> Place:
    """Read a destination of people."""
    place = Place(
        label=table.text("label"),
        position_m=table.vector("position_m", 2),
        heading_rad=table.heading(),
        kind=table.text("kind"),
        capacity=table.whole("capacity", 1),
    )
    table.done()
    return place


def read_route(table: Table) -> Route:
    """Read a route."""
    route = Route(table.points("points_m"))
    table.done()
    return route
