"""Repeating textures of floors, walls and ceilings: one function each, and the size of one repetition.

A floor texture's width runs along the heading of the floor patch that it covers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from sim_hil.world.drawing.textures import Colour, Image, fill, grain, plain


@dataclass(frozen=True)
class Tiling:
    """Texture function of a surface; one repetition covers `width_m` x `height_m` (0: a wall's whole height)."""

    draw: Callable[[], Image]
    width_m: float
    height_m: float


def _grid(colour: Colour, joint: Colour, cells: int, px: int = 192, seed: int = 1, vary: float = 6.0) -> Image:
    image = plain(px, px, joint)
    rng = np.random.default_rng(seed)
    step = px // cells
    for row in range(cells):
        for column in range(cells):
            shade = rng.normal(0, vary)
            slab = tuple(int(min(max(channel + shade, 0), 255)) for channel in colour)
            x, y = column * step, row * step
            cv2.rectangle(image, (x + 1, y + 1), (x + step - 2, y + step - 2), slab, -1)
    return grain(image, seed, 3.0, 8)


def _speckle(colour: Colour, seed: int, strength: float, px: int = 192, cell: int = 2) -> Image:
    return grain(grain(plain(px, px, colour), seed, strength, cell), seed + 1, strength * 0.8, 24)


def _floor_tiles() -> Image:
    image = plain(192, 192, (176, 166, 150))
    for row in range(4):
        for column in range(4):
            shade = (186, 176, 160) if (row + column) % 2 else (158, 148, 134)
            cv2.rectangle(image, (column * 48 + 1, row * 48 + 1), (column * 48 + 46, row * 48 + 46), shade, -1)
    return grain(image, 1, 4.0, 8)


def _vinyl(colour: Colour, seed: int) -> Image:
    image = _speckle(colour, seed, 4.0)
    cv2.line(image, (0, 0), (191, 0), tuple(int(c * 0.86) for c in colour), 2)
    return image


def _carpet_tiles(colour: Colour, seed: int) -> Image:
    """Carpet in tiles laid a quarter turn from each other."""
    image = plain(128, 128, colour)
    rng = np.random.default_rng(seed)
    for row in range(2):
        for column in range(2):
            stripes = np.repeat(rng.normal(0, 9, 16), 4)
            patch = np.tile(stripes[:, None], (1, 64))
            patch = patch if (row + column) % 2 else patch.T
            tone = 7 if (row + column) % 2 else -7
            block = image[row * 64 : row * 64 + 64, column * 64 : column * 64 + 64].astype(float)
            image[row * 64 : row * 64 + 64, column * 64 : column * 64 + 64] = np.clip(
                block + patch[..., None] + tone, 0, 255
            ).astype(np.uint8)
    return image


def _wood() -> Image:
    image = plain(192, 128, (150, 104, 62))
    rng = np.random.default_rng(31)
    for row in range(8):
        shift = int(rng.integers(192))
        for part in range(2):
            tone = 1.0 + rng.normal(0, 0.09)
            colour = tuple(int(min(c * tone, 255)) for c in (158, 110, 66))
            x0 = (shift + part * 96) % 192
            for left in (x0, x0 - 192):
                cv2.rectangle(image, (left + 1, row * 16), (left + 95, row * 16 + 14), colour, -1)
    return grain(image, 32, 4.0, 4)


def _marble() -> Image:
    image = _grid((222, 218, 210), (188, 182, 172), 2, seed=41, vary=4.0)
    rng = np.random.default_rng(42)
    for _ in range(7):
        x, y = (int(v) for v in rng.integers(0, 192, 2))
        dx, dy = (int(v) for v in rng.integers(-60, 60, 2))
        cv2.line(image, (x, y), (x + dx, y + dy), (204, 198, 190), 2, cv2.LINE_AA)
    return image


def _concrete() -> Image:
    image = _speckle((150, 150, 146), 51, 4.0, 256, 4)
    cv2.rectangle(image, (0, 0), (255, 255), (128, 128, 124), 1)
    return image


def _concrete_yellow_line() -> Image:
    """A line along the heading every 4 m, the boundary of a warehouse's lanes."""
    image = _concrete()
    image[0:7] = image[-7:] = (236, 190, 20)
    return image


def _hazard_stripes() -> Image:
    image = plain(128, 128, (244, 196, 16))
    for left in range(-128, 128, 64):
        corners = np.array(((left, 0), (left + 32, 0), (left + 160, 128), (left + 128, 128)), np.int32)
        cv2.fillPoly(image, [corners], (30, 30, 30))
    return image


def _asphalt() -> Image:
    return _speckle((84, 85, 88), 61, 6.0, 192, 2)


def _asphalt_line() -> Image:
    """A dashed line down the middle of 4 m of lane."""
    image = np.asarray(cv2.resize(_asphalt(), (256, 256)), np.uint8)
    fill(image, 0.1, 0.47, 0.6, 0.53, (232, 232, 226))
    return image


def _bricks(
    joint: Colour, colour: Colour, shares: tuple[int, int, int], width: int, height: int, px: int, seed: int
) -> Image:  # fmt: skip
    """Rows of bricks of `width` x `height` pixels, shifted by half a brick; `shares`: divisors of the variation."""
    image = plain(px, px, joint)
    rng = np.random.default_rng(seed)
    for row in range(px // height):
        for column in range(-1, px // width):
            tone = int(rng.normal(0, 12))
            x, y = column * width + (width // 2 if row % 2 else 0), row * height
            shade = tuple(channel + tone // share for channel, share in zip(colour, shares, strict=True))
            cv2.rectangle(image, (x + 1, y + 1), (x + width - 2, y + height - 2), shade, -1)
    return image


def _grass() -> Image:
    return grain(_speckle((88, 138, 58), 81, 13.0, 192, 2), 82, 10.0, 32)


def _soil() -> Image:
    return _speckle((104, 76, 52), 85, 12.0, 128, 3)


def _zebra_crossing() -> Image:
    """Bars across the heading, the direction in which people walk."""
    image = np.asarray(cv2.resize(_asphalt(), (128, 128)), np.uint8)
    fill(image, 0.0, 0.0, 0.5, 1.0, (238, 238, 232))
    return image


def _kerb_stone() -> Image:
    image = _speckle((182, 180, 174), 91, 4.0, 128, 4)
    cv2.line(image, (0, 0), (0, 127), (140, 138, 132), 3)
    return image


def _tactile_paving() -> Image:
    image = plain(128, 128, (226, 182, 50))
    for row in range(8):
        for column in range(8):
            cv2.circle(image, (column * 16 + 8, row * 16 + 8), 5, (196, 150, 30), -1)
    return image


def _metal_plate() -> Image:
    image = plain(128, 128, (112, 116, 120))
    for row in range(8):
        for column in range(8):
            x, y = column * 16, row * 16
            ends = ((x + 3, y + 3), (x + 12, y + 12)) if (row + column) % 2 else ((x + 12, y + 3), (x + 3, y + 12))
            cv2.line(image, *ends, (146, 150, 154), 3)
    return image


def _banded(upper: Colour, lower: Colour, rail: Colour, skirting: Colour, at: float = 0.62) -> Image:
    """A wall painted in two colours with a rail between and a skirting board; at: where, from the top."""
    image = grain(plain(192, 256, upper), 2, 3.0, 16)
    fill(image, 0, at, 1, 1, lower)
    fill(image, 0, at - 0.02, 1, at + 0.02, rail)
    fill(image, 0, 0.95, 1, 1, skirting)
    return image


def _wall_wainscot() -> Image:
    image = _banded((222, 216, 200), (112, 136, 142), (236, 232, 222), (66, 62, 58))
    for panel in (0.04, 0.54):
        fill(image, panel, 0.67, panel + 0.42, 0.91, (96, 120, 127))
    return image


def _wall_hospital() -> Image:
    return _banded((236, 238, 234), (172, 212, 198), (96, 150, 140), (84, 104, 104), 0.66)


def _wall_office() -> Image:
    image = grain(plain(192, 256, (226, 222, 212)), 3, 2.5, 16)
    fill(image, 0, 0.95, 1, 1, (72, 72, 76))
    fill(image, 0, 0.0, 1, 0.03, (206, 202, 192))
    return image


def _wall_glass() -> Image:
    """A glazed partition: panes in dark frames, frosted in the middle."""
    image = plain(192, 256, (176, 204, 214))
    cv2.line(image, (20, 250), (120, 10), (206, 226, 232), 14)
    fill(image, 0, 0.38, 1, 0.56, (222, 232, 234))
    fill(image, 0, 0.95, 1, 1, (62, 66, 72))
    fill(image, 0, 0.0, 1, 0.04, (62, 66, 72))
    for left in (0.0, 0.49):
        fill(image, left, 0, left + 0.03, 1, (62, 66, 72))
    return image


def _wall_warehouse() -> Image:
    image = plain(192, 256, (178, 186, 192))
    for left in range(0, 192, 16):
        image[:, left : left + 5] = (158, 166, 172)
    fill(image, 0, 0.80, 1, 1, (138, 136, 130))
    fill(image, 0, 0.79, 1, 0.81, (214, 170, 30))
    return image


def _wall_concrete() -> Image:
    image = _speckle((168, 166, 160), 7, 4.0, 192, 6)
    for x, y in ((24, 40), (168, 40), (24, 150), (168, 150)):
        cv2.circle(image, (x, y), 3, (120, 118, 112), -1)
    image[:, 0:2] = (140, 138, 132)
    return image


def _wall_plaster() -> Image:
    return grain(plain(128, 128, (228, 208, 172)), 9, 4.0, 16)


def _railing() -> Image:
    image = plain(192, 96, (190, 198, 204))
    for left in range(4, 192, 16):
        image[:, left : left + 5] = (60, 66, 72)
    fill(image, 0, 0, 1, 0.12, (46, 52, 58))
    fill(image, 0, 0.88, 1, 1, (46, 52, 58))
    return image


def _ceiling_panels() -> Image:
    image = plain(64, 64, (226, 228, 228))
    cv2.rectangle(image, (0, 0), (63, 63), (196, 198, 200), 1)
    return image


def _ceiling_steel() -> Image:
    image = plain(128, 128, (150, 156, 162))
    for top in range(0, 128, 8):
        image[top : top + 3] = (132, 138, 144)
    image[:, 0:12] = (92, 98, 106)
    return image


def _ceiling_plaster() -> Image:
    return grain(plain(64, 64, (236, 234, 228)), 11, 2.0, 16)


SURFACES: dict[str, Tiling] = {
    "floor_tiles": Tiling(_floor_tiles, 2.0, 2.0),
    "vinyl": Tiling(lambda: _vinyl((190, 198, 200), 11), 2.0, 2.0),
    "vinyl_green": Tiling(lambda: _vinyl((158, 190, 174), 13), 2.0, 2.0),
    "carpet_tiles": Tiling(lambda: _carpet_tiles((112, 116, 124), 21), 1.0, 1.0),
    "carpet_blue": Tiling(lambda: _carpet_tiles((58, 82, 122), 23), 1.0, 1.0),
    "wood": Tiling(_wood, 2.4, 1.2),
    "marble": Tiling(_marble, 2.4, 2.4),
    "concrete": Tiling(_concrete, 4.0, 4.0),
    "concrete_yellow_line": Tiling(_concrete_yellow_line, 4.0, 4.0),
    "hazard_stripes": Tiling(_hazard_stripes, 1.0, 1.0),
    "asphalt": Tiling(_asphalt, 3.0, 3.0),
    "asphalt_line": Tiling(_asphalt_line, 4.0, 4.0),
    "paving": Tiling(lambda: _grid((164, 160, 152), (126, 122, 116), 4, seed=101, vary=8.0), 2.4, 2.4),
    "paving_light": Tiling(lambda: _grid((206, 200, 188), (170, 164, 152), 3, seed=103, vary=6.0), 2.4, 2.4),
    "cobbles": Tiling(lambda: _bricks((92, 86, 80), (140, 130, 120), (1, 1, 1), 16, 16, 160, 71), 1.5, 1.5),
    "grass": Tiling(_grass, 3.0, 3.0),
    "soil": Tiling(_soil, 2.0, 2.0),
    "zebra_crossing": Tiling(_zebra_crossing, 1.0, 4.0),
    "kerb_stone": Tiling(_kerb_stone, 1.0, 1.0),
    "tactile_paving": Tiling(_tactile_paving, 0.8, 0.8),
    "metal_plate": Tiling(_metal_plate, 1.0, 1.0),
    "wall_wainscot": Tiling(_wall_wainscot, 2.0, 0.0),
    "wall_hospital": Tiling(_wall_hospital, 2.0, 0.0),
    "wall_office": Tiling(_wall_office, 2.0, 0.0),
    "wall_glass": Tiling(_wall_glass, 2.4, 0.0),
    "wall_warehouse": Tiling(_wall_warehouse, 3.0, 0.0),
    "wall_brick": Tiling(lambda: _bricks((196, 186, 176), (164, 84, 64), (1, 2, 2), 32, 12, 192, 5), 1.6, 1.6),
    "wall_concrete": Tiling(_wall_concrete, 2.4, 2.4),
    "wall_plaster": Tiling(_wall_plaster, 2.0, 2.0),
    "railing": Tiling(_railing, 2.0, 0.0),
    "ceiling_panels": Tiling(_ceiling_panels, 1.2, 1.2),
    "ceiling_steel": Tiling(_ceiling_steel, 3.0, 3.0),
    "ceiling_plaster": Tiling(_ceiling_plaster, 2.0, 2.0),
}


@cache
def surface_picture(name: str) -> Image:
    """Return the image of a texture (cached, read-only). Raises KeyError."""
    return SURFACES[name].draw()
