"""Meshes of indoor objects in corridors, lounges and offices: every function builds the kind of object of its name."""

from __future__ import annotations

from math import cos, pi, sin

from sim_hil.world.drawing import prints, textures
from sim_hil.world.drawing.kit import BLACK, DARK, STEEL, WHITE, Kit, plate


def vending_machine(kit: Kit) -> None:
    kit.whole(kit.paint(0.7), kit.picture(textures.vending_front), kit.picture(textures.vending_side))


def bench(kit: Kit) -> None:
    for row in (-1, 0, 1):
        kit.part((row / 3 - 0.145, row / 3 + 0.145), (-0.5, 0.5), (1 - 0.04 / kit.height, 1.0), kit.paint())
    for side in (-0.4, 0.4):
        kit.part((-0.4, 0.4), (side - 0.02, side + 0.02), (0.0, 1 - 0.04 / kit.height), (70, 72, 76))


def plant(kit: Kit) -> None:
    kit.rings(((0.0, 0.28), (0.30, 0.40)), (176, 92, 58), 8)
    kit.post(0, 0, (0.30, 0.70), 0.025, (92, 66, 40), 5)
    rng = kit.rng()
    for index in range(7):
        turn, out = 2 * pi * index / 7, 0.20 + 0.12 * rng.random()
        radii = (0.20 * kit.depth, 0.20 * kit.width, 0.13 * kit.height)
        shade = 0.8 + 0.45 * rng.random()
        kit.ball(out * cos(turn), out * sin(turn), 0.5 + 0.30 * rng.random(), radii, kit.paint(shade), 6, 4)
    kit.ball(0, 0, 0.87, (0.22 * kit.depth, 0.22 * kit.width, 0.13 * kit.height), kit.paint(1.1), 6)


def water_dispenser(kit: Kit) -> None:
    kit.part((-0.5, 0.5), (-0.5, 0.5), (0.0, 0.68), kit.paint(0.95), kit.picture(textures.dispenser_front))
    lip, top = 0.04 / kit.height, 0.97
    kit.rings(((0.68, 0.22), (0.68 + lip, 0.42), (top, 0.42), (1.0, 0.34)), (96, 170, 232), 10)


def trash_bin(kit: Kit) -> None:
    kit.part((-0.5, 0.5), (-0.5, 0.5), (0.0, 0.96), kit.paint(), kit.picture(textures.bin_front))
    kit.part((-0.52, 0.52), (-0.52, 0.52), (0.96, 1.0), (40, 42, 46))


def fire_extinguisher(kit: Kit) -> None:
    kit.rings(((0.0, 0.46), (0.68, 0.46), (0.78, 0.2)), kit.paint(), 10)
    kit.part((-0.15, 0.15), (-0.15, 0.15), (0.78, 0.90), BLACK)
    kit.part((-0.3, 0.5), (-0.1, 0.1), (0.90, 0.96), BLACK)
    kit.part((0.42, 0.5), (-0.25, 0.25), (0.25, 0.50), (245, 240, 220))
    kit.part((0.3, 0.42), (-0.42, -0.3), (0.3, 0.86), BLACK)


def reception_desk(kit: Kit) -> None:
    kit.part((0.2, 0.5), (-0.5, 0.5), (0.0, 0.95), kit.paint(0.8), kit.picture(prints.reception_front))
    kit.part((0.1, 0.56), (-0.51, 0.51), (0.95, 1.0), (236, 232, 224))
    kit.part((-0.5, 0.2), (-0.5, 0.5), (0.0, 0.68), kit.paint(0.9))
    kit.part((-0.5, 0.2), (-0.5, 0.5), (0.68, 0.72), (220, 214, 204))
    for y in (-0.2, 0.2):
        kit.part((-0.05, 0.0), (y - 0.08, y + 0.08), (0.78, 1.10), DARK)
        kit.part((-0.06, 0.01), (y - 0.01, y + 0.01), (0.72, 0.78), DARK)


def column(kit: Kit) -> None:
    kit.part((-0.5, 0.5), (-0.5, 0.5), (0.0, 0.05), kit.paint(0.6))
    kit.part((-0.46, 0.46), (-0.46, 0.46), (0.05, 1.0), kit.paint())


def chair(kit: Kit) -> None:
    kit.legs((0.0, 0.48), 0.05, (0.08, 0.08), STEEL)
    kit.part((-0.5, 0.5), (-0.5, 0.5), (0.48, 0.55), kit.paint())
    kit.part((-0.5, -0.4), (-0.48, 0.48), (0.62, 1.0), kit.paint(1.1))
    for y in (-0.4, 0.36):
        kit.part((-0.48, -0.42), (y, y + 0.05), (0.55, 0.62), STEEL)


def table(kit: Kit) -> None:
    kit.part((-0.5, 0.5), (-0.5, 0.5), (0.94, 1.0), kit.paint())
    kit.legs((0.0, 0.94), 0.04, (0.08, 0.05), kit.paint(0.6))


def sofa(kit: Kit) -> None:
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


def wet_floor_sign(kit: Kit) -> None:
    for side in (1, -1):
        foot, head = 0.5 * side, 0.05 * side
        y = 0.5 * side
        corners = ((foot, -y, 0.0), (foot, y, 0.0), (head, 0.75 * y, 1.0), (head, -0.75 * y, 1.0))
        kit.print(prints.warning_board, *corners)
        kit.face(kit.paint(0.7), *corners[::-1])


def desk(kit: Kit) -> None:
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
    kit.part((-0.25, -0.20), (-0.2, 0.2), (0.70, 1.0), DARK, kit.picture(prints.desktop))
    kit.part((0.05, 0.25), (-0.14, 0.14), (top, top + 0.02), (60, 62, 68))
    kit.part((-0.1, 0.25), (0.26, 0.40), (top, top + 0.012), WHITE)
    kit.post(-0.1, -0.33, (top, top + 0.09), 0.04, (200, 60, 50), 8)


def office_chair(kit: Kit) -> None:
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


def meeting_table(kit: Kit) -> None:
    kit.part((-0.5, 0.5), (-0.42, 0.42), (0.93, 1.0), kit.paint())
    kit.part((-0.36, 0.36), (-0.5, 0.5), (0.93, 1.0), kit.paint())
    for y in (-0.28, 0.28):
        kit.part((-0.08, 0.08), (y - 0.05, y + 0.05), (0.0, 0.93), kit.paint(0.6))
        kit.part((-0.3, 0.3), (y - 0.08, y + 0.08), (0.0, 0.05), kit.paint(0.6))
    for x, y in ((-0.25, -0.2), (0.25, 0.05), (-0.25, 0.25)):
        kit.part((x - 0.1, x + 0.1), (y - 0.04, y + 0.04), (1.0, 1.02), WHITE)


def partition(kit: Kit) -> None:
    kit.part((-0.5, 0.5), (-0.5, 0.5), (0.06, 0.97), kit.paint())
    kit.part((-0.6, 0.6), (-0.5, 0.5), (0.97, 1.0), STEEL)
    for low, high in ((-0.5, -0.48), (0.48, 0.5)):
        kit.part((-0.6, 0.6), (low, high), (0.0, 0.97), STEEL)


def printer(kit: Kit) -> None:
    kit.part((-0.5, 0.45), (-0.5, 0.5), (0.0, 0.86), kit.paint(0.9), kit.picture(prints.printer_front))
    kit.part((-0.5, 0.40), (-0.5, 0.3), (0.88, 1.0), (70, 74, 80))
    kit.part((0.40, 0.5), (0.02, 0.4), (0.80, 0.90), (60, 140, 220))


armchair = sofa
cabinet = plate(textures.cabinet_front)
shelf = plate(prints.books, 0.8)
coffee_machine = plate(prints.coffee_front, 1.0)
refrigerator = plate(prints.fridge_front, 0.9)
