"""Procedural textures: drawing functions, and the fronts of a corridor's objects. Numpy and OpenCV, RGB uint8.

There are no binary assets, so all textures can be reviewed as code; equal arguments give equal images. A robot's camera
shows most objects with few pixels, so the textures have broad shapes and large letters.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_hil.scene.scene import SceneObject

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]
PIXELS_PER_M = 150
_MAX_PX = 640

WHITE: Colour = (245, 245, 245)
DARK: Colour = (28, 30, 34)
_CANS: tuple[Colour, ...] = (
    (214, 40, 40), (30, 110, 200), (250, 190, 40), (60, 160, 80), (240, 240, 240), (230, 110, 30), (120, 60, 160),
)  # fmt: skip


def plain(width: int, height: int, colour: Colour) -> Image:
    """Return an image of one colour; size in pixels."""
    return np.full((height, width, 3), colour, np.uint8)


def rgb(colour: tuple[float, float, float], brightness: float = 1.0) -> Colour:
    """Convert a colour from 0..1 to 0..255, scaled in brightness."""
    red, green, blue = (min(max(round(255 * channel * brightness), 0), 255) for channel in colour)
    return (red, green, blue)


def fill(image: Image, x0: float, y0: float, x1: float, y1: float, colour: Colour) -> None:
    """Fill a rectangle given in fractions of the image, y downwards."""
    height, width = image.shape[:2]
    a, b = (round(x0 * width), round(y0 * height)), (round(x1 * width) - 1, round(y1 * height) - 1)
    cv2.rectangle(image, a, b, colour, -1)


def write(image: Image, text: str, x0: float, y0: float, x1: float, y1: float, colour: Colour) -> None:
    """Write one line as large as it fits, centred in a rectangle given in fractions of the image."""
    if not text:
        return
    height, width = image.shape[:2]
    room_w, room_h = (x1 - x0) * width, (y1 - y0) * height
    (text_w, text_h), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 1.0, 2)
    scale = min(room_w / text_w, room_h / text_h) * 0.92
    thick = max(round(2.4 * scale), 1)
    (text_w, text_h), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thick)
    at = (round(x0 * width + (room_w - text_w) / 2), round(y0 * height + (room_h + text_h) / 2))
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, thick, cv2.LINE_AA)


def canvas(width_m: float, height_m: float, colour: Colour) -> Image:
    """Return an image for a surface of that size, m; large surfaces get fewer pixels per metre."""
    scale = min(PIXELS_PER_M, _MAX_PX / max(width_m, height_m))
    return plain(max(round(width_m * scale), 8), max(round(height_m * scale), 8), colour)


def front(thing: SceneObject, brightness: float = 1.0) -> Image:
    """Return an image of the object's colour for its front."""
    return canvas(thing.size_m[1], thing.size_m[2], rgb(thing.colour, brightness))


def grain(image: Image, seed: int, strength: float, cell: int) -> Image:
    """Add soft blotches to a plain surface, as texture for optical flow."""
    height, width = image.shape[:2]
    noise = np.random.default_rng(seed).normal(0, strength, (max(height // cell, 1), max(width // cell, 1)))
    smooth = cv2.resize(noise.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    grained: Image = np.clip(image + smooth[..., None], 0, 255).astype(np.uint8)
    return grained


def vending_front(thing: SceneObject) -> Image:
    """Front of a drinks machine: lit banner with lettering, glass with cans on shelves, keypad, delivery flap."""
    image = front(thing)
    fill(image, 0.04, 0.025, 0.96, 0.15, (20, 60, 170))
    fill(image, 0.04, 0.15, 0.96, 0.165, (255, 240, 120))
    write(image, thing.text or "DRINKS", 0.07, 0.04, 0.93, 0.135, (255, 255, 255))
    fill(image, 0.06, 0.19, 0.72, 0.74, (235, 244, 250))
    for row in range(5):
        top = 0.205 + row * 0.107
        for column in range(4):
            left = 0.085 + column * 0.158
            colour = _CANS[(row * 3 + column * 2) % len(_CANS)]
            fill(image, left, top, left + 0.11, top + 0.08, colour)
            fill(image, left + 0.015, top + 0.03, left + 0.095, top + 0.05, WHITE if colour != _CANS[4] else DARK)
        fill(image, 0.06, top + 0.083, 0.72, top + 0.094, (90, 96, 104))
    fill(image, 0.77, 0.20, 0.95, 0.50, (24, 40, 120))
    fill(image, 0.79, 0.215, 0.93, 0.26, (120, 255, 170))
    for key in range(12):
        left, top = 0.79 + 0.05 * (key % 3), 0.29 + 0.048 * (key // 3)
        fill(image, left, top, left + 0.038, top + 0.034, (220, 224, 230))
    fill(image, 0.82, 0.55, 0.90, 0.57, DARK)
    fill(image, 0.78, 0.62, 0.94, 0.72, (200, 204, 210))
    fill(image, 0.08, 0.79, 0.70, 0.91, DARK)
    fill(image, 0.11, 0.805, 0.67, 0.86, (60, 64, 72))
    fill(image, 0, 0.96, 1, 1, DARK)
    return image


def vending_side(thing: SceneObject) -> Image:
    """Side of the drinks machine: lettering down the panel on a blue wave, readable from along the corridor."""
    depth, _, height = thing.size_m
    image = canvas(depth, height, rgb(thing.colour))
    h, w = image.shape[:2]
    wave = np.array([(0, 0.62 * h), (w, 0.42 * h), (w, 0.66 * h), (0, 0.86 * h)], np.int32)
    cv2.fillPoly(image, [wave], (20, 60, 170))
    cv2.line(image, (0, round(0.62 * h)), (w, round(0.42 * h)), WHITE, 5)
    cv2.line(image, (0, round(0.86 * h)), (w, round(0.66 * h)), WHITE, 5)
    words = (thing.text or "DRINKS").split()
    for index, word in enumerate(words):
        top = 0.05 + 0.17 * index
        write(image, word, 0.06, top, 0.94, top + 0.14, (255, 255, 255))
    fill(image, 0, 0.97, 1, 1, DARK)
    return image


def door(thing: SceneObject) -> Image:
    """A door in its frame with two panels, handle and number plate."""
    image = front(thing, 0.55)
    fill(image, 0.07, 0.035, 0.93, 1, rgb(thing.colour))
    for top, bottom in ((0.24, 0.52), (0.62, 0.92)):
        fill(image, 0.19, top, 0.81, bottom, rgb(thing.colour, 0.8))
    fill(image, 0.83, 0.53, 0.90, 0.575, (214, 206, 170))
    fill(image, 0.28, 0.09, 0.72, 0.19, WHITE)
    write(image, thing.text, 0.30, 0.10, 0.70, 0.18, DARK)
    return image


def sign(thing: SceneObject) -> Image:
    """A plate with white lettering and a rim."""
    _, width, height = thing.size_m
    image = canvas(width, height, WHITE)
    fill(image, 0.02, 0.07, 0.98, 0.93, rgb(thing.colour))
    write(image, thing.text, 0.06, 0.15, 0.94, 0.85, WHITE)
    return image


def notice_board(thing: SceneObject) -> Image:
    """A cork board with a headline and pinned sheets."""
    image = grain(front(thing), 3, 9.0, 4)
    write(image, thing.text, 0.25, 0.06, 0.75, 0.17, (70, 30, 20))
    sheets = (
        (0.07, 0.24, 0.27, 0.58, WHITE), (0.32, 0.22, 0.52, 0.50, (255, 240, 150)), (0.58, 0.25, 0.74, 0.60, WHITE),
        (0.79, 0.22, 0.94, 0.48, (170, 220, 255)), (0.10, 0.65, 0.30, 0.92, (255, 190, 190)),
        (0.36, 0.57, 0.53, 0.92, WHITE), (0.60, 0.67, 0.90, 0.90, (190, 240, 180)),
    )  # fmt: skip
    for x0, y0, x1, y1, colour in sheets:
        fill(image, x0, y0, x1, y1, colour)
        for line in range(3):
            top = y0 + (y1 - y0) * (0.25 + 0.22 * line)
            fill(image, x0 + 0.02, top, x1 - 0.02, top + 0.025, (120, 124, 130))
    height_px, width_px = image.shape[:2]
    cv2.rectangle(image, (0, 0), (width_px - 1, height_px - 1), (96, 64, 36), 6)
    return image


def window(thing: SceneObject) -> Image:
    """A bright window: sky over a line of trees, white frame and cross bar."""
    image = front(thing)
    fill(image, 0, 0.66, 1, 1, (96, 140, 84))
    for tree in range(5):
        centre = (round((0.1 + 0.2 * tree) * image.shape[1]), round(0.64 * image.shape[0]))
        cv2.circle(image, centre, image.shape[0] // (6 + tree % 2 * 2), (70, 118, 66), -1)
    for x0, y0, x1, y1 in ((0, 0, 1, 0.06), (0, 0.94, 1, 1), (0, 0, 0.04, 1), (0.96, 0, 1, 1), (0.485, 0, 0.515, 1)):
        fill(image, x0, y0, x1, y1, (238, 238, 234))
    return image


def dispenser_front(thing: SceneObject) -> Image:
    """Front of a water dispenser: recess with a blue and a red tap."""
    _, width, height = thing.size_m
    image = canvas(width, height * 0.68, rgb(thing.colour))
    fill(image, 0.15, 0.12, 0.85, 0.48, (70, 78, 88))
    fill(image, 0.28, 0.14, 0.42, 0.26, (40, 110, 230))
    fill(image, 0.58, 0.14, 0.72, 0.26, (225, 50, 45))
    fill(image, 0.20, 0.42, 0.80, 0.46, (190, 195, 200))
    write(image, "WATER", 0.12, 0.60, 0.88, 0.80, (30, 90, 190))
    return image


def bin_front(thing: SceneObject) -> Image:
    """Front of a trash bin: dark slot and a white label."""
    image = front(thing)
    fill(image, 0.14, 0.08, 0.86, 0.24, DARK)
    fill(image, 0.16, 0.45, 0.84, 0.72, WHITE)
    write(image, "TRASH", 0.19, 0.48, 0.81, 0.69, rgb(thing.colour))
    return image


def cabinet_front(thing: SceneObject) -> Image:
    """Front of a metal cabinet with two doors and handles."""
    image = front(thing)
    for left in (0.03, 0.515):
        fill(image, left, 0.05, left + 0.455, 0.95, rgb(thing.colour, 1.18))
    fill(image, 0.44, 0.42, 0.465, 0.58, DARK)
    fill(image, 0.535, 0.42, 0.56, 0.58, DARK)
    return image


def png_bytes(image: Image) -> bytes:
    """Encode an RGB image as PNG. Raises OSError on failure."""
    done, data = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))
    if not done:
        raise OSError("the picture could not be encoded as PNG")
    return bytes(data)
