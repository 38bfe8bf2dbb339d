"""What a robot's picture shows, cell by cell and column by column, from the twin's numbers and the scene's truth.

A cell is what one visual token looks at. Distances are along the floor from the camera, m.
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
"""Side of the picture of numbers that labels are made of."""
COLUMNS: Final = 32
"""Directions, from left to right across the picture, in which the free way is told."""
CLASSES: Final = ("sky", "floor", "ceiling", "terrain", "wall", "person", *sorted(KINDS))
"""What a pixel can show: kinds of objects by their name in `sim_hil.scene.scene`."""
PERSON: Final = CLASSES.index("person")
COLOUR_WORDS: Final = tuple(COLOURS)
OPENINGS: Final = ("none", *sorted(AREA_KINDS))
"""What a way leads into: a kind of area, or nothing but where one is already."""
OCTANTS: Final = 8
"""Of how a person faces, as the camera sees it: 0 away from it, 2 to the left, 4 towards it, 6 to the right."""
NONE: Final = 255
FAR_M: Final = 30.0
FREE_M: Final = 12.0
NEAREST_M: Final = 0.1
BACKGROUND, THING, DOOR, LANDMARK, SOMEBODY = range(5)
"""How much a cell's things matter: the highest that is there names the cell's `thing`."""

_DOORS: Final = frozenset(("door", "double_door", "elevator", "loading_door"))
_CLEAR_M: Final = 0.2  # of a free way to each side
_RAYS: Final = 5  # of a column: a doorway far ahead at the side is narrower than one
_THROUGH_M: Final = 0.05  # to each side of a look through an opening
_STEP_M: Final = 0.1
_BEYOND: Final = 1  # steps that a look goes on into an opening
_PERSON_HALF_M: Final = 0.15
_PIXEL: Final = 0.04  # of the twin's pictures, m at a distance of 1 m
_NOWHERE: Final = (1e9, 1e9, 1e9, 1.0, 0.0, 0.0, 0.0, 0.0)  # a box that no ray meets


def label_shapes(side: int) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Type and shape of each label of a picture whose tokens are `side` x `side`.

    `main`: class of most of a cell; `thing`: class of what matters most in it, `rank` how much, `thing_m` how far away
    it is, `colour` and `facing` (of people) or NONE; `near_m`: what is nearest in the cell. By column: `free_m`, how
    far the floor is free, `open_kind` and `open_m`, what other area that way first leads into and where. `place`: the
    kind of area here.
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
    """Tables of one scene by the twin's numbers. `grid` is the floor that is free for the robot."""

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
        # The last box of each is the one around it all: it stands in where a ray meets none of the parts.
        self._boxes = np.array([_rows([], most)] * FIRST + [_rows(each, most) for each in boxes], np.float64).reshape(
            -1, most, 8
        )
        self._areas = area_map(scene, grid)
        self._kinds = np.array([OPENINGS.index(area.kind) for area in scene.areas] + [0], np.int64)

    def of(self, ids: Ids, view: View, people: Array, base_xy: tuple[float, float]) -> Labels:
        """Labels of `ids` [PIXELS, PIXELS] seen by `view` from a robot at `base_xy`; `people`: render rows."""
        flat = ids.ravel().astype(np.int64)
        who = flat - self.first_person
        if flat.max(initial=0) >= self.first_person + len(people):
            raise ValueError(f"labels: a number of {flat.max()} in the picture, of a person that is not there")
        is_person = who >= 0
        known = np.where(is_person, 0, flat)
        classes = np.where(is_person, PERSON, self._classes[known])
        ranks = np.where(is_person, SOMEBODY, self._ranks[known])
        colours = np.where(is_person, NONE, self._colours[known])
        facing = np.full(len(flat), NONE)
        if is_person.any():
            rows = people[who[is_person]]
            bearings = np.arctan2(rows[:, 1] - view.eye[1], rows[:, 0] - view.eye[0])
            facing[is_person] = np.rint((rows[:, 2] - bearings) / (2 * pi / OCTANTS)).astype(np.int64) % OCTANTS
        ranges = self._ranges(flat, view, people)
        return {
            **self._cells(classes, ranks, colours, facing, ranges),
            **self._columns(view, base_xy),
        }

    def _ranges(self, flat: NDArray[np.int64], view: View, people: Array) -> Array:
        """[n]: how far away each pixel's point is along the floor, m."""
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
        who = flat - self.first_person
        person = who >= 0
        if person.any():
            offsets = people[who[person], :2] - view.eye[:2]
            ranges[person] = np.hypot(offsets[:, 0], offsets[:, 1]) - _PERSON_HALF_M
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
        # One pixel of a cell is chance; where cells are small it is all there is.
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
        # Of a column's rays the one that comes into another area soonest.
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
        """[...]: number of the area at points [..., 2]; -1 where there is none."""
        grid = self._grid
        cells = np.floor((points - np.array(grid.origin_m)) / grid.resolution_m).astype(np.int64)
        column, row = cells[..., 0], cells[..., 1]
        inside = (row >= 0) & (column >= 0) & (row < grid.shape[0]) & (column < grid.shape[1])
        found = self._areas[np.where(inside, row, 0), np.where(inside, column, 0)]
        return np.where(inside, found, -1)


def _first(there: NDArray[np.bool_]) -> NDArray[np.int64]:
    """[n]: where a row of [n, m] is true first; m where it never is."""
    found: NDArray[np.int64] = np.where(there.any(axis=1), there.argmax(axis=1), there.shape[1])
    return found


def mirrored_label(name: str, label: NDArray[np.generic]) -> NDArray[np.generic]:
    """A picture's label of a `label_shapes` name as it is of the mirrored picture."""
    flipped = label[..., ::-1] if label.ndim else label
    if name != "facing":
        return flipped
    turned = (OCTANTS - flipped.astype(np.int64)) % OCTANTS
    return np.where(flipped == NONE, NONE, turned).astype(label.dtype)


def area_map(scene: Scene, grid: NavGrid) -> NDArray[np.int64]:
    """[rows, columns] of the grid: number of the first area around each cell's middle; -1 where there is none."""
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
    """Angle to the left of straight ahead of the middle of a column, counted from the left edge."""
    return -atan2(((column + 0.5) / columns * 2 - 1) * view_half_width, 1.0)


def _inside(area: Area, x: NDArray[np.floating], y: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Whether points lie in a polygon, by the even-odd rule."""
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
    """[n]: where rays [n, 3] from the eye meet one of their boxes [n, k, 8], in lengths of the ray; inf for none.

    The last box is the whole's: for rays that meet no part, or pass an edge by about a pixel.
    """
    enter, leave = _spans(boxes, eye, rays)
    met = np.where((enter <= leave) & (leave > 0), np.maximum(enter, 0.0), np.inf)
    found = met[:, :-1].min(axis=1, initial=np.inf)
    # What is around the eye (a parasol, a tree's crown) is seen where the ray leaves it.
    found = np.where(np.isfinite(found), found, np.where(enter[:, -1] > 0, met[:, -1], _left(enter, leave)))
    missed = ~np.isfinite(found)
    if missed.any():
        rest = boxes[missed, -1:].copy()
        rest[..., 5:] += 2 * _PIXEL * _gaps(rest, eye)[..., None]
        enter, leave = _spans(rest, eye, rays[missed])
        found[missed] = np.where(enter[:, 0] > 0, np.where(enter <= leave, enter, np.inf)[:, 0], _left(enter, leave))
    return found


def _gaps(boxes: Array, eye: Array) -> Array:
    """[n, k]: from the eye to the nearest side of each box, along the floor, m."""
    x, y = eye[0] - boxes[..., 0], eye[1] - boxes[..., 1]
    c, s = boxes[..., 3], boxes[..., 4]
    along, across = np.abs(x * c + y * s) - boxes[..., 5] / 2, np.abs(y * c - x * s) - boxes[..., 6] / 2
    gaps: Array = np.hypot(np.maximum(along, 0.0), np.maximum(across, 0.0))
    return gaps


def _left(enter: Array, leave: Array) -> Array:
    """[n]: where rays leave the last of their boxes; inf where they are never in it."""
    return np.where((enter <= leave) & (leave > 0), leave, np.inf)[:, -1]


def _spans(boxes: Array, eye: Array, rays: Array) -> tuple[Array, Array]:
    """[n, k] each: where rays come into their boxes and leave them, in lengths of the ray (out of order: never)."""
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
