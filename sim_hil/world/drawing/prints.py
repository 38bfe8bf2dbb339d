"""Prints on objects: fronts, screens, signs and facades, as functions of an object's size, colour and text."""

from __future__ import annotations

import cv2
import numpy as np

from sim_hil.scene.scene import SceneObject
from sim_hil.world.drawing.textures import DARK, WHITE, Colour, Image, canvas, fill, front, grain, plain, rgb, write

_GOODS: tuple[Colour, ...] = (
    (200, 60, 50), (50, 110, 190), (236, 190, 60), (70, 150, 90), (230, 230, 224), (220, 120, 50), (130, 80, 160),
    (60, 60, 66),
)  # fmt: skip


def reception_front(thing: SceneObject) -> Image:
    """Panels of wood and a white band with RECEPTION, or the object's own text."""
    image = front(thing, 0.9)
    for index in range(8):
        fill(image, index / 8 + 0.004, 0, (index + 1) / 8 - 0.004, 1, rgb(thing.colour, 1.0 if index % 2 else 1.12))
    fill(image, 0.14, 0.24, 0.86, 0.72, WHITE)
    write(image, thing.text or "RECEPTION", 0.16, 0.28, 0.84, 0.68, (20, 70, 130))
    fill(image, 0, 0.92, 1, 1, DARK)
    return image


def books(thing: SceneObject) -> Image:
    """Five rows of books in all colours."""
    image = front(thing, 0.5)
    rng = np.random.default_rng(17)
    for row in range(5):
        top, left = 0.03 + row * 0.195, 0.04
        while left < 0.93:
            wide, tall = 0.02 + 0.03 * rng.random(), 0.11 + 0.055 * rng.random()
            colour = _GOODS[int(rng.integers(len(_GOODS)))]
            fill(image, left, top + 0.17 - tall, min(left + wide, 0.96), top + 0.17, colour)
            left += wide + 0.003
        fill(image, 0, top + 0.17, 1, top + 0.195, rgb(thing.colour, 1.1))
    return image


def warning_board(thing: SceneObject) -> Image:
    """Yellow board: a warning triangle over CAUTION WET FLOOR."""
    image = plain(96, 176, rgb(thing.colour))
    corners = np.array(((48, 14), (84, 80), (12, 80)), np.int32)
    cv2.fillPoly(image, [corners], DARK)
    cv2.fillPoly(image, [np.array(((48, 30), (72, 73), (24, 73)), np.int32)], rgb(thing.colour))
    fill(image, 0.47, 0.22, 0.54, 0.35, DARK)
    fill(image, 0.47, 0.37, 0.54, 0.40, DARK)
    for index, word in enumerate((thing.text or "CAUTION WET FLOOR").split()[:3]):
        write(image, word, 0.05, 0.52 + 0.14 * index, 0.95, 0.64 + 0.14 * index, (180, 20, 20))
    return image


def drawers(thing: SceneObject) -> Image:
    """A cart's drawers, the top one red, with a white cross."""
    image = front(thing)
    tones = ((206, 40, 40), (236, 236, 232), (236, 236, 232), (230, 190, 60))
    for index, tone in enumerate(tones):
        top = 0.08 + index * 0.22
        fill(image, 0.06, top, 0.94, top + 0.19, tone)
        fill(image, 0.35, top + 0.07, 0.65, top + 0.10, DARK)
    fill(image, 0.76, 0.10, 0.80, 0.25, WHITE)
    fill(image, 0.70, 0.155, 0.86, 0.195, WHITE)
    return image


def heartbeat(thing: SceneObject) -> Image:
    """A patient monitor's screen: green and yellow curves on black."""
    image = plain(128, 96, (10, 14, 18))
    for base, colour in ((30, (60, 230, 90)), (60, (240, 220, 60)), (84, (70, 180, 240))):
        xs = np.arange(0, 128, 2)
        ys = base - 16 * np.exp(-(((xs % 40) - 18) ** 2) / 9.0) + 6 * np.exp(-(((xs % 40) - 24) ** 2) / 9.0)
        cv2.polylines(image, [np.stack((xs, ys.astype(int)), 1).astype(np.int32)], False, colour, 3)
    fill(image, 0.75, 0.06, 0.97, 0.94, (24, 32, 40))
    write(image, "72", 0.76, 0.10, 0.96, 0.40, (60, 230, 90))
    write(image, "98", 0.76, 0.52, 0.96, 0.84, (70, 180, 240))
    return image


def curtain(thing: SceneObject) -> Image:
    """Folds of cloth in a white frame."""
    image = front(thing)
    width = image.shape[1]
    folds = (np.sin(np.arange(width) / width * 2 * np.pi * 12) * 16)[None, :, None]
    folded: Image = np.clip(image + folds, 0, 255).astype(np.uint8)
    for left in (0.0, 0.325, 0.655, 0.98):
        fill(folded, left, 0, left + 0.02, 1, WHITE)
    return folded


def desktop(thing: SceneObject) -> Image:
    """A computer's screen: a window with text on blue."""
    image = plain(128, 80, (36, 92, 168))
    fill(image, 0.10, 0.12, 0.72, 0.86, WHITE)
    fill(image, 0.10, 0.12, 0.72, 0.22, (70, 78, 92))
    for row in range(5):
        fill(image, 0.15, 0.30 + 0.1 * row, 0.62 - 0.07 * (row % 3), 0.34 + 0.1 * row, (120, 126, 134))
    fill(image, 0.77, 0.2, 0.94, 0.5, (240, 180, 60))
    return image


def chart(thing: SceneObject) -> Image:
    """A wall screen: headline and a bar chart."""
    image = plain(192, 112, (18, 26, 44))
    write(image, thing.text or "WELCOME", 0.06, 0.06, 0.94, 0.30, WHITE)
    for index, tall in enumerate((0.25, 0.4, 0.32, 0.5, 0.45)):
        fill(image, 0.12 + 0.16 * index, 0.92 - tall, 0.22 + 0.16 * index, 0.92, _GOODS[index])
    return image


def printer_front(thing: SceneObject) -> Image:
    """Paper trays below, a display and an output slot with paper above."""
    image = front(thing)
    for row in range(3):
        fill(image, 0.05, 0.44 + 0.18 * row, 0.95, 0.60 + 0.18 * row, rgb(thing.colour, 0.86))
        fill(image, 0.38, 0.50 + 0.18 * row, 0.62, 0.53 + 0.18 * row, DARK)
    fill(image, 0.05, 0.20, 0.95, 0.38, DARK)
    fill(image, 0.15, 0.26, 0.75, 0.34, WHITE)
    fill(image, 0.60, 0.05, 0.92, 0.16, (60, 140, 220))
    write(image, "COPY", 0.08, 0.05, 0.52, 0.16, (40, 60, 90))
    return image


def coffee_front(thing: SceneObject) -> Image:
    """A coffee machine on a cupboard: COFFEE, a cup in its bay, buttons."""
    image = front(thing)
    fill(image, 0, 0.60, 1, 1, (196, 188, 176))
    fill(image, 0.48, 0.62, 0.52, 0.98, (150, 142, 130))
    fill(image, 0.06, 0.04, 0.94, 0.18, (150, 28, 24))
    write(image, "COFFEE", 0.09, 0.05, 0.91, 0.17, WHITE)
    fill(image, 0.12, 0.24, 0.62, 0.55, (52, 46, 42))
    fill(image, 0.28, 0.40, 0.46, 0.53, WHITE)
    for row in range(4):
        fill(image, 0.70, 0.24 + 0.08 * row, 0.90, 0.30 + 0.08 * row, (216, 170, 90))
    return image


def fridge_front(thing: SceneObject) -> Image:
    """Two doors with long handles and some notes."""
    image = front(thing)
    fill(image, 0, 0.33, 1, 0.345, rgb(thing.colour, 0.5))
    fill(image, 0.06, 0.10, 0.12, 0.30, DARK)
    fill(image, 0.06, 0.40, 0.12, 0.66, DARK)
    fill(image, 0.45, 0.14, 0.62, 0.24, (250, 230, 110))
    fill(image, 0.60, 0.42, 0.80, 0.56, (240, 150, 150))
    return image


def cartons(thing: SceneObject) -> Image:
    """Six cartons with tape and labels."""
    image = canvas(thing.size_m[1], thing.size_m[2], (190, 146, 92))
    rng = np.random.default_rng(23)
    for row in range(2):
        for column in range(3):
            x, y = column / 3, row / 2
            tone = int(rng.normal(0, 9))
            fill(image, x + 0.004, y + 0.006, x + 0.329, y + 0.494, (188 + tone, 144 + tone, 90 + tone))
            fill(image, x + 0.145, y, x + 0.185, y + 0.5, (220, 196, 150))
            fill(image, x + 0.21, y + 0.30, x + 0.30, y + 0.42, WHITE)
    return image


def carton(thing: SceneObject) -> Image:
    """One carton: a strip of tape, a label and an arrow."""
    image = plain(96, 96, (190, 146, 92))
    fill(image, 0, 0, 1, 0.03, (150, 112, 68))
    fill(image, 0.44, 0, 0.56, 1, (220, 196, 150))
    fill(image, 0.62, 0.55, 0.92, 0.85, WHITE)
    fill(image, 0.66, 0.60, 0.88, 0.64, DARK)
    fill(image, 0.66, 0.70, 0.80, 0.74, DARK)
    fill(image, 0.10, 0.55, 0.34, 0.60, DARK)
    return image


def aisle_plate(thing: SceneObject) -> Image:
    """A rack's number, large, black on yellow."""
    image = plain(128, 128, (250, 206, 30))
    cv2.rectangle(image, (3, 3), (124, 124), DARK, 5)
    write(image, thing.text, 0.08, 0.10, 0.92, 0.90, DARK)
    return image


def red_white(thing: SceneObject) -> Image:
    """Slanting red and white stripes."""
    image = plain(160, 32, WHITE)
    for left in range(-40, 180, 40):
        corners = np.array(((left, 32), (left + 20, 32), (left + 40, 0), (left + 20, 0)), np.int32)
        cv2.fillPoly(image, [corners], rgb(thing.colour))
    return image


def storefront_face(thing: SceneObject) -> Image:
    """A shop: its name in large letters over two show windows and a door."""
    image = front(thing, 0.8)
    fill(image, 0.0, 0.0, 1.0, 0.30, rgb(thing.colour))
    fill(image, 0.02, 0.03, 0.98, 0.27, rgb(thing.colour, 0.7))
    write(image, thing.text or "SHOP", 0.06, 0.05, 0.94, 0.25, (255, 244, 210))
    rng = np.random.default_rng(29)
    for left, right in ((0.04, 0.39), (0.61, 0.96)):
        fill(image, left, 0.36, right, 0.90, (250, 240, 200))
        for _ in range(14):
            x, tall = left + (right - left - 0.05) * rng.random(), 0.06 + 0.16 * rng.random()
            fill(image, x, 0.86 - tall, x + 0.04, 0.86, _GOODS[int(rng.integers(len(_GOODS)))])
        fill(image, left, 0.86, right, 0.90, (120, 84, 54))
    fill(image, 0.42, 0.36, 0.58, 1.0, (56, 44, 38))
    fill(image, 0.44, 0.40, 0.56, 0.94, (178, 212, 224))
    fill(image, 0.545, 0.66, 0.555, 0.78, (230, 200, 120))
    return image


def facade(thing: SceneObject) -> Image:
    """Storeys of windows."""
    return _storeys(thing, thing.size_m[1])


def facade_side(thing: SceneObject) -> Image:
    """Storeys of windows along the building's depth."""
    return _storeys(thing, thing.size_m[0])


def facade_front(thing: SceneObject) -> Image:
    """Storeys of windows over an entrance with the building's name."""
    image = _storeys(thing, thing.size_m[1])
    _, width, height = thing.size_m
    door, storey = min(2.4 / width, 0.4), min(3.2 / height, 0.9)
    fill(image, 0.5 - 1.6 * door, 1 - storey, 0.5 + 1.6 * door, 1, rgb(thing.colour, 0.72))
    fill(image, 0.5 - door / 2, 1 - 0.72 * storey, 0.5 + door / 2, 1, (60, 78, 92))
    fill(image, 0.497, 1 - 0.72 * storey, 0.503, 1, WHITE)
    if thing.text:
        wide = min(0.46, 0.35 * len(thing.text) / width + 0.08)
        low, high = 1 - 1.32 * storey, 1 - 0.80 * storey
        fill(image, 0.5 - wide, low, 0.5 + wide, high, (28, 40, 60))
        write(image, thing.text, 0.5 - 0.95 * wide, low + 0.01, 0.5 + 0.95 * wide, high - 0.01, WHITE)
    return image


def _storeys(thing: SceneObject, width_m: float) -> Image:
    height_m = thing.size_m[2]
    image = grain(canvas(width_m, height_m, rgb(thing.colour)), 37, 4.0, 6)
    columns, rows = max(round(width_m / 2.6), 1), max(round(height_m / 3.0), 1)
    for row in range(rows):
        for column in range(columns):
            x, y = (column + 0.22) / columns, (row + 0.22) / rows
            right, low = x + 0.56 / columns, y + 0.50 / rows
            fill(image, x - 0.006, y - 0.006, right + 0.006, low + 0.012, rgb(thing.colour, 1.3))
            fill(image, x, y, right, low, (104, 138, 164) if (row * 5 + column * 3) % 4 else (228, 210, 150))
            fill(image, (x + right) / 2 - 0.002, y, (x + right) / 2 + 0.002, low, WHITE)
    fill(image, 0, 0, 1, 0.02, rgb(thing.colour, 0.6))
    return image


def kiosk_face(thing: SceneObject) -> Image:
    """A kiosk's counter with goods under its name."""
    image = front(thing)
    fill(image, 0.04, 0.02, 0.96, 0.20, WHITE)
    write(image, thing.text or "KIOSK", 0.08, 0.03, 0.92, 0.19, rgb(thing.colour, 0.8))
    fill(image, 0.08, 0.28, 0.92, 0.62, (60, 46, 36))
    for index in range(9):
        fill(image, 0.11 + 0.09 * index, 0.40 + 0.06 * (index % 2), 0.18 + 0.09 * index, 0.60, _GOODS[index % 8])
    fill(image, 0.04, 0.62, 0.96, 0.67, (226, 214, 190))
    return image


def leaves(thing: SceneObject) -> Image:
    """Dense leaves."""
    image = plain(160, 96, rgb(thing.colour))
    rng = np.random.default_rng(41)
    for _ in range(420):
        x, y = int(rng.integers(160)), int(rng.integers(96))
        cv2.circle(image, (x, y), 3, rgb(thing.colour, 0.7 + 0.8 * rng.random()), -1)
    return image


def mail_front(thing: SceneObject) -> Image:
    """MAIL over a slot."""
    image = front(thing)
    fill(image, 0.12, 0.12, 0.88, 0.22, DARK)
    fill(image, 0.12, 0.34, 0.88, 0.66, WHITE)
    write(image, thing.text or "MAIL", 0.16, 0.37, 0.84, 0.63, rgb(thing.colour))
    return image


def plate(thing: SceneObject) -> Image:
    """White letters on the object's colour."""
    image = plain(192, 96, WHITE)
    fill(image, 0.03, 0.06, 0.97, 0.94, rgb(thing.colour))
    write(image, thing.text or "INFO", 0.07, 0.14, 0.93, 0.86, WHITE)
    return image


def bus_plate(thing: SceneObject) -> Image:
    """BUS, white on blue."""
    image = plain(128, 128, (24, 90, 190))
    write(image, thing.text or "BUS", 0.08, 0.2, 0.92, 0.8, WHITE)
    return image


def timetable(thing: SceneObject) -> Image:
    """A pane of glass with a poster."""
    image = plain(192, 112, (186, 214, 222))
    fill(image, 0.60, 0.08, 0.92, 0.92, (232, 96, 60))
    fill(image, 0.64, 0.16, 0.88, 0.40, (250, 226, 120))
    fill(image, 0.10, 0.20, 0.34, 0.70, WHITE)
    for row in range(5):
        fill(image, 0.13, 0.26 + 0.08 * row, 0.31, 0.29 + 0.08 * row, (90, 96, 104))
    return image
