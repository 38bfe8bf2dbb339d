"""Kinds of scene objects: default size and colour, name for instructions, and collision boxes.

A part is a box in fractions of the object's size: depth and width from -0.5 to 0.5 (front and left positive), height
from 0 to 1; a rotated part uses the smaller of depth and width. Things above head height (a parasol's cloth, a tree's
crown) have no part. Planners and people treat every part as reaching down to the floor; the physics does not.
"""

from __future__ import annotations

from collections.abc import Iterable
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
    """Kind of object; `size_m` and `colour`: defaults for scene files, `words`: name for instructions."""

    name: str
    words: str
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


def _solid(name: str, words: str, size_m: Vec3, colour: Vec3, parts: Iterable[Part] = WHOLE) -> Kind:
    return Kind(name, words, size_m, colour, tuple(parts))


def _flat(name: str, words: str, size_m: Vec3, colour: Vec3) -> Kind:
    return Kind(name, words, size_m, colour, ())


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
        _solid("vending_machine", "vending machine", (0.8, 1.1, 1.9), (0.80, 0.07, 0.09)),
        _solid("bench", "bench", (0.45, 1.6, 0.46), (0.62, 0.40, 0.20)),
        _solid("plant", "potted plant", (0.5, 0.5, 1.3), (0.16, 0.45, 0.17)),
        _solid("water_dispenser", "water dispenser", (0.36, 0.36, 1.25), (0.90, 0.92, 0.94)),
        _solid("trash_bin", "trash bin", (0.36, 0.36, 0.75), (0.15, 0.35, 0.62)),
        _solid("fire_extinguisher", "fire extinguisher", (0.18, 0.18, 0.6), (0.85, 0.08, 0.06)),
        _solid("cabinet", "cabinet", (0.42, 1.2, 1.05), (0.55, 0.58, 0.60)),
        _solid("reception_desk", "reception desk", (0.8, 3.0, 1.1), (0.55, 0.36, 0.20)),
        _solid("column", "column", (0.5, 0.5, 2.8), (0.80, 0.79, 0.76)),
        _solid("chair", "chair", (0.5, 0.48, 0.85), (0.20, 0.42, 0.60), _CHAIR),
        _solid("table", "table", (0.8, 1.4, 0.74), (0.72, 0.56, 0.38)),
        _solid("sofa", "sofa", (0.9, 2.0, 0.8), (0.62, 0.22, 0.20), _SOFA),
        _solid("armchair", "armchair", (0.85, 0.85, 0.8), (0.86, 0.62, 0.16), _SOFA),
        _solid("shelf", "bookshelf", (0.35, 1.2, 1.9), (0.60, 0.42, 0.26)),
        _solid("wet_floor_sign", "wet floor sign", (0.3, 0.3, 0.62), (0.98, 0.82, 0.08)),
        # Hospital
        _solid("hospital_bed", "hospital bed", (2.1, 0.95, 1.0), (0.86, 0.93, 0.96)),
        _solid("wheelchair", "wheelchair", (1.0, 0.65, 0.92), (0.10, 0.22, 0.50), _CHAIR),
        _solid("medical_cart", "medical cart", (0.5, 0.75, 1.0), (0.20, 0.52, 0.72)),
        _solid("iv_stand", "IV stand", (0.5, 0.5, 1.85), (0.74, 0.76, 0.78), _IV_STAND),
        _solid("medical_monitor", "patient monitor", (0.4, 0.4, 1.4), (0.88, 0.88, 0.84)),
        _solid("privacy_screen", "privacy screen", (0.08, 1.6, 1.8), (0.40, 0.72, 0.70)),
        # Office
        _solid("desk", "desk with a monitor", (0.8, 1.6, 1.18), (0.76, 0.60, 0.42), _DESK),
        _solid("office_chair", "office chair", (0.6, 0.6, 1.0), (0.12, 0.12, 0.14), _CHAIR),
        _solid("meeting_table", "meeting table", (1.2, 2.8, 0.74), (0.48, 0.32, 0.20)),
        _solid("partition", "partition", (0.06, 1.6, 1.35), (0.34, 0.44, 0.56)),
        _solid("printer", "printer", (0.6, 0.65, 1.1), (0.84, 0.85, 0.86)),
        _solid("coffee_machine", "coffee machine", (0.55, 0.6, 1.45), (0.16, 0.12, 0.10)),
        _solid("refrigerator", "refrigerator", (0.65, 0.7, 1.8), (0.84, 0.86, 0.88)),
        # Warehouse
        _solid("storage_rack", "storage rack", (1.1, 2.8, 3.6), (0.92, 0.42, 0.08)),
        _solid("pallet", "pallet with boxes", (1.0, 1.2, 1.2), (0.72, 0.53, 0.32)),
        _solid("empty_pallet", "empty pallet", (1.0, 1.2, 0.15), (0.70, 0.54, 0.34)),
        _solid("box_stack", "stack of boxes", (0.6, 0.9, 1.1), (0.76, 0.58, 0.36)),
        _solid("forklift", "forklift", (3.2, 1.2, 2.15), (0.96, 0.72, 0.06), _FORKLIFT),
        _solid("pallet_jack", "pallet jack", (1.6, 0.6, 1.2), (0.82, 0.14, 0.10), _PALLET_JACK),
        _solid("traffic_cone", "traffic cone", (0.4, 0.4, 0.72), (0.96, 0.36, 0.04)),
        _solid("drum", "drum", (0.58, 0.58, 0.88), (0.10, 0.30, 0.66), _round(1.0, (0.0, 1.0))),
        _solid("barrier", "barrier", (0.4, 1.6, 1.0), (0.92, 0.20, 0.12)),
        # Outdoors
        _solid("fountain", "fountain", (4.0, 4.0, 2.4), (0.74, 0.72, 0.68), _round(1.0, (0.0, 1.0))),
        _solid("umbrella", "umbrella", (2.8, 2.8, 2.5), (0.90, 0.16, 0.14), _UMBRELLA),
        _solid(
            "umbrella_table", "table with an umbrella", (2.8, 2.8, 2.5), (0.14, 0.50, 0.80),
            (*_round(0.36, (0.0, 0.3)), _UMBRELLA[1]),
        ),
        _solid("storefront", "storefront", (1.0, 6.0, 4.2), (0.16, 0.38, 0.34)),
        _solid("building", "building", (8.0, 16.0, 12.0), (0.70, 0.42, 0.32)),
        _solid("kiosk", "kiosk", (1.6, 2.4, 2.6), (0.12, 0.46, 0.30)),
        _solid("park_bench", "park bench", (0.6, 1.7, 0.85), (0.50, 0.32, 0.16), _SOFA),
        _solid("lamp_post", "lamp post", (0.8, 0.8, 4.4), (0.16, 0.20, 0.20), (Part((-0.1, 0.1), (-0.1, 0.1)),)),
        _solid("tree", "tree", (3.2, 3.2, 5.0), (0.20, 0.44, 0.16), _round(0.13, (0.0, 0.5))),
        _solid("hedge", "hedge", (0.7, 3.0, 0.9), (0.16, 0.36, 0.14)),
        _solid("planter", "planter", (0.8, 1.8, 0.9), (0.62, 0.58, 0.54)),
        _solid("bollard", "bollard", (0.22, 0.22, 0.95), (0.22, 0.23, 0.25), _round(1.0, (0.0, 1.0))),
        _solid("car", "car", (4.3, 1.8, 1.45), (0.14, 0.28, 0.62), _CAR),
        _solid("mailbox", "mailbox", (0.5, 0.55, 1.3), (0.10, 0.24, 0.62)),
        _solid("bus_stop", "bus stop", (1.4, 4.0, 2.5), (0.20, 0.26, 0.30), (
            Part((-0.5, -0.42)), Part((-0.42, 0.0), (-0.35, 0.35), (0.0, 0.2)), Part((-0.42, 0.4), (0.47, 0.5)),
        )),
        _solid("statue", "statue", (1.2, 1.2, 3.0), (0.34, 0.46, 0.40)),
        _solid("sign_post", "sign post", (0.3, 0.8, 2.4), (0.10, 0.28, 0.60), (Part((-0.2, 0.2), (-0.06, 0.06)),)),
        _solid("bicycle_rack", "bicycle rack", (1.7, 1.8, 1.05), (0.20, 0.50, 0.60)),
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

SOLID_KINDS = frozenset(name for name, kind in KINDS.items() if kind.solid)
FLAT_KINDS = frozenset(KINDS) - SOLID_KINDS
