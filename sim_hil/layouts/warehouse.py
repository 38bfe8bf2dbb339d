"""Warehouse: rows of racks with aisles between them, a main aisle, a loading yard with forklifts and cones.

Paper appendix C: "long aisles, racks, forklifts, cones, and fire extinguishers … high visual repetition".
"""

from __future__ import annotations

from math import pi

import numpy as np

from sim_hil.layouts.builder import Builder, Room
from sim_hil.layouts.building import lights, named
from sim_hil.layouts.plan import Rect
from sim_hil.scene.scene import Scene, Wall

_RACK_DEPTH_M = 1.1
_MARGIN_M = 0.1  # distance between the outermost racks and the walls' centre lines
_RACK_COLOURS = ("orange", "blue", "green", "red", "yellow", "purple")


def warehouse(rng: np.random.Generator) -> Scene:
    """Generate a warehouse. Raises LayoutError or SceneError if the random draw is not feasible."""
    builder = Builder("warehouse", rng, "wall_warehouse", 5.0)
    aisles = int(rng.integers(5, 7))
    width = round(float(rng.uniform(2.3, 2.7)), 2)
    block = 2 * _RACK_DEPTH_M + 0.1
    length = round(aisles * width + (aisles + 1) * block + 2 * _MARGIN_M, 2)
    yard_depth = round(float(rng.uniform(5.0, 6.5)), 2)
    main_depth = round(float(rng.uniform(3.0, 3.6)), 2)
    bays = int(rng.integers(4, 6))
    bay = round(float(rng.uniform(2.5, 2.9)), 2)
    through = bool(rng.integers(2))  # a second cross aisle at the far end, or aisles that end at the wall
    middle = bays >= 4 and bool(rng.integers(2))  # a cross aisle half way
    back_depth = round(float(rng.uniform(2.6, 3.0)), 2)

    y = 0.0
    yard = builder.room(Rect(0, 0, length, yard_depth), "yard", "loading area", "concrete_yellow_line")
    y += yard_depth
    main = builder.room(Rect(0, y, length, y + main_depth), "corridor", "main aisle", "concrete")
    builder.open(yard, main)
    y += main_depth
    cross = [main]
    blocks: list[tuple[float, float]] = []
    lower = bays // 2 if middle else bays
    blocks.append((y, y + lower * bay))
    y = blocks[-1][1]
    if middle:
        cross.append(builder.room(Rect(0, y, length, round(y + 2.6, 2)), "corridor", "cross aisle", "concrete"))
        y = cross[-1].rect.y1
        blocks.append((y, y + (bays - lower) * bay))
        y = blocks[-1][1]
    if through:
        cross.append(builder.room(Rect(0, y, length, round(y + back_depth, 2)), "corridor", "back aisle", "concrete"))
        y = cross[-1].rect.y1
    else:
        y += _MARGIN_M

    made = _racks(builder, blocks, aisles, width, block, bay)
    _loading(builder, yard)
    _things(builder, main, made)
    lights(builder, 8.0)
    for room in (yard, *cross):
        builder.stand_in(room.rect, 6)
    for aisle in made:
        builder.stand_in(aisle.rect, 3)
    start = (2.0, main.rect.centre[1], 0.0)
    return builder.scene("warehouse", start, (length - 3.0, main.rect.centre[1]), floor="concrete",
                         ceiling="ceiling_steel", walls=_hall(builder, Rect(0, 0, length, y)))  # fmt: skip


def _hall(builder: Builder, bounds: Rect) -> list[Wall]:
    hall = Builder("hall", builder.rng, builder.wall_texture, builder.ceiling_m)
    hall.room(bounds, "yard", "hall")
    return hall.walls()


def _racks(
    builder: Builder, blocks: list[tuple[float, float]], aisles: int, width: float, block: float, bay: float
) -> list[Room]:
    """Add rows of racks, back to back between aisles, with one colour per block, and the aisles."""
    colours = builder.shuffled(_RACK_COLOURS)
    made = []
    for y0, y1 in blocks:
        count = round((y1 - y0) / bay)
        for index in range(aisles + 1):
            x = _MARGIN_M + index * (block + width)
            colour = colours[index % len(colours)]
            for column in (0, 1):
                heading = pi if column == 0 else 0.0
                rx = x + _RACK_DEPTH_M * (0.5 + column) + 0.05
                for slot in range(count):
                    ry = y0 + (slot + 0.5) * bay
                    height = float(builder.rng.choice([3.0, 3.6, 3.6]))
                    builder.put("storage_rack", rx, ry, heading, size=(_RACK_DEPTH_M, bay - 0.06, height),
                                colour=colour, force=True)  # fmt: skip
            if index < aisles:
                room = builder.room(Rect(x + block, y0, x + block + width, y1), "aisle", "aisle", "concrete")
                made.append(room)
    return made


def _loading(builder: Builder, yard: Room) -> None:
    """Add dock doors in the outer wall, forklifts, pallets and drums, with space to walk between them."""
    rect = yard.rect
    doors = 3
    for index in range(doors):
        share = (index + 0.5) / doors
        gate = builder.against(yard, "loading_door", side="s", along=share)
        if gate is not None:
            builder.place_before(gate, "door", 3, gap_m=0.9)
            x, y, _ = gate.position_m
            builder.keep_clear(Rect(x - 1.2, y - 0.2, x + 1.2, y + 2.0))
    for colour in ("yellow", "red"):
        for _ in range(30):
            x = float(builder.rng.uniform(rect.x0 + 2.2, rect.x1 - 2.2))
            y = float(builder.rng.uniform(rect.y0 + 1.2, rect.y1 - 1.4))
            heading = float(builder.rng.choice([0.0, pi]))
            if builder.put("forklift", x, y, heading, colour=colour, landmark=named("forklift", colour), gap_m=1.0):
                break
    for kind, count in (("pallet", 4), ("empty_pallet", 2), ("drum", 3), ("pallet_jack", 1), ("box_stack", 2)):
        for _ in range(count):
            colour = builder.pick(("blue", "red", "green")) if kind == "drum" else ""
            for _ in range(20):
                x = float(builder.rng.uniform(rect.x0 + 0.9, rect.x1 - 0.9))
                y = float(builder.rng.uniform(rect.y0 + 0.9, rect.y1 - 0.9))
                heading = float(builder.rng.choice([0.0, pi / 2]))
                name = named(kind, colour) if kind in ("drum", "pallet_jack") else ""
                if builder.put(kind, x, y, heading, colour=colour, landmark=name, gap_m=1.0):
                    break
    builder.against(yard, "fire_extinguisher", side=builder.pick(("w", "e")), landmark=named("fire_extinguisher"))


def _things(builder: Builder, main: Room, aisles: list[Room]) -> None:
    """Add objects that distinguish the aisles: cones, extinguishers, barriers, pallets, a pallet jack."""
    for side in ("w", "e"):
        builder.against(main, "fire_extinguisher", side=side, landmark=named("fire_extinguisher"))
    kinds = builder.shuffled(
        ("traffic_cone", "box_stack", "pallet_jack", "drum", "fire_extinguisher", "wet_floor_sign")
    )
    starts = sorted({room.rect.y0 for room in aisles})
    for row, y0 in enumerate(starts):
        rooms = [room for room in aisles if room.rect.y0 == y0]
        order = builder.shuffled(rooms)
        # Each kind occurs once per row of aisles, and at most once along the whole length of an aisle.
        for index, room in enumerate(rooms if row else order):
            kind = kinds[(index + 2 * row) % len(kinds)] if row == 0 else _other(builder, kinds, room)
            if kind:
                _in_aisle(builder, room, kind)
    for _ in range(2):
        x = float(builder.rng.uniform(main.rect.x0 + 4, main.rect.x1 - 4))
        y = main.rect.y0 + 0.4
        builder.put("traffic_cone", x, y, 0.0, landmark=named("traffic_cone"), gap_m=1.0)


def _other(builder: Builder, kinds: list[str], room: Room) -> str:
    """Return a kind that is new in this row of aisles and in the aisle that leads to this one."""
    rect = room.rect
    used = set()
    for thing in builder.things:
        x, y, _ = thing.position_m
        if thing.landmark and (rect.x0 <= x <= rect.x1 or rect.y0 <= y <= rect.y1):
            used.add(thing.kind)
    return next((kind for kind in kinds if kind not in used), "")


def _in_aisle(builder: Builder, room: Room, kind: str) -> None:
    """Place an object at one side of an aisle, so that two people can still pass."""
    rect = room.rect
    colour = builder.pick(("blue", "green")) if kind == "drum" else ""
    size = {"box_stack": (0.7, 0.5, 1.1), "pallet_jack": (1.6, 0.6, 1.2)}.get(kind)
    width = {"pallet_jack": 0.6, "box_stack": 0.5, "drum": 0.58}.get(kind, 0.4)
    side = float(builder.rng.choice([-1, 1]))
    x = rect.centre[0] + side * (rect.width / 2 - width / 2 - 0.06)
    y = rect.y0 + 1.0 + float(builder.rng.uniform(0.45, 0.95)) * (rect.depth - 2.0)
    heading = pi / 2 if kind in ("pallet_jack", "box_stack") else (pi if side > 0 else 0.0)
    builder.put(kind, x, y, heading, size=size, colour=colour, landmark=named(kind, colour), force=True)
