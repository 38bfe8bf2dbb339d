"""Hospital: long narrow corridors with carts, patient rooms with beds, reception, waiting and service areas.

Paper appendix C: "long corridors, patient rooms, medical equipment, and service areas … narrow passages".
"""

from __future__ import annotations

import numpy as np

from sim_hil.layouts.builder import Builder, Room
from sim_hil.layouts.building import (
    Bones,
    Building,
    along_corridors,
    corridor_ends,
    door,
    finished,
    named,
    raise_bones,
    wide_opening,
)  # fmt: skip
from sim_hil.layouts.plan import LayoutError, Rect
from sim_hil.scene.scene import Scene

_BONES = Bones(
    length_m=(38.0, 42.0),
    corridor_m=(2.5, 3.0),
    outer_row_m=(4.8, 5.8),
    inner_row_m=(4.8, 5.8),
    room_m=(3.8, 5.4),
    cross=(2, 3),
    stubs=(1, 2),
    door_m=1.3,
    corridor_floor="vinyl",
)
_MACHINES = ("red", "blue", "green", "yellow")


def hospital(rng: np.random.Generator) -> Scene:
    """Generate a hospital. Raises LayoutError or SceneError if the random draw is not feasible."""
    builder = Builder("hospital", rng, "wall_hospital", 2.8)
    building = raise_bones(builder, _BONES)
    slots = builder.shuffled(building.slots)
    wide = sorted(slots, key=lambda slot: -slot[0].width)[:3]
    rest = [slot for slot in slots if slot not in wide]
    if len(rest) < 8:
        raise LayoutError("too few rooms")
    colours = builder.shuffled(_MACHINES)

    # Ends of corridors come first, so that their doors are in the middle of the wall.
    corridor_ends(building)
    _reception(builder, *wide[0])
    _waiting(builder, *wide[1])
    _service(builder, *wide[2], colours[0])
    kinds = ["nurse room", "storage room", "treatment room"] + ["patient room"] * len(rest)
    rooms: list[Room] = []
    for number, (slot, corridor) in enumerate(sorted(rest, key=lambda s: (s[0].y0, s[0].x0))):
        name = kinds[int(rng.integers(3))] if number % 5 == 4 else "patient room"
        room = builder.room(slot, "room", name, _floor_of(name))
        rooms.append(room)
        door(builder, room, corridor, _BONES.door_m, _colour_of(name), f"{_short(name)} {101 + number}")
        _furnish(builder, room, name)
    _along_corridors(building, colours[1:])
    return finished(building, "hospital", rooms)


def _floor_of(name: str) -> str:
    return {"patient room": "vinyl_green", "nurse room": "wood", "treatment room": "floor_tiles"}.get(name, "concrete")


def _colour_of(name: str) -> str:
    return {"patient room": "blue", "nurse room": "orange", "treatment room": "green"}.get(name, "grey")


def _short(name: str) -> str:
    return {"patient room": "ROOM", "nurse room": "NURSES", "treatment room": "TREATMENT"}.get(name, "STORAGE")


def _reception(builder: Builder, slot: Rect, corridor: Room) -> None:
    room = builder.room(slot, "lobby", "reception", "marble")
    wide_opening(builder, room, corridor, 3.6, "purple", "RECEPTION")
    side = "s" if corridor.rect.y0 < slot.y0 else "n"
    back = "n" if side == "s" else "s"
    desk = builder.against(room, "reception_desk", side=back, along=0.5, landmark=named("reception_desk"),
                           size=(0.8, min(3.0, slot.width - 1.4), 1.1), text="RECEPTION")  # fmt: skip
    if desk is None:
        raise LayoutError("no room for the reception desk")
    builder.place_before(desk, "queue", 4)
    for wall in ("w", "e"):
        plant = builder.against(room, "plant", side=wall, along=0.9 if side == "s" else 0.1)
        if plant is not None:
            builder.against(room, "painting", side=wall)


def _waiting(builder: Builder, slot: Rect, corridor: Room) -> None:
    room = builder.room(slot, "lobby", "waiting area", "carpet_blue")
    wide_opening(builder, room, corridor, 3.4, "green", "WAITING")
    colour = builder.pick(("red", "orange", "green", "yellow"))
    back = "n" if corridor.rect.y0 < slot.y0 else "s"
    builder.against(room, "sofa", side=back, along=0.5, colour=colour, landmark=named("sofa", colour),
                    seats=2)  # fmt: skip
    for wall in ("w", "e"):
        for share in (0.3, 0.62):
            builder.against(room, "chair", side=wall, along=share, seats=1)
    builder.against(room, "screen", side=back)
    builder.stand_in(slot, 2)


def _service(builder: Builder, slot: Rect, corridor: Room, colour: str) -> None:
    room = builder.room(slot, "lobby", "service area", "floor_tiles")
    wide_opening(builder, room, corridor, 3.4, "orange", "CAFE")
    back = "n" if corridor.rect.y0 < slot.y0 else "s"
    machine = builder.against(room, "vending_machine", side=back, along=float(builder.rng.choice([0.2, 0.5, 0.8])),
                              colour=colour, landmark=named("vending_machine", colour), text="DRINKS")  # fmt: skip
    if machine is None:
        raise LayoutError("no room for the vending machine")
    builder.place_before(machine, "queue", 3)
    builder.against(room, "water_dispenser", side=back, landmark=named("water_dispenser"), queue=2)
    side = builder.pick(("w", "e"))
    builder.against(room, "coffee_machine", side=side, landmark=named("coffee_machine"), queue=2)
    builder.against(room, "trash_bin", landmark=named("trash_bin"))


def _furnish(builder: Builder, room: Room, name: str) -> None:
    if name == "patient room":
        beds = 2 if room.rect.width > 4.6 else 1
        side = builder.pick(("w", "e"))
        for index in range(beds):
            builder.against(
                room, "hospital_bed", side=side if index == 0 else "", landmark=named("hospital_bed"), tries=40,
            )  # fmt: skip
        extra = builder.pick(("iv_stand", "medical_monitor", "privacy_screen", "wheelchair"))
        builder.against(room, extra)
        builder.against(room, "cabinet", colour=builder.pick(("white", "blue", "green", "brown")))
        builder.against(room, "chair", seats=1)
        builder.against(room, builder.pick(("painting", "screen", "clock")))
    elif name == "nurse room":
        builder.against(room, "desk", landmark=named("desk"), tries=40)
        builder.against(room, "cabinet")
        builder.against(room, "whiteboard", landmark=named("whiteboard"))
        builder.against(room, "refrigerator", landmark=named("refrigerator"))
    elif name == "treatment room":
        builder.against(room, "hospital_bed", landmark=named("hospital_bed"), tries=40)
        builder.against(room, "medical_monitor", landmark=named("medical_monitor"))
        builder.against(room, "medical_cart")
        builder.against(room, "cabinet", colour="white")
    else:
        builder.against(room, "shelf", landmark=named("shelf"), tries=40)
        for _ in range(2):
            builder.against(room, "box_stack")
        builder.against(room, "medical_cart")
        builder.against(room, "wheelchair", landmark=named("wheelchair"))


def _along_corridors(building: Building, colours: list[str]) -> None:
    builder = building.builder
    machine = builder.against(
        building.long[int(builder.rng.integers(2))], "vending_machine", side=builder.pick(("n", "s")), tries=60,
        colour=colours[0], landmark=named("vending_machine", colours[0]), text="SNACKS", lone=True,
    )  # fmt: skip
    if machine is not None:
        builder.place_before(machine, "queue", 2, gap_m=0.5)
    kinds = ("water_dispenser", "bench", "plant", "medical_cart", "fire_extinguisher", "wheelchair", "trash_bin")
    hung = ("notice_board", "painting", "painting", "clock")
    along_corridors(building, kinds, hung, 9.0, coloured=("bench",))
