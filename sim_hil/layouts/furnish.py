"""Furnishing common to all buildings: lights, lintels, windows, ends of corridors, objects along corridors."""

from __future__ import annotations

from math import pi

from sim_hil.layouts.builder import Builder, Room
from sim_hil.layouts.plan import WALL_THICKNESS_M, Border, Rect
from sim_hil.layouts.skeleton import Building
from sim_hil.scene.scene import KINDS, SceneObject

_LINTEL_M = 2.15  # underside
_SHORT = {"desk": "desk"}  # shorter name for instructions


def named(kind: str, colour: str = "") -> str:
    """Return an object's name for instructions, with its colour if that distinguishes it."""
    return f"{colour} {_SHORT.get(kind, KINDS[kind].noun)}".strip()


def lights(builder: Builder, spacing_m: float = 5.0) -> None:
    """Add ceiling lamps: in a row along corridors and aisles, one in the middle of a room."""
    for room in builder.rooms:
        rect = room.rect
        along_x = rect.width >= rect.depth
        length = rect.width if along_x else rect.depth
        count = max(1, round(length / spacing_m)) if room.kind in ("corridor", "aisle", "yard", "lobby") else 1
        for i in range(count):
            share = (i + 0.5) / count
            x = rect.x0 + share * rect.width if along_x else rect.centre[0]
            y = rect.centre[1] if along_x else rect.y0 + share * rect.depth
            builder.put("light", x, y, pi / 2 if along_x else 0.0, z=builder.ceiling_m - 0.04)


def lintel(builder: Builder, border: Border, outside: Rect, colour: str, text: str) -> None:
    """Add a coloured plate over a doorway, from the lintel to the ceiling, with its text towards `outside`."""
    x, y = border.middle
    across = pi / 2 if outside.centre[1] > y else -pi / 2
    heading = across if border.along_x else (0.0 if outside.centre[0] > x else pi)
    size = (WALL_THICKNESS_M + 0.03, border.length, builder.ceiling_m - _LINTEL_M)
    builder.put("sign", x, y, heading, z=_LINTEL_M, size=size, colour=colour, text=text)


def door(builder: Builder, room: Room, corridor: Room, width_m: float, colour: str, text: str) -> Border:
    """Add a doorway between a room and its corridor, with a lintel and a place where people wait."""
    border = builder.open(room, corridor, width_m)
    lintel(builder, border, corridor.rect, colour, text)
    return border


def wide_opening(builder: Builder, room: Room, corridor: Room, width_m: float, colour: str, text: str) -> Border:
    """Open a room completely to its corridor, with its name above."""
    border = builder.open(room, corridor, min(width_m, room.rect.width - 0.8), margin_m=0.3)
    lintel(builder, border, corridor.rect, colour, text)
    return border


def corridor_ends(building: Building, exit_kind: str = "double_door") -> list[SceneObject]:
    """Add an exit door or a window at the end of a corridor; people enter and leave by the doors."""
    builder, made = building.builder, []
    ends: list[tuple[Room, str]] = []
    for room in building.long:
        ends += [(room, "w"), (room, "e")]
    for room in building.stubs:
        ends.append((room, "s" if room.rect.y0 == 0.0 else "n"))
    order = [ends[int(i)] for i in builder.rng.permutation(len(ends))]
    doors = ["green", "blue", "red", "yellow", "orange"]
    for index, (room, side) in enumerate(order):
        if index < max(3, len(building.stubs) + 2) and index < len(doors):
            colour = doors[index]
            thing = builder.against(
                room, exit_kind, side=side, along=0.5, colour=colour, landmark=f"{colour} exit door", text="EXIT",
                size=(0.05, min(1.8, _extent(room, side) - 0.7), 2.2),
            )  # fmt: skip
            if thing is not None:
                made.append(thing)
                builder.place_before(thing, "door", capacity=2, gap_m=0.5)
                x, y = thing.position_m[0], thing.position_m[1]
                builder.put("exit_sign", x, y, thing.heading_rad, z=2.25)
        else:
            builder.against(room, "window", side=side, along=0.5, landmark="window")
    return made


def _extent(room: Room, side: str) -> float:
    return room.rect.depth if side in "we" else room.rect.width


def outer_windows(builder: Builder, bounds: Rect, rooms: list[Room]) -> None:
    """Add windows in the outer walls of rooms."""
    for room in rooms:
        rect = room.rect
        for side, outer in (
            ("s", rect.y0 <= bounds.y0), ("n", rect.y1 >= bounds.y1),
            ("w", rect.x0 <= bounds.x0), ("e", rect.x1 >= bounds.x1),
        ):  # fmt: skip
            if outer:
                builder.against(room, "window", side=side, along=0.5, landmark="")


def sit_on(builder: Builder, thing: SceneObject, seats: int) -> None:
    """Add a place to sit on a bench, chair or sofa."""
    builder.place("sit", thing.position_m[0], thing.position_m[1], thing.heading_rad, seats)
