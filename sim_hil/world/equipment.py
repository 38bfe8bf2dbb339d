"""Meshes of hospital and warehouse objects: every function builds the kind of object of its name."""

from __future__ import annotations

from sim_hil.world.drawing import prints
from sim_hil.world.drawing.kit import BLACK, CARTON, DARK, STEEL, WHITE, WOOD, Kit
from sim_hil.world.drawing.textures import Colour

_RACK_BLUE = (36, 70, 140)


def hospital_bed(kit: Kit) -> None:
    """The head is at the back, so that the front is the foot end."""
    kit.part((-0.44, 0.44), (-0.4, 0.4), (0.22, 0.34), STEEL)
    kit.part((-0.47, 0.47), (-0.46, 0.46), (0.40, 0.60), WHITE)
    kit.part((-0.12, 0.475), (-0.48, 0.48), (0.42, 0.63), (70, 170, 190))
    kit.part((-0.45, -0.28), (-0.34, 0.34), (0.60, 0.70), (250, 250, 250))
    kit.part((-0.5, -0.47), (-0.48, 0.48), (0.30, 1.0), (52, 110, 170))
    kit.part((0.47, 0.5), (-0.48, 0.48), (0.30, 0.50), (52, 110, 170))
    kit.part((0.48, 0.505), (-0.2, 0.2), (0.34, 0.46), WHITE)
    for y in (-0.5, 0.47):
        for z in (0.66, 0.76):
            kit.part((-0.38, 0.12), (y, y + 0.03), (z, z + 0.035), (200, 206, 210))
        for x in (-0.36, -0.13, 0.10):
            kit.part((x - 0.01, x + 0.01), (y, y + 0.03), (0.5, 0.78), (200, 206, 210))
    for x in (-0.38, 0.38):
        for y in (-0.36, 0.36):
            kit.wheel(x, y, 0.07, 0.05)
            kit.part((x - 0.015, x + 0.015), (y - 0.03, y + 0.03), (0.13, 0.24), STEEL)


def wheelchair(kit: Kit) -> None:
    for y in (-0.44, 0.44):
        kit.wheel(-0.16, y, 0.31, 0.035)
        kit.wheel(-0.16, y * 1.03, 0.25, 0.03, (196, 200, 204), 0.06)
        kit.wheel(0.28, y * 0.8, 0.08, 0.03)
        kit.part((-0.22, 0.14), (y * 0.8 - 0.03, y * 0.8 + 0.03), (0.72, 0.76), BLACK)
        kit.part((0.24, 0.28), (y * 0.7 - 0.02, y * 0.7 + 0.02), (0.15, 0.55), STEEL)
        kit.part((-0.42, -0.26), (y * 0.8 - 0.02, y * 0.8 + 0.02), (0.94, 0.98), BLACK)
    kit.part((-0.26, 0.24), (-0.38, 0.38), (0.50, 0.57), kit.paint())
    kit.part((-0.30, -0.25), (-0.38, 0.38), (0.55, 0.96), kit.paint(1.2))
    kit.part((0.34, 0.5), (-0.34, 0.34), (0.12, 0.15), DARK)


def medical_cart(kit: Kit) -> None:
    kit.part((-0.45, 0.45), (-0.45, 0.45), (0.12, 0.86), kit.paint(0.9), kit.picture(prints.drawers))
    kit.part((-0.5, 0.5), (-0.5, 0.5), (0.86, 0.90), WHITE)
    kit.part((-0.3, 0.1), (-0.35, -0.05), (0.90, 1.0), (220, 60, 50))
    kit.part((-0.2, 0.2), (0.1, 0.36), (0.90, 0.96), (230, 200, 90))
    kit.part((-0.1, 0.1), (0.5, 0.58), (0.74, 0.78), STEEL)
    for x in (-0.36, 0.36):
        for y in (-0.38, 0.38):
            kit.wheel(x, y, 0.06, 0.03)


def iv_stand(kit: Kit) -> None:
    for x, y in ((0.48, 0.07), (0.07, 0.48)):
        kit.part((-x, x), (-y, y), (0.03, 0.055), STEEL)
    for x, y in ((0.45, 0.0), (-0.45, 0.0), (0.0, 0.45), (0.0, -0.45)):
        kit.wheel(x, y, 0.03, 0.025)
    kit.post(0, 0, (0.05, 0.98), 0.016, (206, 210, 214))
    kit.part((-0.03, 0.03), (-0.3, 0.3), (0.965, 0.985), (206, 210, 214))
    kit.part((-0.06, 0.06), (0.14, 0.40), (0.74, 0.95), (150, 214, 236))
    kit.part((-0.06, 0.06), (-0.38, -0.16), (0.78, 0.95), (244, 232, 150))
    kit.part((-0.02, 0.1), (-0.14, 0.14), (0.52, 0.66), (60, 110, 180))


def medical_monitor(kit: Kit) -> None:
    for x, y in ((0.46, 0.08), (0.08, 0.46)):
        kit.part((-x, x), (-y, y), (0.03, 0.06), DARK)
    for x, y in ((0.42, 0.0), (-0.42, 0.0), (0.0, 0.42), (0.0, -0.42)):
        kit.wheel(x, y, 0.03, 0.025)
    kit.post(0, 0, (0.06, 0.72), 0.025, STEEL)
    kit.part((-0.3, 0.3), (-0.4, 0.4), (0.42, 0.47), kit.paint(0.8))
    kit.part((-0.2, 0.25), (-0.5, 0.5), (0.72, 1.0), kit.paint(0.9), kit.picture(prints.heartbeat))


def privacy_screen(kit: Kit) -> None:
    cloth = kit.picture(prints.curtain)
    kit.part((-0.3, 0.3), (-0.5, 0.5), (0.10, 1.0), WHITE, cloth, back=cloth)
    for y in (-0.47, 0.0, 0.47):
        kit.part((-1.1, 1.1), (y - 0.01, y + 0.01), (0.0, 0.03), STEEL)
        kit.part((-0.3, 0.3), (y - 0.01, y + 0.01), (0.0, 0.10), STEEL)


def _pallet_base(kit: Kit, x: tuple[float, float], y: tuple[float, float], z: float, high: float) -> None:
    """Three runners under a deck; `z` is its underside."""
    wide = y[1] - y[0]
    kit.part(x, y, (z + 0.7 * high, z + high), WOOD)
    for share in (0.0, 0.43, 0.86):
        kit.part(x, (y[0] + share * wide, y[0] + (share + 0.14) * wide), (z, z + 0.7 * high), (128, 88, 50))


def storage_rack(kit: Kit) -> None:
    """Uprights, beams in the rack's colour, pallets of boxes on each level, its number at both ends."""
    rng = kit.rng()
    levels = max(round(kit.height / 1.2), 2)
    step = 1.0 / levels
    beam, post = 0.09 / kit.height, 0.045 / kit.width
    bays = max(round(kit.width / 2.8), 1)
    for bay in range(bays + 1):
        y = -0.5 + post + bay * (1 - 2 * post) / bays
        for x in (-0.46, 0.46):
            kit.part((x - 0.04, x + 0.04), (y - post, y + post), (0.0, 1.0), _RACK_BLUE)
        kit.part((-0.46, 0.46), (y - post / 3, y + post / 3), (0.45, 0.48), _RACK_BLUE)
    box = kit.picture(prints.carton)
    for level in range(levels):
        z = level * step
        if level:
            for x in (-0.48, 0.48):
                kit.part((x - 0.03, x + 0.03), (-0.5, 0.5), (z - beam, z), kit.paint())
        for slot in range(2 * bays):
            wide = 1.0 / (2 * bays)
            low = -0.5 + slot * wide + 0.06 * wide
            high = low + 0.88 * wide
            lift = z + 0.11 / kit.height
            kit.part((-0.42, 0.42), (low, high), (z, lift), (150, 110, 66))
            if rng.random() < 0.12:
                continue
            tall = (0.45 + 0.35 * rng.random()) * step
            if rng.random() < 0.7:
                tone = 0.85 + 0.25 * rng.random()
                tint = _carton(tone)
                middle = (low + high) / 2
                kit.part((-0.40, 0.40), (low + 0.01 * wide, middle), (lift, lift + tall), tint, box, back=box)
                tall *= 0.75 + 0.25 * rng.random()
                kit.part((-0.40, 0.40), (middle, high), (lift, lift + tall), tint, box, back=box)
            else:
                tints = ((60, 110, 170), (196, 200, 204), (170, 60, 50), (70, 140, 90))
                kit.part((-0.40, 0.40), (low, high), (lift, lift + tall), tints[int(rng.integers(4))])
    if kit.thing.text:
        plate = kit.picture(prints.aisle_plate)
        half, side = 0.4 / kit.height, 0.012 / kit.width
        z = min(2.0 / kit.height, 0.85)
        for low, high in ((-0.5 - 2 * side, -0.5), (0.5, 0.5 + 2 * side)):
            kit.part((-0.36, 0.36), (low, high), (z - half, z + half), DARK, sides=plate)


def pallet(kit: Kit) -> None:
    base = min(0.15 / kit.height, 0.4)
    _pallet_base(kit, (-0.5, 0.5), (-0.5, 0.5), 0.0, base)
    boxes = kit.picture(prints.cartons)
    kit.part((-0.46, 0.46), (-0.46, 0.46), (base, 1.0), CARTON, boxes, boxes, boxes)


def empty_pallet(kit: Kit) -> None:
    _pallet_base(kit, (-0.5, 0.5), (-0.5, 0.5), 0.0, 0.7)
    for row in range(5):
        low = -0.5 + row * 0.22
        kit.part((low, low + 0.13), (-0.5, 0.5), (0.7, 1.0), WOOD)


def _carton(brightness: float) -> Colour:
    red, green, blue = (min(int(channel * brightness), 255) for channel in CARTON)
    return red, green, blue


def box_stack(kit: Kit) -> None:
    box = kit.picture(prints.carton)
    spots = (((-0.5, 0.5), (-0.5, 0.0), (0.0, 0.42)), ((-0.45, 0.5), (0.04, 0.5), (0.0, 0.36)),
             ((-0.4, 0.4), (-0.34, 0.2), (0.42, 0.76)), ((-0.3, 0.3), (-0.2, 0.12), (0.76, 1.0)))  # fmt: skip
    for index, (x, y, z) in enumerate(spots):
        kit.part(x, y, z, _carton(0.9 + 0.07 * index), box, box, box)


def forklift(kit: Kit) -> None:
    yellow, dark = kit.paint(), (52, 54, 58)
    kit.part((-0.5, -0.34), (-0.46, 0.46), (0.14, 0.56), dark)
    kit.part((-0.38, 0.10), (-0.44, 0.44), (0.14, 0.34), yellow)
    kit.part((-0.34, -0.12), (-0.44, 0.44), (0.34, 0.52), yellow)
    kit.part((-0.10, 0.0), (-0.22, 0.22), (0.36, 0.44), BLACK)
    kit.part((-0.14, -0.10), (-0.22, 0.22), (0.36, 0.66), BLACK)
    kit.part((0.06, 0.09), (-0.12, 0.12), (0.34, 0.52), BLACK)
    for y in (-0.42, 0.38):
        kit.part((-0.34, -0.31), (y, y + 0.04), (0.50, 0.98), dark)
        kit.part((0.07, 0.10), (y, y + 0.04), (0.30, 0.98), dark)
    kit.part((-0.36, 0.12), (-0.44, 0.44), (0.96, 1.0), dark)
    for y in (-0.32, 0.22):
        kit.part((0.13, 0.17), (y, y + 0.1), (0.03, 1.0), (84, 88, 94))
    kit.part((0.13, 0.17), (-0.32, 0.32), (0.93, 0.97), (84, 88, 94))
    kit.part((0.17, 0.19), (-0.38, 0.38), (0.05, 0.28), dark)
    for y in (-0.30, 0.16):
        kit.part((0.18, 0.5), (y, y + 0.14), (0.015, 0.045), STEEL)
    for x, radius in ((-0.34, 0.26), (0.06, 0.32)):
        for y in (-0.42, 0.42):
            kit.wheel(x, y, radius, 0.2)
            kit.wheel(x, y * 1.02, radius * 0.5, 0.2, yellow, radius * 0.5)


def pallet_jack(kit: Kit) -> None:
    red = kit.paint()
    kit.part((-0.42, -0.26), (-0.4, 0.4), (0.06, 0.34), red)
    for y in (-0.45, 0.2):
        kit.part((-0.28, 0.5), (y, y + 0.25), (0.04, 0.08), red)
    kit.wheel(-0.36, -0.15, 0.09, 0.06)
    kit.wheel(-0.36, 0.15, 0.09, 0.06)
    kit.part((-0.42, -0.39), (-0.05, 0.05), (0.34, 0.90), DARK)
    kit.part((-0.44, -0.38), (-0.3, 0.3), (0.90, 0.97), BLACK)


def traffic_cone(kit: Kit) -> None:
    orange = kit.paint()
    kit.part((-0.5, 0.5), (-0.5, 0.5), (0.0, 0.06), kit.paint(0.8))
    bands = ((0.06, 0.37, orange), (0.36, 0.27, WHITE), (0.56, 0.20, orange), (0.70, 0.15, WHITE), (0.84, 0.10, orange))
    tops = (*bands[1:], (1.0, 0.05, orange))
    for (z, r, colour), (z1, r1, _) in zip(bands, tops, strict=True):
        kit.rings(((z, r), (z1, r1)), colour, 10)


def drum(kit: Kit) -> None:
    kit.rings(((0.0, 0.48), (0.32, 0.48)), kit.paint(), 14)
    kit.rings(((0.32, 0.5), (0.36, 0.5)), kit.paint(0.7), 14)
    kit.rings(((0.36, 0.48), (0.64, 0.48)), kit.paint(), 14)
    kit.rings(((0.64, 0.5), (0.68, 0.5)), kit.paint(0.7), 14)
    kit.rings(((0.68, 0.48), (0.98, 0.48)), kit.paint(), 14)
    kit.rings(((0.98, 0.44), (1.0, 0.44)), kit.paint(1.3), 14)


def barrier(kit: Kit) -> None:
    stripes = kit.picture(prints.red_white)
    for low, high in ((0.40, 0.60), (0.74, 0.96)):
        kit.part((-0.08, 0.08), (-0.5, 0.5), (low, high), WHITE, stripes, back=stripes)
    for y in (-0.42, 0.36):
        kit.part((-0.06, 0.06), (y, y + 0.06), (0.04, 1.0), DARK)
        kit.part((-0.5, 0.5), (y, y + 0.06), (0.0, 0.05), DARK)
