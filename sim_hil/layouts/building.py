"""Buildings: corridors, cross corridors, dead ends and rows of rooms, and the furnishing that all buildings share."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import pi

from sim_hil.layouts.builder import Builder, Room
from sim_hil.layouts.plan import WALL_THICKNESS_M, Border, LayoutError, Rect, Vec2
from sim_hil.scene.scene import KINDS, Scene

_LINTEL_M = 2.15  # underside
_SHORT = {"desk": "desk"}  # shorter name for instructions


@dataclass(frozen=True)
class Bones:
    """Ranges (low, high), m, of a building's random dimensions."""

    length_m: Vec2
    corridor_m: Vec2  # width
    outer_row_m: Vec2  # depth of the rows of rooms along the outside
    inner_row_m: Vec2  # depth of each of the two rows back to back between the corridors
    room_m: Vec2  # width of a room along its corridor
    cross: tuple[int, int]  # number of cross corridors, from and to
    stubs: tuple[int, int]  # number of dead-end corridors to the outside
    door_m: float
    corridor_floor: str


@dataclass
class Building:
    """Rooms of a skeleton by type; `slots` are rooms without a purpose yet, with their corridor."""

    builder: Builder
    long: list[Room] = field(default_factory=list)
    cross: list[Room] = field(default_factory=list)
    stubs: list[Room] = field(default_factory=list)
    slots: list[tuple[Rect, Room]] = field(default_factory=list)


def raise_bones(builder: Builder, bones: Bones) -> Building:
    """Place corridors and rooms. Raises LayoutError if the random dimensions are not feasible."""
    rng = builder.rng
    building = Building(builder)
    length = _drawn(builder, bones.length_m)
    widths = [_drawn(builder, bones.corridor_m) for _ in range(2)]
    rows = [_drawn(builder, bones.outer_row_m), _drawn(builder, bones.outer_row_m)]
    inner = [_drawn(builder, bones.inner_row_m), _drawn(builder, bones.inner_row_m)]
    y = [0.0, rows[0]]
    y += [y[1] + widths[0]]
    y += [y[2] + inner[0]]
    y += [y[3] + inner[1]]
    y += [y[4] + widths[1]]
    y += [y[5] + rows[1]]
    y = [round(v, 2) for v in y]
    south = builder.room(Rect(0, y[1], length, y[2]), "corridor", "corridor", bones.corridor_floor)
    north = builder.room(Rect(0, y[4], length, y[5]), "corridor", "corridor", bones.corridor_floor)
    building.long += [south, north]

    cross_spans = _spans(builder, length, int(rng.integers(bones.cross[0], bones.cross[1] + 1)), bones)
    for low, high in cross_spans:
        room = builder.room(Rect(low, y[2], high, y[4]), "corridor", "corridor", bones.corridor_floor)
        builder.open(room, south)
        builder.open(room, north)
        building.cross.append(room)
    stubs = int(rng.integers(bones.stubs[0], bones.stubs[1] + 1))
    sides = [(0, y[0], y[1], south), (1, y[5], y[6], north)]
    taken: dict[int, list[Vec2]] = {0: [], 1: []}
    for _ in range(stubs):
        side, low_y, high_y, corridor = sides[int(rng.integers(2))]
        span = _stub_span(builder, length, cross_spans, taken[side], bones)
        if span is None:
            continue
        taken[side].append(span)
        stub = builder.room(Rect(span[0], low_y, span[1], high_y), "corridor", "corridor", bones.corridor_floor)
        builder.open(stub, corridor)
        building.stubs.append(stub)

    for side, low_y, high_y, corridor in sides:
        for a, b in _gaps(taken[side], length):
            for low, high in _split(builder, a, b, bones.room_m):
                building.slots.append((Rect(low, low_y, high, high_y), corridor))
    for a, b in _gaps(cross_spans, length):
        for low_y, high_y, corridor in ((y[2], y[3], south), (y[3], y[4], north)):
            for low, high in _split(builder, a, b, bones.room_m):
                building.slots.append((Rect(low, low_y, high, high_y), corridor))
    return building


def _drawn(builder: Builder, limits: Vec2) -> float:
    return round(float(builder.rng.uniform(*limits)), 2)


def _spans(builder: Builder, length: float, count: int, bones: Bones) -> list[Vec2]:
    """Return the positions of cross corridors: two rooms apart, at an end of the building or a room away from it."""
    for _ in range(200):
        spans = []
        for _ in range(count):
            width = _drawn(builder, bones.corridor_m)
            low = round(float(builder.rng.uniform(0, length - width)), 2)
            if low < bones.room_m[0] * 0.6:
                low = 0.0
            elif length - width - low < bones.room_m[0] * 0.6:
                low = length - width
            spans.append((low, round(low + width, 2)))
        spans.sort()
        edges = [0.0, *(v for span in spans for v in span), length]
        gaps = [b - a for a, b in zip(edges[::2], edges[1::2], strict=True)]
        ends = all(gap < 1e-6 or gap >= bones.room_m[0] for gap in (gaps[0], gaps[-1]))
        if ends and all(gap >= 1.9 * bones.room_m[0] for gap in gaps[1:-1]):
            return spans
    raise LayoutError("cross corridors do not fit")


def _stub_span(
    builder: Builder, length: float, cross: list[Vec2], taken: list[Vec2], bones: Bones
) -> Vec2 | None:  # fmt: skip
    """Return the position of a dead end: opposite a cross corridor, or far from all of them."""
    for _ in range(40):
        if cross and builder.rng.uniform() < 0.5:
            span = cross[int(builder.rng.integers(len(cross)))]
        else:
            width = _drawn(builder, bones.corridor_m)
            low = round(float(builder.rng.uniform(bones.room_m[0], length - bones.room_m[0] - width)), 2)
            span = (low, round(low + width, 2))
            if any(abs(sum(span) - sum(other)) / 2 < 5.0 for other in cross):
                continue
        inside = min(span[0], length - span[1])
        if inside > 1e-6 and inside < bones.room_m[0]:
            continue
        if all(span[1] + bones.room_m[0] <= o[0] or o[1] + bones.room_m[0] <= span[0] for o in taken):
            return span
    return None


def _gaps(spans: list[Vec2], length: float) -> list[Vec2]:
    edges = [0.0, *(v for span in sorted(spans) for v in span), length]
    return [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > 1e-6]


def _split(builder: Builder, low: float, high: float, room_m: Vec2) -> list[Vec2]:
    """Divide a segment into rooms of random width."""
    stretch = high - low
    count = max(1, round(stretch / float(builder.rng.uniform(*room_m))))
    while count > 1 and stretch / count < room_m[0]:
        count -= 1
    weights = builder.rng.uniform(0.85, 1.15, count)
    cuts = [low]
    for share in weights[:-1].cumsum() / weights.sum():
        cuts.append(round(low + stretch * float(share), 2))
    cuts.append(high)
    return list(itertools.pairwise(cuts))


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


def corridor_ends(building: Building, exit_kind: str = "double_door") -> None:
    """Add an exit door or a window at the end of a corridor; people enter and leave by the doors."""
    builder = building.builder
    ends: list[tuple[Room, str]] = []
    for room in building.long:
        ends += [(room, "w"), (room, "e")]
    for room in building.stubs:
        ends.append((room, "s" if room.rect.y0 == 0.0 else "n"))
    order = builder.shuffled(ends)
    doors = ["green", "blue", "red", "yellow", "orange"]
    for index, (room, side) in enumerate(order):
        if index < max(3, len(building.stubs) + 2) and index < len(doors):
            colour = doors[index]
            extent = room.rect.depth if side in "we" else room.rect.width
            thing = builder.against(
                room, exit_kind, side=side, along=0.5, colour=colour, landmark=f"{colour} exit door", text="EXIT",
                size=(0.05, min(1.8, extent - 0.7), 2.2),
            )  # fmt: skip
            if thing is not None:
                builder.place_before(thing, "door", capacity=2, gap_m=0.5)
                builder.put("exit_sign", *thing.position_m[:2], thing.heading_rad, z=2.25)
        else:
            builder.against(room, "window", side=side, along=0.5, landmark="window")


def along_corridors(
    building: Building, kinds: Sequence[str], hung: Sequence[str], spacing_m: float, *, coloured: Sequence[str],
) -> None:  # fmt: skip
    """Add single objects of `kinds` along the corridors, so that a robot and a person can still pass each other.

    One object of `hung` every `spacing_m` of a corridor; objects of the kinds `coloured` get a random colour.
    """
    builder = building.builder
    for corridor in [*building.long, *building.cross]:
        walls = ("n", "s") if corridor in building.long else ("w", "e")
        length = max(corridor.rect.width, corridor.rect.depth)
        for kind in builder.shuffled(kinds)[: 5 if length > 20 else 2]:
            colour = builder.pick(("blue", "red", "green", "orange")) if kind in coloured else ""
            builder.against(
                corridor, kind, side=builder.pick(walls), colour=colour, landmark=named(kind, colour), lone=True,
                size=(0.9, 0.65, 0.92) if kind == "wheelchair" else None, seats=2 if kind == "bench" else 0,
                queue=2 if kind == "water_dispenser" else 0,
            )  # fmt: skip
        for _ in range(round(length / spacing_m)):
            kind = builder.pick(hung)
            colour = builder.pick(("red", "blue", "green", "yellow")) if kind in coloured else ""
            board = kind == "notice_board"
            builder.against(corridor, kind, side=builder.pick(walls), colour=colour, text="NOTICES" if board else "",
                            landmark=named(kind) if board else "")  # fmt: skip


def finished(building: Building, name: str, rooms: Sequence[Room]) -> Scene:
    """Add outer windows, lamps and places to stand, and return the scene; the robot drives along the south corridor."""
    builder, south = building.builder, building.long[0].rect
    top = max(slot.y1 for slot, _ in building.slots)
    for room in rooms:
        rect = room.rect
        for side, outer in (
            ("s", rect.y0 <= 0),
            ("n", rect.y1 >= top),
            ("w", rect.x0 <= 0),
            ("e", rect.x1 >= south.x1),
        ):
            if outer:
                builder.against(room, "window", side=side, along=0.5, landmark="")
    lights(builder)
    for room in rooms:
        builder.stand_in(room.rect, 1)
    for corridor in building.long + building.cross + building.stubs:
        builder.stand_in(corridor.rect, max(1, round(max(corridor.rect.width, corridor.rect.depth) / 5)))
    start = (south.x0 + 2.0, south.centre[1], 0.0)
    return builder.scene(name, start, (south.x1 - 2.5, south.centre[1]), floor=building.long[0].floor)
