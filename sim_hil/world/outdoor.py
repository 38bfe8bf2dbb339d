"""Meshes of outdoor objects in streets and squares: every function builds the kind of object of its name."""

from __future__ import annotations

from math import cos, pi, sin

from sim_hil.world.drawing import prints
from sim_hil.world.drawing.kit import BLACK, DARK, STEEL, WHITE, WOOD, Kit
from sim_hil.world.drawing.mesh import Vec3
from sim_hil.world.drawing.textures import Colour

_STONE: Colour = (188, 184, 174)
_WATER: Colour = (70, 150, 205)
_BARK: Colour = (104, 74, 48)


def fountain(kit: Kit) -> None:
    """A basin of stone, a bowl on a pedestal, and the water's jet."""
    rim = 0.42 / kit.height
    kit.rings(((0.0, 0.5), (rim, 0.5)), kit.paint(), 16)
    kit.rings(((rim, 0.5), (rim * 1.12, 0.49)), kit.paint(1.15), 16)
    kit.rings(((rim * 1.13, 0.42), (rim * 1.14, 0.42)), _WATER, 16)
    kit.rings(((rim, 0.10), (0.50, 0.06)), kit.paint(0.9), 8)
    kit.rings(((0.48, 0.08), (0.58, 0.24)), kit.paint(1.05), 12)
    kit.rings(((0.575, 0.21), (0.585, 0.21)), _WATER, 12)
    kit.rings(((0.58, 0.03), (0.84, 0.05), (0.94, 0.10), (1.0, 0.03)), (150, 208, 240), 8)
    for k in range(8):
        turn = 2 * pi * (k + 0.5) / 8
        x, y = 0.20 * cos(turn), 0.20 * sin(turn)
        kit.post(x, y, (rim * 1.1, 0.60), 0.055, (120, 190, 232), 4)


def _canopy(kit: Kit) -> None:
    """Eight panels of cloth in two colours, with a valance, seen from above and below."""
    top, edge, hem = (0.0, 0.0, 1.0), 0.80, 0.74
    ring = [(0.5 * cos(2 * pi * k / 8), 0.5 * sin(2 * pi * k / 8)) for k in range(9)]
    for k in range(8):
        (ax, ay), (bx, by) = ring[k], ring[k + 1]
        colour: Colour = kit.paint() if k % 2 == 0 else WHITE
        shade: Colour = (round(colour[0] * 0.72), round(colour[1] * 0.72), round(colour[2] * 0.72))
        kit.both(colour, shade, (ax, ay, edge), (bx, by, edge), top)
        kit.both(colour, shade, (ax, ay, hem), (bx, by, hem), (bx, by, edge), (ax, ay, edge))


def umbrella(kit: Kit) -> None:
    kit.part((-0.1, 0.1), (-0.1, 0.1), (0.0, 0.04), (96, 98, 100))
    kit.post(0, 0, (0.04, 0.98), 0.03, WHITE)
    _canopy(kit)


def umbrella_table(kit: Kit) -> None:
    umbrella(kit)
    kit.rings(((0.275, 0.18), (0.30, 0.18)), (236, 232, 222), 14)
    for k in range(3):
        turn = 2 * pi * k / 3
        kit.post(0.1 * cos(turn), 0.1 * sin(turn), (0.0, 0.275), 0.025, DARK, 5)


def _awning_on(kit: Kit, x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> None:
    """Striped cloth that falls from (x[0], z[1]) at the wall to (x[1], z[0])."""
    stripes = max(round((y[1] - y[0]) * kit.width / 0.4), 3)
    step = (y[1] - y[0]) / stripes
    drop = 0.18 / kit.height
    for k in range(stripes):
        a, b = y[0] + k * step, y[0] + (k + 1) * step
        colour: Colour = kit.paint() if k % 2 == 0 else WHITE
        shade: Colour = (round(colour[0] * 0.7), round(colour[1] * 0.7), round(colour[2] * 0.7))
        kit.both(colour, shade, (x[1], a, z[0]), (x[1], b, z[0]), (x[0], b, z[1]), (x[0], a, z[1]))
        kit.both(colour, shade, (x[1], a, z[0] - drop), (x[1], b, z[0] - drop), (x[1], b, z[0]), (x[1], a, z[0]))


def storefront(kit: Kit) -> None:
    kit.whole(kit.paint(0.6), kit.picture(prints.storefront_face))
    reach = 0.5 + 1.0 / kit.depth
    _awning_on(kit, (0.5, reach), (-0.47, 0.47), (0.56, 0.69))


def building(kit: Kit) -> None:
    front, side = kit.picture(prints.facade_front), kit.picture(prints.facade_side)
    kit.whole(kit.paint(0.7), front, side, kit.picture(prints.facade))
    ledge = 0.3 / kit.height
    kit.part((-0.51, 0.51), (-0.505, 0.505), (1.0 - ledge, 1.0), kit.paint(0.55))


def kiosk(kit: Kit) -> None:
    kit.part((-0.5, 0.42), (-0.5, 0.5), (0.0, 0.94), kit.paint(0.8), kit.picture(prints.kiosk_face))
    kit.part((0.42, 0.56), (-0.46, 0.46), (0.34, 0.38), (226, 214, 190))
    kit.part((-0.56, 0.5), (-0.54, 0.54), (0.94, 1.0), kit.paint(0.5))
    _awning_on(kit, (0.42, 0.66), (-0.5, 0.5), (0.66, 0.72))


def park_bench(kit: Kit) -> None:
    for row in range(3):
        low = -0.28 + 0.25 * row
        kit.part((low, low + 0.2), (-0.5, 0.5), (0.46, 0.51), kit.paint())
    for row in range(3):
        low = 0.62 + 0.13 * row
        kit.part((-0.46, -0.40), (-0.5, 0.5), (low, low + 0.10), kit.paint(1.1))
    for y in (-0.44, 0.40):
        kit.part((-0.46, 0.44), (y, y + 0.04), (0.38, 0.46), BLACK)
        kit.part((-0.50, -0.42), (y, y + 0.04), (0.0, 1.0), BLACK)
        kit.part((0.36, 0.44), (y, y + 0.04), (0.0, 0.66), BLACK)


def lamp_post(kit: Kit) -> None:
    kit.post(0, 0, (0.0, 0.14), 0.11, kit.paint(), 8)
    kit.post(0, 0, (0.14, 0.84), 0.055, kit.paint(), 6)
    kit.rings(((0.84, 0.10), (0.86, 0.22)), kit.paint(), 8)
    kit.rings(((0.86, 0.18), (0.95, 0.26)), (255, 246, 206), 8)
    kit.rings(((0.95, 0.34), (1.0, 0.06)), kit.paint(), 8)


def tree(kit: Kit) -> None:
    kit.post(0, 0, (0.0, 0.55), 0.05 * kit.depth, _BARK, 7)
    rng = kit.rng()
    kit.ball(0, 0, 0.74, (0.42 * kit.depth, 0.42 * kit.width, 0.25 * kit.height), kit.paint(), 8)
    for k in range(5):
        turn = 2 * pi * k / 5 + rng.random()
        size = 0.26 + 0.06 * rng.random()
        radii = (size * kit.depth, size * kit.width, 0.17 * kit.height)
        z = 0.58 + 0.20 * rng.random()
        kit.ball(0.26 * cos(turn), 0.26 * sin(turn), z, radii, kit.paint(0.8 + 0.5 * rng.random()), 6, 5)


def hedge(kit: Kit) -> None:
    green = kit.picture(prints.leaves)
    kit.whole(kit.paint(), green, green, green, green)


def planter(kit: Kit) -> None:
    kit.part((-0.5, 0.5), (-0.5, 0.5), (0.0, 0.55), kit.paint())
    kit.part((-0.44, 0.44), (-0.46, 0.46), (0.55, 0.60), (92, 66, 44))
    rng = kit.rng()
    blooms: tuple[Colour, ...] = ((226, 60, 80), (246, 200, 60), (240, 240, 240), (180, 90, 190))
    count = max(round(kit.width / 0.3), 2)
    for k in range(count):
        y = -0.42 + 0.84 * k / (count - 1)
        kit.ball(0.0, y, 0.70, (0.34 * kit.depth, 0.16, 0.14), (70, 130, 60), 6, 4)
        for _ in range(2):
            x = 0.5 * rng.random() - 0.25
            kit.ball(x, y, 0.84 + 0.1 * rng.random(), (0.07, 0.07, 0.06), blooms[int(rng.integers(4))], 4, 3)


def bollard(kit: Kit) -> None:
    for z, z1, colour in ((0.0, 0.70, kit.paint()), (0.70, 0.84, (236, 228, 90)), (0.84, 0.94, kit.paint())):
        kit.rings(((z, 0.42), (z1, 0.42)), colour, 10)
    kit.rings(((0.94, 0.42), (1.0, 0.2)), kit.paint(1.2), 10)


def car(kit: Kit) -> None:
    """Body with bonnet and boot, a cabin of glass, lamps, plates, wheels; the front is the bonnet."""
    body, glass = kit.paint(), (52, 66, 78)
    kit.part((-0.49, 0.49), (-0.46, 0.46), (0.16, 0.42), body)
    kit.part((-0.5, 0.44), (-0.5, 0.5), (0.28, 0.60), body)
    kit.face(body, (0.44, -0.5, 0.60), (0.5, -0.46, 0.44), (0.5, 0.46, 0.44), (0.44, 0.5, 0.60))
    low, high = ((-0.42, 0.26, 0.45), 0.60), ((-0.32, 0.10, 0.36), 0.97)
    (a, b, w), z0 = low
    (c, d, v), z1 = high
    kit.face(glass, (b, -w, z0), (b, w, z0), (d, v, z1), (d, -v, z1))
    kit.face(glass, (a, w, z0), (a, -w, z0), (c, -v, z1), (c, v, z1))
    kit.face(glass, (b, w, z0), (a, w, z0), (c, v, z1), (d, v, z1))
    kit.face(glass, (a, -w, z0), (b, -w, z0), (d, -v, z1), (c, -v, z1))
    kit.part((c, d), (-v, v), (0.95, 1.0), body)
    for y in (-0.46, 0.44):
        kit.part((-0.10, -0.07), (y, y + 0.02), (0.58, 0.96), body)
    for y in (-0.42, 0.26):
        kit.part((0.49, 0.505), (y, y + 0.16), (0.36, 0.43), (255, 246, 200))
        kit.part((-0.505, -0.49), (y, y + 0.16), (0.42, 0.52), (206, 30, 30))
    kit.part((0.49, 0.505), (-0.14, 0.14), (0.24, 0.32), WHITE)
    kit.part((-0.505, -0.49), (-0.14, 0.14), (0.30, 0.38), WHITE)
    kit.part((-0.505, 0.505), (-0.48, 0.48), (0.14, 0.20), (40, 42, 46))
    for x in (-0.31, 0.31):
        for y in (-0.46, 0.46):
            kit.wheel(x, y, 0.31, 0.18)
            kit.wheel(x, y * 1.02, 0.18, 0.17, (190, 194, 198), 0.13)


def mailbox(kit: Kit) -> None:
    kit.legs((0.0, 0.25), 0.06, (0.1, 0.1), DARK)
    kit.part((-0.5, 0.5), (-0.5, 0.5), (0.25, 0.88), kit.paint(0.9), kit.picture(prints.mail_front))
    kit.part((-0.36, 0.36), (-0.5, 0.5), (0.88, 1.0), kit.paint())


def bus_stop(kit: Kit) -> None:
    pane = kit.picture(prints.timetable)
    kit.part((-0.5, -0.46), (-0.46, 0.46), (0.08, 0.88), STEEL, pane, back=pane)
    kit.part((-0.46, 0.40), (0.475, 0.495), (0.08, 0.88), (186, 214, 222))
    for y in (-0.47, 0.47):
        kit.part((-0.5, -0.46), (y - 0.01, y + 0.01), (0.0, 0.94), kit.paint())
        kit.part((0.36, 0.40), (y - 0.01, y + 0.01), (0.0, 0.94), kit.paint())
    kit.part((-0.5, 0.5), (-0.5, 0.5), (0.94, 1.0), kit.paint())
    kit.part((-0.42, 0.0), (-0.35, 0.35), (0.17, 0.20), WOOD)
    for y in (-0.3, 0.28):
        kit.part((-0.26, -0.2), (y, y + 0.02), (0.0, 0.17), DARK)
    sign = kit.picture(prints.bus_plate)
    kit.part((0.38, 0.46), (-0.5, -0.36), (0.72, 0.94), kit.paint(), sign, sign, sign)


def statue(kit: Kit) -> None:
    """A figure with a raised arm on a pedestal of stone."""
    kit.part((-0.5, 0.5), (-0.5, 0.5), (0.0, 0.08), _STONE)
    kit.part((-0.36, 0.36), (-0.36, 0.36), (0.08, 0.40), (206, 202, 192), kit.picture(prints.plate))
    kit.part((-0.42, 0.42), (-0.42, 0.42), (0.40, 0.43), _STONE)
    bronze = kit.paint()
    for y in (-0.09, 0.09):
        kit.post(0, y, (0.43, 0.66), 0.09, bronze, 7)
    kit.rings(((0.64, 0.16), (0.74, 0.14), (0.84, 0.20), (0.87, 0.08)), bronze, 8)
    kit.ball(0.02, 0, 0.915, (0.11, 0.10, 0.14), bronze)
    points: tuple[tuple[Vec3, Vec3], ...] = (
        ((0.0, 0.2, 0.84), (0.28, 0.26, 0.99)),
        ((0.06, -0.24, 0.64), (0.0, -0.2, 0.84)),
    )
    for start, end in points:
        low, high = (start, end) if start[2] < end[2] else (end, start)
        kit.mesh.prism(kit.frame, ((kit.at(*low), 0.055, 0.055), (kit.at(*high), 0.05, 0.05)), bronze, 6)


def sign_post(kit: Kit) -> None:
    kit.post(0, 0, (0.0, 0.98), 0.035, STEEL)
    board = kit.picture(prints.plate)
    kit.part((-0.1, 0.12), (-0.5, 0.5), (0.74, 0.98), STEEL, board, back=board)


def bicycle_rack(kit: Kit) -> None:
    for k in range(4):
        y = -0.42 + 0.28 * k
        for x in (-0.18, 0.18):
            kit.part((x - 0.015, x + 0.015), (y - 0.012, y + 0.012), (0.0, 0.72), STEEL)
        kit.part((-0.19, 0.19), (y - 0.012, y + 0.012), (0.70, 0.74), STEEL)
    frames: tuple[Colour, ...] = (kit.paint(), (200, 60, 50), (60, 60, 66))
    for k, y in enumerate((-0.34, -0.06, 0.22)):
        colour = frames[k]
        for x in (-0.31, 0.31):
            kit.wheel(x, y, 0.33, 0.03)
            kit.wheel(x, y, 0.27, 0.035, (196, 198, 200), 0.06)
        kit.part((-0.29, 0.22), (y - 0.01, y + 0.01), (0.55, 0.60), colour)
        kit.mesh.prism(
            kit.frame, ((kit.at(-0.02, y, 0.30), 0.02, 0.02), (kit.at(0.26, y, 0.86), 0.02, 0.02)), colour, 5
        )
        kit.mesh.prism(
            kit.frame, ((kit.at(-0.02, y, 0.30), 0.02, 0.02), (kit.at(-0.14, y, 0.82), 0.02, 0.02)), colour, 5
        )
        kit.part((-0.22, -0.08), (y - 0.04, y + 0.04), (0.82, 0.88), BLACK)
        kit.part((0.24, 0.28), (y - 0.13, y + 0.13), (0.90, 0.94), BLACK)


def awning(kit: Kit) -> None:
    _awning_on(kit, (-0.5, 0.5), (-0.5, 0.5), (0.2, 1.0))
