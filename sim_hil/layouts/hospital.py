"""Hospital: long narrow corridors with carts, patient rooms with beds, reception, waiting and service areas.

Paper appendix C: "long corridors, patient rooms, medical equipment, and service areas … narrow passages".
"""

from __future__ import annotations

import numpy as np

from sim_hil.layouts.builder import Builder, Room
from sim_hil.layouts.furnish import corridor_ends, door, lights, named, outer_windows, sit_on, wide_opening
from sim_hil.layouts.plan import LayoutError, Rect
from sim_hil.layouts.skeleton import Bones, Building, raise_bones
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
    bounds = Rect(0, 0, building.long[0].rect.x1, max(slot.y1 for slot, _ in building.slots))
    slots = [building.slots[int(i)] for i in rng.permutation(len(building.slots))]
    wide = sorted(slots, key=lambda slot: -slot[0].width)[:3]
    rest = [slot for slot in slots if slot not in wide]
    if len(rest) < 8:
        raise LayoutError("too few rooms")
    colours = [_MACHINES[int(i)] for i in rng.permutation(len(_MACHINES))]

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
    outer_windows(builder, bounds, rooms)
    lights(builder)
    for room in rooms:
        builder.stand_in(room.rect, 1)
    for corridor in building.long + building.cross + building.stubs:
        builder.stand_in(corridor.rect, max(1, round(max(corridor.rect.width, corridor.rect.depth) / 5)))
    south = building.long[0].rect
    start = (south.x0 + 2.0, south.centre[1], 0.0)
    return builder.scene("hospital", start, (south.x1 - 2.5, south.centre[1]), floor="vinyl")


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
    sofa = builder.against(room, "sofa", side=back, along=0.5, colour=colour, landmark=named("sofa", colour))
    if sofa is not None:
        sit_on(builder, sofa, 2)
    for wall in ("w", "e"):
        for share in (0.3, 0.62):
            chair = builder.against(room, "chair", side=wall, along=share)
            if chair is not None:
                sit_on(builder, chair, 1)
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
    water = builder.against(room, "water_dispenser", side=back, landmark=named("water_dispenser"))
    if water is not None:
        builder.place_before(water, "queue", 2)
    coffee = builder.against(room, "coffee_machine", side=builder.pick(("w", "e")), landmark=named("coffee_machine"))
    if coffee is not None:
        builder.place_before(coffee, "queue", 2)
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
        chair = builder.against(room, "chair")
        if chair is not None:
            sit_on(builder, chair, 1)
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
    """Add single objects along the corridors, so that a robot and a person can still pass each other."""
    builder = building.builder
    machine = builder.against(
        building.long[int(builder.rng.integers(2))], "vending_machine", side=builder.pick(("n", "s")), tries=60,
        colour=colours[0], landmark=named("vending_machine", colours[0]), text="SNACKS", lone=True,
    )  # fmt: skip
    if machine is not None:
        builder.place_before(machine, "queue", 2, gap_m=0.5)
    for corridor in [*building.long, *building.cross]:
        walls = ("n", "s") if corridor in building.long else ("w", "e")
        length = max(corridor.rect.width, corridor.rect.depth)
        wanted = ["water_dispenser", "bench", "plant", "medical_cart", "fire_extinguisher", "wheelchair", "trash_bin"]
        wanted = [wanted[int(i)] for i in builder.rng.permutation(len(wanted))]
        for kind in wanted[: 5 if length > 20 else 2]:
            colour = builder.pick(("blue", "red", "green", "orange")) if kind == "bench" else ""
            size = (0.9, 0.65, 0.92) if kind == "wheelchair" else None
            thing = builder.against(corridor, kind, side=builder.pick(walls), colour=colour, size=size,
                                    landmark=named(kind, colour), lone=True)  # fmt: skip
            if thing is None:
                continue
            if kind == "bench":
                sit_on(builder, thing, 2)
            elif kind == "water_dispenser":
                builder.place_before(thing, "queue", 2)
        for _ in range(round(length / 9)):
            kind = builder.pick(("notice_board", "painting", "painting", "clock"))
            builder.against(corridor, kind, side=builder.pick(walls), text="NOTICES" if kind == "notice_board" else "",
                            landmark=named(kind) if kind == "notice_board" else "")  # fmt: skip
