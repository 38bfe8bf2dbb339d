"""Map of a scene from above: floors, walls, objects, names; for reports, videos and inspection of layouts."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product
from math import cos, sin

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_hil.scene.scene import Scene, Vec2

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]

_PAPER: Colour = (236, 236, 232)
_INK: Colour = (52, 60, 70)
_FLOORS: dict[str, Colour] = {
    "asphalt": (120, 122, 126), "asphalt_line": (120, 122, 126), "zebra_crossing": (250, 250, 250),
    "grass": (150, 190, 120), "soil": (150, 120, 90), "paving": (206, 202, 194), "paving_light": (222, 218, 208),
    "cobbles": (190, 184, 176), "carpet_blue": (170, 190, 220), "carpet_tiles": (186, 188, 198),
    "wood": (214, 190, 158), "marble": (238, 234, 226), "concrete": (204, 204, 200), "vinyl": (222, 228, 228),
    "vinyl_green": (200, 226, 212), "floor_tiles": (214, 208, 198), "hazard_stripes": (240, 214, 90),
    "concrete_yellow_line": (222, 214, 150), "tactile_paving": (236, 206, 96),
}  # fmt: skip
_TERRAIN: Colour = (176, 160, 128)
_OVERHEAD = frozenset(("light", "sign", "exit_sign", "awning"))
_CROWNS = frozenset(("umbrella", "umbrella_table", "tree"))


@dataclass(frozen=True)
class MapView:
    """Transform from world to map pixels: ((x - x0) * px_per_m, (y1 - y) * px_per_m)."""

    x0_m: float
    y1_m: float
    px_per_m: float

    def pixel(self, point: Vec2) -> tuple[int, int]:
        """Return column and row of a world point, m."""
        return (round((point[0] - self.x0_m) * self.px_per_m), round((self.y1_m - point[1]) * self.px_per_m))


def map_view(scene: Scene, px_per_m: float) -> MapView:
    """Return the transform of `draw_map`. Raises ValueError for a scale that is not positive."""
    if not px_per_m > 0:
        raise ValueError(f"map: px_per_m must be positive, found {px_per_m}")
    return MapView(scene.floor_min_m[0] - 0.5, scene.floor_max_m[1] + 0.5, px_per_m)


def draw_map(scene: Scene, px_per_m: float = 20.0, *, names: bool = False) -> Image:
    """Draw the scene from above, RGB uint8 [height, width, 3], x right, y up; `names`: label landmarks and areas."""
    view = map_view(scene, px_per_m)
    (x0, y0), (x1, y1) = scene.floor_min_m, scene.floor_max_m
    height, width = round((y1 - y0 + 1) * px_per_m), round((x1 - x0 + 1) * px_per_m)
    image = np.full((height, width, 3), 255, np.uint8)
    ground = _FLOORS.get(scene.floor_texture, _PAPER)
    _fill(image, view, ((x0, y0), (x1, y0), (x1, y1), (x0, y1)), ground)
    for patch in scene.floors:
        _fill(image, view, patch.polygon, _FLOORS.get(patch.texture, _PAPER))
    for terrain in scene.terrain:
        _fill(image, view, terrain.corners(), _TERRAIN, outline=(140, 124, 96))
    for thing in sorted(scene.objects, key=lambda thing: thing.kind in _CROWNS):
        if thing.kind in _OVERHEAD:
            continue
        colour = (round(thing.colour[0] * 255), round(thing.colour[1] * 255), round(thing.colour[2] * 255))
        if thing.kind in _CROWNS:
            radius = max(1, round(thing.size_m[0] / 2 * px_per_m))
            cv2.circle(image, view.pixel(thing.position_m[:2]), radius, colour, 2, cv2.LINE_AA)
            for box in thing.boxes:
                _fill(image, view, box.corners(), colour)
            continue
        _fill(image, view, thing.box.corners(), colour, outline=_INK)
        nose = (
            thing.position_m[0] + thing.size_m[0] / 2 * cos(thing.heading_rad),
            thing.position_m[1] + thing.size_m[0] / 2 * sin(thing.heading_rad),
        )
        if thing.solid and min(thing.size_m[:2]) * px_per_m > 8:
            cv2.line(image, view.pixel(thing.position_m[:2]), view.pixel(nose), _INK, 1, cv2.LINE_AA)
    for wall in scene.walls:
        _fill(image, view, wall.box.corners(), _INK)
    if names:
        for area in scene.areas:
            xs, ys = zip(*area.polygon, strict=True)
            _write(image, area.label, view.pixel((sum(xs) / len(xs), sum(ys) / len(ys))), (60, 90, 160))
        for thing in scene.landmarks():
            _write(image, thing.landmark, view.pixel(thing.position_m[:2]), (170, 40, 40))
    return image


def draw_path(image: Image, view: MapView, points: Iterable[Vec2], colour: Colour, thickness: int = 2) -> None:
    """Draw a polyline of world points into a map."""
    pixels = np.array([view.pixel(point) for point in points], np.int32).reshape(-1, 1, 2)
    cv2.polylines(image, [pixels], False, colour, thickness, cv2.LINE_AA)


def draw_mark(image: Image, view: MapView, point: Vec2, colour: Colour, radius_m: float, filled: bool = True) -> None:
    """Draw a disc or ring with a radius in m into a map."""
    radius = max(2, round(radius_m * view.px_per_m))
    cv2.circle(image, view.pixel(point), radius, colour, -1 if filled else 2, cv2.LINE_AA)


def draw_pose(
    image: Image, view: MapView, x: float, y: float, heading_rad: float, colour: Colour, size_m: float
) -> None:
    """Draw an arrowhead at a pose into a map."""
    points = [(size_m, 0.0), (-0.6 * size_m, 0.55 * size_m), (-0.6 * size_m, -0.55 * size_m)]
    c, s = cos(heading_rad), sin(heading_rad)
    _fill(image, view, [(x + c * u - s * v, y + s * u + c * v) for u, v in points], colour)


def _fill(
    image: Image, view: MapView, polygon: Iterable[Vec2], colour: Colour, outline: Colour | None = None
) -> None:  # fmt: skip
    pixels = np.array([view.pixel(point) for point in polygon], np.int32).reshape(-1, 1, 2)
    cv2.fillPoly(image, [pixels], colour, cv2.LINE_AA)
    if outline is not None:
        cv2.polylines(image, [pixels], True, outline, 1, cv2.LINE_AA)


def _write(image: Image, text: str, at: tuple[int, int], colour: Colour) -> None:
    (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.34, 1)
    where = (at[0] - width // 2, at[1] + 4)
    # A thicker text would be wider in OpenCV 5, and its white edge beside the text.
    for right, down in product((-1, 0, 1), repeat=2):
        edge_at = (where[0] + right, where[1] + down)
        cv2.putText(image, text, edge_at, cv2.FONT_HERSHEY_SIMPLEX, 0.34, (255, 255, 255), 1, cv2.LINE_AA)
    cv2.putText(image, text, where, cv2.FONT_HERSHEY_SIMPLEX, 0.34, colour, 1, cv2.LINE_AA)
