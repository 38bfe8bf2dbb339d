"""Labels of an image by cell and by column, from the instance image and the scene.

A cell is the image area of one visual token. Distances are measured along the floor from the camera, m.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import atan2, pi
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sim_hil.layouts.builder import COLOURS
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.parts import AREA_KINDS
from sim_hil.scene.scene import KINDS, Area, Box, Scene
from tools.train.encoder.ids import CEILING, FIRST, FLOOR, SKY, Ids, View

Array = NDArray[np.float64]
Labels = Mapping[str, NDArray[np.generic]]

PIXELS: Final = 64
"""Width and height of the instance image, px."""
COLUMNS: Final = 32
"""Directions from left to right across the image for which the free distance is labelled."""
CLASSES: Final = ("sky", "floor", "ceiling", "terrain", "wall", "person", *sorted(KINDS))
"""Classes of pixels; kinds of objects as in `sim_hil.scene.scene`."""
PERSON: Final = CLASSES.index("person")
COLOUR_WORDS: Final = tuple(COLOURS)
OPENINGS: Final = ("none", *sorted(AREA_KINDS))
"""Kind of area that a direction leads into; none if it stays in the current area."""
OCTANTS: Final = 8
"""Directions that a person faces, seen from the camera: 0 away from it, 2 left, 4 towards it, 6 right."""
NONE: Final = 255
FAR_M: Final = 30.0
FREE_M: Final = 12.0
NEAREST_M: Final = 0.1
BACKGROUND, THING, DOOR, LANDMARK, SOMEBODY = range(5)
"""Ranks of objects; the object with the highest rank in a cell is the cell's `thing`."""

_DOORS: Final = frozenset(("door", "double_door", "elevator", "loading_door"))
_CLEAR_M: Final = 0.2  # clearance of free floor to each side
_RAYS: Final = 5  # rays per column, because a distant doorway is narrower than a column
_THROUGH_M: Final = 0.05  # clearance of a ray through an opening
_STEP_M: Final = 0.1  # spacing of points along a ray
_BEYOND: Final = 1  # steps that a ray must continue into an opening
_PERSON_HALF_M: Final = 0.15  # half the depth of a person
_PIXEL: Final = 0.04  # size of a pixel of the instance image at a distance of 1 m, m
_NOWHERE: Final = (1e9, 1e9, 1e9, 1.0, 0.0, 0.0, 0.0, 0.0)  # a box that no ray hits


def label_shapes(side: int) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Return dtype and shape of each label of an image with `side` x `side` tokens.

    By cell: `main`, most frequent class; `thing`, class of the highest rank, with its `rank`, distance `thing_m`,
    `colour` and `facing` (of people), or NONE; `near_m`, smallest distance. By column: `free_m`, free distance;
    `open_kind` and `open_m`, kind and distance of the first other area. `place`: kind of the current area.
    """
    cells = (side, side)
    return {
        **dict.fromkeys(("main", "thing", "rank", "colour", "facing"), ("uint8", cells)),
        **dict.fromkeys(("near_m", "thing_m"), ("float16", cells)),
        **dict.fromkeys(("free_m", "open_m"), ("float16", (COLUMNS,))),
        "open_kind": ("uint8", (COLUMNS,)),
        "place": ("uint8", ()),
    }


class SceneLabels:
    """Computes labels in one scene. `grid`: floor that is free for the robot."""

    def __init__(self, scene: Scene, grid: NavGrid, side: int) -> None:
        if side < 1 or PIXELS % side:
            raise ValueError(f"labels: expected a side that divides {PIXELS}, found {side}")
        self._grid, self._side = grid, side
        self._ceiling_m = scene.ceiling_height_m
        self._first_object = FIRST + len(scene.terrain) + len(scene.walls)
        self.first_person = self._first_object + len(scene.objects)
        boxes: list[list[Box]] = []
        classes, ranks, colours = [0, 1, 2], [BACKGROUND] * FIRST, [NONE] * FIRST
        for terrain in scene.terrain:
            (x, y, z), (length, width) = terrain.position_m, terrain.size_m
            axis = (float(np.cos(terrain.heading_rad)), float(np.sin(terrain.heading_rad)))
            boxes.append([Box((x, y, z + terrain.rise_m / 2), axis, (length, width, terrain.rise_m))])
            classes.append(CLASSES.index("terrain"))
            ranks.append(THING)
            colours.append(NONE)
        for wall in scene.walls:
            boxes.append([wall.box])
            classes.append(CLASSES.index("wall"))
            ranks.append(BACKGROUND)
            colours.append(NONE)
        words = {value: index for index, value in enumerate(COLOURS.values())}
        for thing in scene.objects:
            boxes.append([*thing.boxes, thing.box])
            classes.append(CLASSES.index(thing.kind))
            ranks.append(
                LANDMARK if thing.landmark else DOOR if thing.kind in _DOORS
                else BACKGROUND if thing.kind == "light" else THING
            )  # fmt: skip
            colours.append(words.get(thing.colour, NONE))
        self._classes, self._ranks, self._colours = (np.array(each, np.int64) for each in (classes, ranks, colours))
        most = max((len(each) for each in boxes), default=1)
        # The last box encloses the whole object; it is used if a ray hits none of the parts.
        self._boxes = np.array([_rows([], most)] * FIRST + [_rows(each, most) for each in boxes], np.float64).reshape(
            -1, most, 8
        )
        self._areas = area_map(scene, grid)
        self._kinds = np.array([OPENINGS.index(area.kind) for area in scene.areas] + [0], np.int64)

    def of(self, ids: Ids, view: View, people: Array, base_xy: tuple[float, float]) -> Labels:
        """Compute the labels of an instance image `ids` [PIXELS, PIXELS]; `people`: rows of the render state."""
        flat = ids.ravel().astype(np.int64)
        index = flat - self.first_person
        if flat.max(initial=0) >= self.first_person + len(people):
            raise ValueError(f"labels: the image contains number {flat.max()}, which no person has")
        is_person = index >= 0
        known = np.where(is_person, 0, flat)
        classes = np.where(is_person, PERSON, self._classes[known])
        ranks = np.where(is_person, SOMEBODY, self._ranks[known])
        colours = np.where(is_person, NONE, self._colours[known])
        facing = np.full(len(flat), NONE)
        if is_person.any():
            rows = people[index[is_person]]
            bearings = np.arctan2(rows[:, 1] - view.eye[1], rows[:, 0] - view.eye[0])
            facing[is_person] = np.rint((rows[:, 2] - bearings) / (2 * pi / OCTANTS)).astype(np.int64) % OCTANTS
        ranges = self._ranges(flat, view, people)
        return {
            **self._cells(classes, ranks, colours, facing, ranges),
            **self._columns(view, base_xy),
        }

    def _ranges(self, flat: NDArray[np.int64], view: View, people: Array) -> Array:
        """Compute the distance of each pixel's point along the floor [n], m."""
        rays = view.rays(PIXELS).reshape(-1, 3)
        along = np.full(len(flat), np.inf)  # in lengths of the ray
        drop = rays[:, 2]
        for number, height in ((FLOOR, 0.0), (CEILING, self._ceiling_m)):
            here = (flat == number) & (np.abs(drop) > 1e-6)
            along[here] = (height - view.eye[2]) / drop[here]
        along[along < 0] = np.inf
        fixed = (flat >= FIRST) & (flat < self.first_person)
        for group, count in ((fixed & (flat < self._first_object), 1), (fixed & (flat >= self._first_object), 0)):
            if group.any():
                boxes = self._boxes[flat[group]]
                along[group] = _met(boxes[:, -count:] if count else boxes, view.eye, rays[group])
        ranges = along * np.hypot(rays[:, 0], rays[:, 1])
        index = flat - self.first_person
        is_person = index >= 0
        if is_person.any():
            offsets = people[index[is_person], :2] - view.eye[:2]
            ranges[is_person] = np.hypot(offsets[:, 0], offsets[:, 1]) - _PERSON_HALF_M
        ranges[flat == SKY] = FAR_M
        clipped: Array = np.clip(ranges, NEAREST_M, FAR_M)
        return clipped

    def _cells(
        self, classes: NDArray[np.int64], ranks: NDArray[np.int64], colours: NDArray[np.int64],
        facing: NDArray[np.int64], ranges: Array,
    ) -> dict[str, NDArray[np.generic]]:  # fmt: skip
        side, block = self._side, PIXELS // self._side
        rows, columns = np.divmod(np.arange(PIXELS * PIXELS), PIXELS)
        cell = rows // block * side + columns // block
        cells, kinds = side * side, len(CLASSES)
        counts = np.bincount(cell * kinds + classes, minlength=cells * kinds).reshape(cells, kinds)
        by_rank = np.bincount(cell * 5 + ranks, minlength=cells * 5).reshape(cells, 5)
        # A single pixel of a large cell is ignored.
        there = by_rank >= max(1, block * block // 32)
        best = 4 - np.argmax(there[:, ::-1], axis=1)
        chosen = ranks == best[cell]
        thing = np.bincount((cell * kinds + classes)[chosen], minlength=cells * kinds).reshape(cells, kinds).argmax(1)
        chosen &= classes == thing[cell]
        near, thing_m = np.full(cells, FAR_M), np.full(cells, FAR_M)
        np.minimum.at(near, cell, ranges)
        np.minimum.at(thing_m, cell[chosen], ranges[chosen])
        words = len(COLOUR_WORDS)
        coloured = chosen & (colours != NONE)
        tints = np.bincount((cell * words + colours)[coloured], minlength=cells * words).reshape(cells, words)
        turned = np.full(cells, NONE)
        nearest = chosen & (facing != NONE) & (ranges <= thing_m[cell])
        turned[cell[nearest]] = facing[nearest]
        shape = (side, side)
        found: dict[str, NDArray[np.generic]] = {
            "main": counts.argmax(1).astype(np.uint8).reshape(shape),
            "thing": thing.astype(np.uint8).reshape(shape),
            "rank": best.astype(np.uint8).reshape(shape),
            "colour": np.where(tints.any(axis=1), tints.argmax(1), NONE).astype(np.uint8).reshape(shape),
            "facing": turned.astype(np.uint8).reshape(shape),
            "near_m": near.astype(np.float16).reshape(shape),
            "thing_m": thing_m.astype(np.float16).reshape(shape),
        }
        return found

    def _columns(self, view: View, base_xy: tuple[float, float]) -> dict[str, NDArray[np.generic]]:
        rays = COLUMNS * _RAYS
        across = ((np.arange(rays) + 0.5) / rays * 2 - 1) * view.half_width
        ways = view.ahead[:2] + across[:, None] * view.right[:2]
        ways /= np.hypot(ways[:, 0], ways[:, 1])[:, None]
        gone = np.arange(1, round(FREE_M / _STEP_M) + 1) * _STEP_M
        points = view.eye[:2] + ways[:, None, :] * gone[None, :, None]
        clear = self._grid.clearances_at(points)
        free = _first(clear[_RAYS // 2 :: _RAYS] < _CLEAR_M) * _STEP_M
        first = _first(clear < _THROUGH_M)
        areas = self._area_at(points)
        own = int(self._area_at(view.eye[None, :2])[0])
        leads = (areas != own) & (areas >= 0) & (np.arange(len(gone)) + _BEYOND < first[:, None])
        # Use the column's ray that reaches another area first.
        nearest = np.arange(COLUMNS) * _RAYS + _first(leads).reshape(COLUMNS, _RAYS).argmin(axis=1)
        opens, at = leads[nearest].any(axis=1), leads[nearest].argmax(axis=1)
        kinds = self._kinds[areas[nearest, at]]
        here = int(self._area_at(np.array((base_xy,)))[0])
        return {
            "free_m": free.astype(np.float16),
            "open_kind": np.where(opens, kinds, 0).astype(np.uint8),
            "open_m": np.where(opens, gone[at], FREE_M).astype(np.float16),
            "place": np.array(self._kinds[here], np.uint8),
        }

    def _area_at(self, points: Array) -> NDArray[np.int64]:
        """Return the number of the area at points [..., 2]; -1 outside all areas."""
        grid = self._grid
        cells = np.floor((points - np.array(grid.origin_m)) / grid.resolution_m).astype(np.int64)
        column, row = cells[..., 0], cells[..., 1]
        inside = (row >= 0) & (column >= 0) & (row < grid.shape[0]) & (column < grid.shape[1])
        found = self._areas[np.where(inside, row, 0), np.where(inside, column, 0)]
        return np.where(inside, found, -1)


def _first(there: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the index of the first True in each row of [n, m]; m if there is none."""
    found: NDArray[np.int64] = np.where(there.any(axis=1), there.argmax(axis=1), there.shape[1])
    return found


def mirrored_label(name: str, label: NDArray[np.generic]) -> NDArray[np.generic]:
    """Return an image's label for the mirrored image; `name` as in `label_shapes`."""
    flipped = label[..., ::-1] if label.ndim else label
    if name != "facing":
        return flipped
    turned = (OCTANTS - flipped.astype(np.int64)) % OCTANTS
    return np.where(flipped == NONE, NONE, turned).astype(label.dtype)


def area_map(scene: Scene, grid: NavGrid) -> NDArray[np.int64]:
    """Return the number of the first area at each grid cell's centre [rows, columns]; -1 outside all areas."""
    found = np.full(grid.shape, -1, np.int64)
    (x0, y0), cell = grid.origin_m, grid.resolution_m
    for number, area in reversed(list(enumerate(scene.areas))):
        xs, ys = zip(*area.polygon, strict=True)
        columns = slice(max(int((min(xs) - x0) / cell), 0), max(int((max(xs) - x0) / cell) + 1, 0))
        rows = slice(max(int((min(ys) - y0) / cell), 0), max(int((max(ys) - y0) / cell) + 1, 0))
        window = found[rows, columns]
        x = x0 + (columns.start + np.arange(window.shape[1]) + 0.5) * cell
        y = y0 + (rows.start + np.arange(window.shape[0]) + 0.5) * cell
        window[_inside(area, x[None, :], y[:, None])] = number
    return found


def bearing_rad(view_half_width: float, column: float, columns: int) -> float:
    """Return the bearing of a column's centre, rad, positive to the left; columns count from the left edge."""
    return -atan2(((column + 0.5) / columns * 2 - 1) * view_half_width, 1.0)


def _inside(area: Area, x: NDArray[np.floating], y: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return whether points lie in an area's polygon, by the even-odd rule."""
    inside = np.zeros(np.broadcast_shapes(x.shape, y.shape), bool)
    corners = area.polygon
    for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True):
        if ay != by:
            inside ^= ((ay > y) != (by > y)) & (x < ax + (y - ay) / (by - ay) * (bx - ax))
    return inside


def _rows(boxes: list[Box], most: int) -> list[tuple[float, ...]]:
    rows = [(*box.centre_m, *box.axis, *box.size_m) for box in boxes]
    return [*[_NOWHERE] * (most - len(rows)), *rows]


def _met(boxes: Array, eye: Array, rays: Array) -> Array:
    """Intersect rays [n, 3] from the eye with their boxes [n, k, 8]; return ray lengths [n], inf without a hit.

    The last box encloses the others; it is used for rays that hit no part or miss an edge by about a pixel.
    """
    enter, leave = _spans(boxes, eye, rays)
    met = np.where((enter <= leave) & (leave > 0), np.maximum(enter, 0.0), np.inf)
    found = met[:, :-1].min(axis=1, initial=np.inf)
    # An object around the eye (a parasol, a tree's crown) is seen where the ray leaves it.
    found = np.where(np.isfinite(found), found, np.where(enter[:, -1] > 0, met[:, -1], _left(enter, leave)))
    missed = ~np.isfinite(found)
    if missed.any():
        rest = boxes[missed, -1:].copy()
        rest[..., 5:] += 2 * _PIXEL * _gaps(rest, eye)[..., None]
        enter, leave = _spans(rest, eye, rays[missed])
        found[missed] = np.where(enter[:, 0] > 0, np.where(enter <= leave, enter, np.inf)[:, 0], _left(enter, leave))
    return found


def _gaps(boxes: Array, eye: Array) -> Array:
    """Return the distance from the eye to the nearest side of each box along the floor [n, k], m."""
    x, y = eye[0] - boxes[..., 0], eye[1] - boxes[..., 1]
    c, s = boxes[..., 3], boxes[..., 4]
    along, across = np.abs(x * c + y * s) - boxes[..., 5] / 2, np.abs(y * c - x * s) - boxes[..., 6] / 2
    gaps: Array = np.hypot(np.maximum(along, 0.0), np.maximum(across, 0.0))
    return gaps


def _left(enter: Array, leave: Array) -> Array:
    """Return the ray lengths [n] at which rays leave their last box; inf if they never enter it."""
    return np.where((enter <= leave) & (leave > 0), leave, np.inf)[:, -1]


def _spans(boxes: Array, eye: Array, rays: Array) -> tuple[Array, Array]:
    """Return the ray lengths [n, k] at which rays enter and leave their boxes (enter > leave: no hit)."""
    offset = eye - boxes[..., :3]
    c, s, half = boxes[..., 3], boxes[..., 4], boxes[..., 5:] / 2
    start = np.stack(
        (offset[..., 0] * c + offset[..., 1] * s, offset[..., 1] * c - offset[..., 0] * s, offset[..., 2]), -1
    )
    x, y, z = (rays[:, None, axis] for axis in range(3))
    run = np.stack((x * c + y * s, y * c - x * s, np.broadcast_to(z, c.shape)), -1)
    run = np.where(np.abs(run) < 1e-9, 1e-9, run)
    one, other = (-half - start) / run, (half - start) / run
    return np.minimum(one, other).max(-1), np.maximum(one, other).min(-1)
