"""Meshes of indoor objects in corridors, lounges and offices, one function per kind."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, pi, sin

from sim_hil.world.drawing import prints as world_prints
from sim_hil.world.drawing import textures
from sim_hil.world.drawing.kit import BLACK, DARK, STEEL, WHITE, Kit


def _vending_machine(kit: Kit) -> None:
    kit.whole(kit.paint(0.7), kit.picture(textures.vending_front), kit.picture(textures.vending_side))


def _bench(kit: Kit) -> None:
    for row in (-1, 0, 1):
        kit.part((row / 3 - 0.145, row / 3 + 0.145), (-0.5, 0.5), (1 - 0.04 / kit.height, 1.0), kit.paint())
    for side in (-0.4, 0.4):
        kit.part((-0.4, 0.4), (side - 0.02, side + 0.02), (0.0, 1 - 0.04 / kit.height), (70, 72, 76))


def _plant(kit: Kit) -> None:
    kit.rings(((0.0, 0.28), (0.30, 0.40)), (176, 92, 58), 8)
    kit.post(0, 0, (0.30, 0.70), 0.025, (92, 66, 40), 5)
    rng = kit.rng()
    for index in range(7):
        turn, out = 2 * pi * index / 7, 0.20 + 0.12 * rng.random()
        radii = (0.20 * kit.depth, 0.20 * kit.width, 0.13 * kit.height)
        shade = 0.8 + 0.45 * rng.random()
        kit.ball(out * cos(turn), out * sin(turn), 0.5 + 0.30 * rng.random(), radii, kit.paint(shade), 6, 4)
    kit.ball(0, 0, 0.87, (0.22 * kit.depth, 0.22 * kit.width, 0.13 * kit.height), kit.paint(1.1), 6)


def _water_dispenser(kit: Kit) -> None:
    kit.part((-0.5, 0.5), (-0.5, 0.5), (0.0, 0.68), kit.paint(0.95), kit.picture(textures.dispenser_front))
    lip, top = 0.04 / kit.height, 0.97
    kit.rings(((0.68, 0.22), (0.68 + lip, 0.42), (top, 0.42), (1.0, 0.34)), (96, 170, 232), 10)


def _trash_bin(kit: Kit) -> None:
    kit.part((-0.5, 0.5), (-0.5, 0.5), (0.0, 0.96), kit.paint(), kit.picture(textures.bin_front))
    kit.part((-0.52, 0.52), (-0.52, 0.52), (0.96, 1.0), (40, 42, 46))


def _fire_extinguisher(kit: Kit) -> None:
    kit.rings(((0.0, 0.46), (0.68, 0.46), (0.78, 0.2)), kit.paint(), 10)
    kit.part((-0.15, 0.15), (-0.15, 0.15), (0.78, 0.90), BLACK)
    kit.part((-0.3, 0.5), (-0.1, 0.1), (0.90, 0.96), BLACK)
    kit.part((0.42, 0.5), (-0.25, 0.25), (0.25, 0.50), (245, 240, 220))
    kit.part((0.3, 0.42), (-0.42, -0.3), (0.3, 0.86), BLACK)


def _cabinet(kit: Kit) -> None:
    kit.whole(kit.paint(0.6), kit.picture(textures.cabinet_front))


def _reception_desk(kit: Kit) -> None:
    kit.part((0.2, 0.5), (-0.5, 0.5), (0.0, 0.95), kit.paint(0.8), kit.picture(world_prints.reception_front))
    kit.part((0.1, 0.56), (-0.51, 0.51), (0.95, 1.0), (236, 232, 224))
    kit.part((-0.5, 0.2), (-0.5, 0.5), (0.0, 0.68), kit.paint(0.9))
    kit.part((-0.5, 0.2), (-0.5, 0.5), (0.68, 0.72), (220, 214, 204))
    for y in (-0.2, 0.2):
        kit.part((-0.05, 0.0), (y - 0.08, y + 0.08), (0.78, 1.10), DARK)
        kit.part((-0.06, 0.01), (y - 0.01, y + 0.01), (0.72, 0.78), DARK)


def _column(kit: Kit) -> None:
    kit.part((-0.5, 0.5), (-0.5, 0.5), (0.0, 0.05), kit.paint(0.6))
    kit.part((-0.46, 0.46), (-0.46, 0.46), (0.05, 1.0), kit.paint())


def _chair(kit: Kit) -> None:
    kit.legs((0.0, 0.48), 0.05, (0.08, 0.08), STEEL)
    kit.part((-0.5, 0.5), (-0.5, 0.5), (0.48, 0.55), kit.paint())
    kit.part((-0.5, -0.4), (-0.48, 0.48), (0.62, 1.0), kit.paint(1.1))
    for y in (-0.4, 0.36):
        kit.part((-0.48, -0.42), (y, y + 0.05), (0.55, 0.62), STEEL)


def _table(kit: Kit) -> None:
    kit.part((-0.5, 0.5), (-0.5, 0.5), (0.94, 1.0), kit.paint())
    kit.legs((0.0, 0.94), 0.04, (0.08, 0.05), kit.paint(0.6))


def _sofa(kit: Kit) -> None:
    kit.part((-0.5, 0.5), (-0.5, 0.5), (0.06, 0.36), kit.paint(0.75))
    kit.part((-0.5, -0.24), (-0.5, 0.5), (0.36, 1.0), kit.paint(0.85))
    arm = min(0.2 / kit.width, 0.2)
    for low, high in ((-0.5, -0.5 + arm), (0.5 - arm, 0.5)):
        kit.part((-0.24, 0.5), (low, high), (0.36, 0.72), kit.paint(0.9))
    seats, inner = max(round(kit.width / 0.7), 1), 1 - 2 * arm
    for seat in range(seats):
        low = -0.5 + arm + seat * inner / seats
        high = low + inner / seats - 0.01
        kit.part((-0.22, 0.47), (low, high), (0.36, 0.54), kit.paint(1.15))
        kit.part((-0.26, -0.14), (low, high), (0.54, 0.92), kit.paint(1.05))


def _shelf(kit: Kit) -> None:
    kit.whole(kit.paint(0.8), kit.picture(world_prints.books))


def _wet_floor_sign(kit: Kit) -> None:
    for side in (1, -1):
        foot, head = 0.5 * side, 0.05 * side
        y = 0.5 * side
        corners = ((foot, -y, 0.0), (foot, y, 0.0), (head, 0.75 * y, 1.0), (head, -0.75 * y, 1.0))
        kit.print(world_prints.warning_board, *corners)
        kit.face(kit.paint(0.7), *corners[::-1])


def _desk(kit: Kit) -> None:
    top = 0.62
    kit.part((-0.5, 0.5), (-0.5, 0.5), (top - 0.03, top), kit.paint(1.1))
    kit.part((-0.46, -0.42), (-0.47, 0.47), (0.14, top - 0.03), kit.paint(0.8))
    kit.part((-0.48, 0.48), (0.46, 0.5), (0.0, top - 0.03), kit.paint(0.7))
    kit.part((-0.48, 0.44), (-0.5, -0.22), (0.0, top - 0.03), kit.paint(0.8))
    for row in range(3):
        low = 0.03 + 0.18 * row
        kit.part((0.44, 0.46), (-0.48, -0.24), (low, low + 0.15), kit.paint(1.15))
    kit.part((-0.30, -0.16), (-0.07, 0.07), (top, top + 0.02), DARK)
    kit.part((-0.25, -0.21), (-0.02, 0.02), (top + 0.02, 0.72), DARK)
    kit.part((-0.25, -0.20), (-0.2, 0.2), (0.70, 1.0), DARK, kit.picture(world_prints.desktop))
    kit.part((0.05, 0.25), (-0.14, 0.14), (top, top + 0.02), (60, 62, 68))
    kit.part((-0.1, 0.25), (0.26, 0.40), (top, top + 0.012), WHITE)
    kit.post(-0.1, -0.33, (top, top + 0.09), 0.04, (200, 60, 50), 8)


def _office_chair(kit: Kit) -> None:
    for x, y in ((0.45, 0.06), (0.06, 0.45)):
        kit.part((-x, x), (-y, y), (0.05, 0.10), BLACK)
    for x, y in ((0.42, 0.0), (-0.42, 0.0), (0.0, 0.42), (0.0, -0.42)):
        kit.wheel(x, y, 0.03, 0.03)
    kit.post(0, 0, (0.10, 0.44), 0.03, STEEL)
    kit.part((-0.4, 0.42), (-0.42, 0.42), (0.44, 0.54), kit.paint(1.4))
    kit.part((-0.46, -0.34), (-0.4, 0.4), (0.58, 1.0), kit.paint(1.8))
    for y in (-0.46, 0.40):
        kit.part((-0.25, 0.25), (y, y + 0.06), (0.66, 0.70), BLACK)
        kit.part((-0.05, 0.02), (y, y + 0.06), (0.5, 0.66), BLACK)


def _meeting_table(kit: Kit) -> None:
    kit.part((-0.5, 0.5), (-0.42, 0.42), (0.93, 1.0), kit.paint())
    kit.part((-0.36, 0.36), (-0.5, 0.5), (0.93, 1.0), kit.paint())
    for y in (-0.28, 0.28):
        kit.part((-0.08, 0.08), (y - 0.05, y + 0.05), (0.0, 0.93), kit.paint(0.6))
        kit.part((-0.3, 0.3), (y - 0.08, y + 0.08), (0.0, 0.05), kit.paint(0.6))
    for x, y in ((-0.25, -0.2), (0.25, 0.05), (-0.25, 0.25)):
        kit.part((x - 0.1, x + 0.1), (y - 0.04, y + 0.04), (1.0, 1.02), WHITE)


def _partition(kit: Kit) -> None:
    kit.part((-0.5, 0.5), (-0.5, 0.5), (0.06, 0.97), kit.paint())
    kit.part((-0.6, 0.6), (-0.5, 0.5), (0.97, 1.0), STEEL)
    for low, high in ((-0.5, -0.48), (0.48, 0.5)):
        kit.part((-0.6, 0.6), (low, high), (0.0, 0.97), STEEL)


def _printer(kit: Kit) -> None:
    kit.part((-0.5, 0.45), (-0.5, 0.5), (0.0, 0.86), kit.paint(0.9), kit.picture(world_prints.printer_front))
    kit.part((-0.5, 0.40), (-0.5, 0.3), (0.88, 1.0), (70, 74, 80))
    kit.part((0.40, 0.5), (0.02, 0.4), (0.80, 0.90), (60, 140, 220))


def _coffee_machine(kit: Kit) -> None:
    kit.whole(kit.paint(), kit.picture(world_prints.coffee_front))


def _refrigerator(kit: Kit) -> None:
    kit.whole(kit.paint(0.9), kit.picture(world_prints.fridge_front))


BUILDERS: dict[str, Callable[[Kit], None]] = {
    "vending_machine": _vending_machine,
    "bench": _bench,
    "plant": _plant,
    "water_dispenser": _water_dispenser,
    "trash_bin": _trash_bin,
    "fire_extinguisher": _fire_extinguisher,
    "cabinet": _cabinet,
    "reception_desk": _reception_desk,
    "column": _column,
    "chair": _chair,
    "table": _table,
    "sofa": _sofa,
    "armchair": _sofa,
    "shelf": _shelf,
    "wet_floor_sign": _wet_floor_sign,
    "desk": _desk,
    "office_chair": _office_chair,
    "meeting_table": _meeting_table,
    "partition": _partition,
    "printer": _printer,
    "coffee_machine": _coffee_machine,
    "refrigerator": _refrigerator,
}
