"""Office: connected rooms, branching corridors, elevators, an open area with desks, lounges with coloured carpets.

Paper appendix C: "interconnected rooms, corridors, elevators, and desk areas … greater topological diversity".
"""

from __future__ import annotations

from math import pi

import numpy as np

from sim_hil.layouts.builder import Builder, Room
from sim_hil.layouts.building import (
    Bones,
    along_corridors,
    corridor_ends,
    door,
    finished,
    lintel,
    named,
    raise_bones,
    wide_opening,
)  # fmt: skip
from sim_hil.layouts.plan import LayoutError, Rect, shared_border
from sim_hil.scene.scene import Scene

_BONES = Bones(
    length_m=(33.0, 37.0),
    corridor_m=(2.0, 2.4),
    outer_row_m=(5.0, 6.0),
    inner_row_m=(5.0, 6.2),
    room_m=(3.6, 5.2),
    cross=(2, 3),
    stubs=(1, 3),
    door_m=1.2,
    corridor_floor="carpet_tiles",
)
_NAMES = ("office", "office", "meeting room", "lounge", "print room", "kitchen", "office")
_SIGNS = {"office": ("blue", "OFFICE"), "meeting room": ("green", "MEETING"), "lounge": ("purple", "LOUNGE"),
          "print room": ("grey", "PRINT"), "kitchen": ("orange", "KITCHEN")}  # fmt: skip
_FLOORS = {"office": "wood", "meeting room": "carpet_blue", "lounge": "wood", "print room": "concrete",
           "kitchen": "floor_tiles"}  # fmt: skip
_CARPETS = ("red", "green", "yellow", "purple", "blue")


def office(rng: np.random.Generator) -> Scene:
    """Generate an office floor. Raises LayoutError or SceneError if the random draw is not feasible."""
    builder = Builder("office", rng, "wall_office", 2.7)
    building = raise_bones(builder, _BONES)
    corridor_ends(building, "door")
    slots = sorted(building.slots, key=lambda slot: (slot[0].y0, slot[0].x0))
    slots, hall = _merged(builder, slots)
    rooms = [_open_floor(builder, *hall)]
    order = builder.shuffled(slots)
    if len(order) < 9:
        raise LayoutError("too few rooms")
    _elevators(builder, *order.pop())
    carpets = builder.shuffled(_CARPETS)
    for number, (slot, corridor) in enumerate(sorted(order, key=lambda s: (s[0].y0, s[0].x0))):
        # First one of each kind, so that every office has a kitchen and a lounge; then random ones.
        name = _NAMES[number] if number < len(_NAMES) else builder.pick(_NAMES)
        room = builder.room(slot, "room", name, _FLOORS[name])
        rooms.append(room)
        colour, word = _SIGNS[name]
        door(builder, room, corridor, _BONES.door_m, colour, f"{word} {number + 1}")
    _connect(builder, rooms)
    for room in rooms[1:]:
        _furnish(builder, room, carpets)
    kinds = ("water_dispenser", "bench", "plant", "fire_extinguisher", "trash_bin", "cabinet", "wet_floor_sign")
    hung = ("notice_board", "painting", "painting", "screen")
    along_corridors(building, kinds, hung, 7.0, coloured=("bench", "cabinet", "painting"))
    return finished(building, "office", rooms)


def _merged(
    builder: Builder, slots: list[tuple[Rect, Room]]
) -> tuple[list[tuple[Rect, Room]], tuple[Rect, Room]]:  # fmt: skip
    """Merge two or three neighbouring slots into a large one. Raises LayoutError if there are none."""
    runs = []
    for index, (first, corridor) in enumerate(slots):
        run = [(first, corridor)]
        for rect, other in slots[index + 1 :]:
            if other is corridor and rect.y0 == first.y0 and abs(rect.x0 - run[-1][0].x1) < 1e-6 and len(run) < 3:
                run.append((rect, other))
        if len(run) >= 2 and run[-1][0].x1 - first.x0 >= 8.0:
            runs.append(run)
    if not runs:
        raise LayoutError("no room for the open floor")
    run = runs[int(builder.rng.integers(len(runs)))]
    whole = Rect(run[0][0].x0, run[0][0].y0, run[-1][0].x1, run[0][0].y1)
    return [slot for slot in slots if slot not in run], (whole, run[0][1])


def _open_floor(builder: Builder, rect: Rect, corridor: Room) -> Room:
    """Add rows of desks with partitions, open to the corridor."""
    room = builder.room(rect, "lobby", "open office", "carpet_blue")
    border = builder.open(room, corridor, 3.2, margin_m=0.4)
    lintel(builder, border, corridor.rect, "blue", "OPEN OFFICE")
    south = corridor.rect.y0 < rect.y0
    back = "n" if south else "s"
    count = int(rect.width // 2.7)
    for index in range(count):
        desk = builder.against(room, "desk", side=back, along=(index + 0.5) / count, landmark=named("desk"))
        if desk is not None:
            toward = 1 if south else -1
            x, y, _ = desk.position_m
            builder.put("office_chair", x, y - toward * 0.85, toward * pi / 2, gap_m=0.0)
    for wall in ("w", "e"):
        builder.against(room, "shelf", side=wall, landmark=named("shelf"))
        builder.against(room, "printer", side=wall, landmark=named("printer"))
    builder.stand_in(rect, 3)
    return room


def _elevators(builder: Builder, rect: Rect, corridor: Room) -> None:
    room = builder.room(rect, "lobby", "elevator lobby", "marble")
    wide_opening(builder, room, corridor, 3.0, "red", "ELEVATOR")
    back = "n" if corridor.rect.y0 < rect.y0 else "s"
    # Only one door, so that "the elevator" is unambiguous.
    lift = builder.against(room, "elevator", side=back, along=0.5, landmark=named("elevator"))
    if lift is None:
        raise LayoutError("no room for the elevator")
    builder.place_before(lift, "door", 4, gap_m=0.6)
    x, y, _ = lift.position_m
    inward = -1 if back == "n" else 1
    builder.keep_clear(Rect(x - 1.0, min(y, y + inward * 1.6), x + 1.0, max(y, y + inward * 1.6)))
    builder.against(room, "plant", side=builder.pick(("w", "e")), landmark=named("plant"))
    builder.stand_in(rect, 2)


def _connect(builder: Builder, rooms: list[Room]) -> None:
    """Add doors between some neighbouring rooms."""
    for index, a in enumerate(rooms):
        for b in rooms[index + 1 :]:
            try:
                border = shared_border(a.rect, b.rect)
            except LayoutError:
                continue
            if border.length > 3.0 and builder.rng.uniform() < 0.25:
                builder.open(a, b, _BONES.door_m, margin_m=0.9)


def _furnish(builder: Builder, room: Room, carpets: list[str]) -> None:
    middle = room.rect.centre
    if room.name == "office":
        for _ in range(2 if room.rect.width > 4.4 else 1):
            builder.against(room, "desk", landmark=named("desk"), tries=40)
        builder.against(room, "shelf", landmark=named("shelf"))
        builder.against(room, "cabinet", colour=builder.pick(("white", "brown", "grey")))
        builder.against(room, builder.pick(("painting", "whiteboard", "clock")))
    elif room.name == "meeting room":
        along_x = room.rect.width > room.rect.depth
        size = (1.0, 1.8, 0.74)
        table = builder.put("meeting_table", *middle, pi / 2 if along_x else 0.0, size=size, gap_m=0.0,
                            landmark=named("meeting_table"))  # fmt: skip
        if table is None:
            raise LayoutError("no room for the meeting table")
        builder.against(room, "screen", landmark=named("screen"))
        builder.against(room, "whiteboard", landmark=named("whiteboard"))
        builder.against(room, "plant")
    elif room.name == "lounge":
        colour = carpets.pop() if carpets else "brown"
        builder.put("carpet", *middle, 0.0, size=(min(2.4, room.rect.width - 1.6), 2.0, 0.01), colour=colour,
                    landmark=named("carpet", colour))  # fmt: skip
        colour = builder.pick(("red", "green", "yellow", "blue"))
        builder.against(room, "sofa", colour=colour, landmark=named("sofa", colour), tries=40, seats=2)
        builder.against(room, "armchair", colour=builder.pick(("orange", "green", "purple")), seats=1)
        builder.against(room, "painting")
    elif room.name == "print room":
        builder.against(room, "printer", landmark=named("printer"), tries=40)
        builder.against(room, "shelf", landmark=named("shelf"))
        builder.against(room, "box_stack")
        builder.against(room, "cabinet", colour="grey")
    else:
        colour = builder.pick(("red", "blue", "green", "yellow"))
        builder.against(room, "vending_machine", colour=colour, text="SNACKS", tries=40, queue=2,
                        landmark=named("vending_machine", colour))  # fmt: skip
        builder.against(room, "refrigerator", landmark=named("refrigerator"), queue=2)
        builder.against(room, "coffee_machine", landmark=named("coffee_machine"), tries=40, queue=2)
        builder.against(room, "table")
        builder.against(room, "trash_bin")
