"""Kinds of scene objects: default size and colour, name for instructions, and collision boxes.

A part is a box in fractions of the object's size: depth and width from -0.5 to 0.5 (front and left positive), height
from 0 to 1; a rotated part uses the smaller of depth and width. Things above head height (a parasol's cloth, a tree's
crown) have no part. Planners and people treat every part as reaching down to the floor; the physics does not.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

Vec3 = tuple[float, float, float]


@dataclass(frozen=True)
class Part:
    """Box in fractions of an object's size: (from, to) along depth, width and height, rotated by `turn_rad`."""

    x: tuple[float, float] = (-0.5, 0.5)
    y: tuple[float, float] = (-0.5, 0.5)
    z: tuple[float, float] = (0.0, 1.0)
    turn_rad: float = 0.0


WHOLE = (Part(),)


@dataclass(frozen=True)
class Kind:
    """Kind of object; `size_m` and `colour`: defaults for scene files, `noun`: name for instructions."""

    name: str
    noun: str
    size_m: Vec3  # depth, width, height
    colour: Vec3
    parts: tuple[Part, ...] = WHOLE  # empty for objects on walls or flat on the floor, which are no obstacles

    @property
    def solid(self) -> bool:
        """Whether the object is an obstacle for robots and people."""
        return bool(self.parts)


def _round(share: float, z: tuple[float, float]) -> tuple[Part, ...]:
    """Return an upright octagonal pillar, with a diameter as a share of the width, made of four boxes."""
    across, side = share / 2, share / 2 * 0.4142
    return tuple(Part((-across, across), (-side, side), z, turn) for turn in (0.0, pi / 4, pi / 2, 3 * pi / 4))


def _flat(name: str, noun: str, size_m: Vec3, colour: Vec3) -> Kind:
    return Kind(name, noun, size_m, colour, ())


_CHAIR = (Part(z=(0.0, 0.5)), Part((-0.5, -0.3), z=(0.5, 1.0)))
_SOFA = (Part(z=(0.0, 0.55)), Part((-0.5, -0.2), z=(0.55, 1.0)))
_DESK = (Part(z=(0.0, 0.62)), Part((-0.4, -0.1), (-0.25, 0.25), (0.62, 1.0)))
_CAR = (Part((-0.5, 0.5), z=(0.0, 0.62)), Part((-0.45, 0.22), (-0.42, 0.42), (0.62, 1.0)))
_FORKLIFT = (
    Part((-0.5, 0.17), z=(0.0, 0.5)),
    Part((-0.42, 0.13), (-0.45, 0.45), (0.5, 1.0)),
    Part((0.13, 0.2), (-0.4, 0.4)),
    Part((0.2, 0.5), (-0.3, -0.16), (0.0, 0.05)),
    Part((0.2, 0.5), (0.16, 0.3), (0.0, 0.05)),
)
_IV_STAND = (Part(z=(0.0, 0.06)), Part((-0.08, 0.08), (-0.08, 0.08), (0.06, 0.8)))
_UMBRELLA = (Part((-0.1, 0.1), (-0.1, 0.1), (0.0, 0.04)), Part((-0.015, 0.015), (-0.015, 0.015), (0.0, 1.0)))
_PALLET_JACK = (
    Part((-0.5, -0.25), z=(0.0, 0.35)),
    Part((-0.45, -0.35), (-0.12, 0.12), (0.35, 1.0)),
    Part((-0.25, 0.5), (-0.5, -0.2), (0.0, 0.09)),
    Part((-0.25, 0.5), (0.2, 0.5), (0.0, 0.09)),
)

KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        # Anywhere indoors
        Kind("vending_machine", "vending machine", (0.8, 1.1, 1.9), (0.80, 0.07, 0.09)),
        Kind("bench", "bench", (0.45, 1.6, 0.46), (0.62, 0.40, 0.20)),
        Kind("plant", "potted plant", (0.5, 0.5, 1.3), (0.16, 0.45, 0.17)),
        Kind("water_dispenser", "water dispenser", (0.36, 0.36, 1.25), (0.90, 0.92, 0.94)),
        Kind("trash_bin", "trash bin", (0.36, 0.36, 0.75), (0.15, 0.35, 0.62)),
        Kind("fire_extinguisher", "fire extinguisher", (0.18, 0.18, 0.6), (0.85, 0.08, 0.06)),
        Kind("cabinet", "cabinet", (0.42, 1.2, 1.05), (0.55, 0.58, 0.60)),
        Kind("reception_desk", "reception desk", (0.8, 3.0, 1.1), (0.55, 0.36, 0.20)),
        Kind("column", "column", (0.5, 0.5, 2.8), (0.80, 0.79, 0.76)),
        Kind("chair", "chair", (0.5, 0.48, 0.85), (0.20, 0.42, 0.60), _CHAIR),
        Kind("table", "table", (0.8, 1.4, 0.74), (0.72, 0.56, 0.38)),
        Kind("sofa", "sofa", (0.9, 2.0, 0.8), (0.62, 0.22, 0.20), _SOFA),
        Kind("armchair", "armchair", (0.85, 0.85, 0.8), (0.86, 0.62, 0.16), _SOFA),
        Kind("shelf", "bookshelf", (0.35, 1.2, 1.9), (0.60, 0.42, 0.26)),
        Kind("wet_floor_sign", "wet floor sign", (0.3, 0.3, 0.62), (0.98, 0.82, 0.08)),
        # Hospital
        Kind("hospital_bed", "hospital bed", (2.1, 0.95, 1.0), (0.86, 0.93, 0.96)),
        Kind("wheelchair", "wheelchair", (1.0, 0.65, 0.92), (0.10, 0.22, 0.50), _CHAIR),
        Kind("medical_cart", "medical cart", (0.5, 0.75, 1.0), (0.20, 0.52, 0.72)),
        Kind("iv_stand", "IV stand", (0.5, 0.5, 1.85), (0.74, 0.76, 0.78), _IV_STAND),
        Kind("medical_monitor", "patient monitor", (0.4, 0.4, 1.4), (0.88, 0.88, 0.84)),
        Kind("privacy_screen", "privacy screen", (0.08, 1.6, 1.8), (0.40, 0.72, 0.70)),
        # Office
        Kind("desk", "desk with a monitor", (0.8, 1.6, 1.18), (0.76, 0.60, 0.42), _DESK),
        Kind("office_chair", "office chair", (0.6, 0.6, 1.0), (0.12, 0.12, 0.14), _CHAIR),
        Kind("meeting_table", "meeting table", (1.2, 2.8, 0.74), (0.48, 0.32, 0.20)),
        Kind("partition", "partition", (0.06, 1.6, 1.35), (0.34, 0.44, 0.56)),
        Kind("printer", "printer", (0.6, 0.65, 1.1), (0.84, 0.85, 0.86)),
        Kind("coffee_machine", "coffee machine", (0.55, 0.6, 1.45), (0.16, 0.12, 0.10)),
        Kind("refrigerator", "refrigerator", (0.65, 0.7, 1.8), (0.84, 0.86, 0.88)),
        # Warehouse
        Kind("storage_rack", "storage rack", (1.1, 2.8, 3.6), (0.92, 0.42, 0.08)),
        Kind("pallet", "pallet with boxes", (1.0, 1.2, 1.2), (0.72, 0.53, 0.32)),
        Kind("empty_pallet", "empty pallet", (1.0, 1.2, 0.15), (0.70, 0.54, 0.34)),
        Kind("box_stack", "stack of boxes", (0.6, 0.9, 1.1), (0.76, 0.58, 0.36)),
        Kind("forklift", "forklift", (3.2, 1.2, 2.15), (0.96, 0.72, 0.06), _FORKLIFT),
        Kind("pallet_jack", "pallet jack", (1.6, 0.6, 1.2), (0.82, 0.14, 0.10), _PALLET_JACK),
        Kind("traffic_cone", "traffic cone", (0.4, 0.4, 0.72), (0.96, 0.36, 0.04)),
        Kind("drum", "drum", (0.58, 0.58, 0.88), (0.10, 0.30, 0.66), _round(1.0, (0.0, 1.0))),
        Kind("barrier", "barrier", (0.4, 1.6, 1.0), (0.92, 0.20, 0.12)),
        # Outdoors
        Kind("fountain", "fountain", (4.0, 4.0, 2.4), (0.74, 0.72, 0.68), _round(1.0, (0.0, 1.0))),
        Kind("umbrella", "umbrella", (2.8, 2.8, 2.5), (0.90, 0.16, 0.14), _UMBRELLA),
        Kind(
            "umbrella_table", "table with an umbrella", (2.8, 2.8, 2.5), (0.14, 0.50, 0.80),
            (*_round(0.36, (0.0, 0.3)), _UMBRELLA[1]),
        ),
        Kind("storefront", "storefront", (1.0, 6.0, 4.2), (0.16, 0.38, 0.34)),
        Kind("building", "building", (8.0, 16.0, 12.0), (0.70, 0.42, 0.32)),
        Kind("kiosk", "kiosk", (1.6, 2.4, 2.6), (0.12, 0.46, 0.30)),
        Kind("park_bench", "park bench", (0.6, 1.7, 0.85), (0.50, 0.32, 0.16), _SOFA),
        Kind("lamp_post", "lamp post", (0.8, 0.8, 4.4), (0.16, 0.20, 0.20), (Part((-0.1, 0.1), (-0.1, 0.1)),)),
        Kind("tree", "tree", (3.2, 3.2, 5.0), (0.20, 0.44, 0.16), _round(0.13, (0.0, 0.5))),
        Kind("hedge", "hedge", (0.7, 3.0, 0.9), (0.16, 0.36, 0.14)),
        Kind("planter", "planter", (0.8, 1.8, 0.9), (0.62, 0.58, 0.54)),
        Kind("bollard", "bollard", (0.22, 0.22, 0.95), (0.22, 0.23, 0.25), _round(1.0, (0.0, 1.0))),
        Kind("car", "car", (4.3, 1.8, 1.45), (0.14, 0.28, 0.62), _CAR),
        Kind("mailbox", "mailbox", (0.5, 0.55, 1.3), (0.10, 0.24, 0.62)),
        Kind("bus_stop", "bus stop", (1.4, 4.0, 2.5), (0.20, 0.26, 0.30), (
            Part((-0.5, -0.42)), Part((-0.42, 0.0), (-0.35, 0.35), (0.0, 0.2)), Part((-0.42, 0.4), (0.47, 0.5)),
        )),
        Kind("statue", "statue", (1.2, 1.2, 3.0), (0.34, 0.46, 0.40)),
        Kind("sign_post", "sign post", (0.3, 0.8, 2.4), (0.10, 0.28, 0.60), (Part((-0.2, 0.2), (-0.06, 0.06)),)),
        Kind("bicycle_rack", "bicycle rack", (1.7, 1.8, 1.05), (0.20, 0.50, 0.60)),
        # On walls, ceilings and floors
        _flat("door", "door", (0.05, 1.0, 2.1), (0.50, 0.32, 0.18)),
        _flat("double_door", "double door", (0.05, 1.8, 2.2), (0.30, 0.45, 0.55)),
        _flat("elevator", "elevator", (0.08, 1.9, 2.35), (0.70, 0.72, 0.74)),
        _flat("loading_door", "loading dock door", (0.08, 3.0, 3.2), (0.62, 0.66, 0.70)),
        _flat("window", "window", (0.04, 1.6, 1.2), (0.62, 0.80, 0.95)),
        _flat("notice_board", "notice board", (0.04, 1.8, 1.1), (0.72, 0.55, 0.35)),
        _flat("whiteboard", "whiteboard", (0.05, 2.0, 1.2), (0.96, 0.97, 0.97)),
        _flat("screen", "screen", (0.06, 1.4, 0.8), (0.06, 0.07, 0.09)),
        _flat("painting", "painting", (0.04, 1.0, 0.75), (0.66, 0.44, 0.20)),
        _flat("clock", "clock", (0.06, 0.4, 0.4), (0.96, 0.96, 0.94)),
        _flat("sign", "sign", (0.05, 1.2, 0.3), (0.10, 0.22, 0.60)),
        _flat("room_sign", "room sign", (0.03, 0.35, 0.25), (0.16, 0.24, 0.36)),
        _flat("exit_sign", "exit sign", (0.06, 0.7, 0.28), (0.04, 0.56, 0.26)),
        _flat("light", "ceiling light", (1.2, 0.5, 0.03), (1.0, 1.0, 0.97)),
        _flat("carpet", "carpet", (2.0, 3.0, 0.01), (0.62, 0.12, 0.14)),
        _flat("handrail", "handrail", (0.06, 2.0, 0.9), (0.55, 0.38, 0.22)),
        _flat("awning", "awning", (1.4, 4.0, 0.9), (0.86, 0.20, 0.18)),
    )
}  # fmt: skip
