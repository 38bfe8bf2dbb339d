"""Navigation grid of a scene for a robot of a given size: clearances, distance fields and shortest feasible paths.

Clearance is the exact distance to walls, objects and the floor's edge, sampled on a grid. Distances are computed over
free cells with 16 neighbours (error at most 2.8 % before smoothing). A path is then shortened like a taut string.
"""

from __future__ import annotations

import itertools
from functools import cached_property, lru_cache
from math import ceil, cos, floor, hypot, sin

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra

from sim_hil.scene.scene import Box, Scene, SceneError, Terrain, Vec2

Array = NDArray[np.float64]

CLEARANCE_CAP_M = 2.0  # largest stored clearance; larger ones are equivalent
MAX_STEP_M = 0.06  # height difference between cells above which there is an edge; the scenes' bumps are 5 cm
_SNAP_M = 1.0  # largest distance from a blocked start or goal to the free cell that replaces it
_HAIR_M = 1e-6  # tolerance, so that a point placed exactly at the limit is free
# One of each pair of opposite steps to the 16 neighbours (columns, rows), and the cells that it passes.
_STEPS: tuple[tuple[int, int, tuple[Vec2, ...]], ...] = (
    (1, 0, ()),
    (0, 1, ()),
    (1, 1, ()),
    (1, -1, ()),
    (2, 1, ((1, 0), (1, 1))),
    (1, 2, ((0, 1), (1, 1))),
    (2, -1, ((1, 0), (1, -1))),
    (1, -2, ((0, -1), (1, -1))),
)


class NavGrid:
    """Free space of a scene for a robot that needs `clearance_m` (radius plus margin) around its centre.

    `height_m`: objects that begin above this height are no obstacles. `max_step_m`: higher steps of the ground are
    obstacles. `clearances`: distance from each cell's centre to the nearest obstacle [rows, columns], m, capped,
    negative inside one. `free`: whether the robot's centre may be in each cell [rows, columns]. Raises SceneError for a
    scene without room, ValueError for other values.
    """

    def __init__(
        self, scene: Scene, *, clearance_m: float, resolution_m: float = 0.1, height_m: float = 0.8,
        max_step_m: float = MAX_STEP_M,
    ) -> None:  # fmt: skip
        if not (0 <= clearance_m < CLEARANCE_CAP_M and 0.02 <= resolution_m <= 1.0):
            raise ValueError(
                f"navigation grid: expected a clearance of 0..{CLEARANCE_CAP_M} m and cells of 0.02..1 m,"
                f" found {clearance_m} and {resolution_m}"
            )
        (x0, y0), (x1, y1) = scene.floor_min_m, scene.floor_max_m
        self.required_m = clearance_m
        self.resolution_m = resolution_m
        self.origin_m = (x0, y0)
        self.shape = (ceil((y1 - y0) / resolution_m), ceil((x1 - x0) / resolution_m))
        boxes = [box for _, box in scene.obstacles() if box.centre_m[2] - box.size_m[2] / 2 < height_m]
        self.clearances = self._measure(boxes, (x1, y1))
        self._keep_off_edges(scene.terrain, max_step_m)
        self.free = self.clearances >= clearance_m - _HAIR_M
        if not self.free.any():
            raise SceneError(
                f"scene {scene.name}: expected room for a clearance of {clearance_m} m, found none; enlarge the floor "
                "or move its objects apart"
            )
        # Row and column of the nearest free cell of each cell [2, rows, columns].
        self._nearest = distance_transform_edt(~self.free, return_distances=False, return_indices=True)
        self._trees: dict[tuple[int, int], tuple[Array, NDArray[np.int32]]] = {}

    def _centres(self, rows: slice, columns: slice) -> tuple[Array, Array]:
        x = self.origin_m[0] + (np.arange(columns.start, columns.stop) + 0.5) * self.resolution_m
        y = self.origin_m[1] + (np.arange(rows.start, rows.stop) + 0.5) * self.resolution_m
        return x[None, :], y[:, None]

    def _window(self, low: Vec2, high: Vec2) -> tuple[slice, slice]:
        """Return the rows and columns between two corners."""
        spans = []
        for axis, limit in ((1, self.shape[0]), (0, self.shape[1])):
            first = floor((low[axis] - self.origin_m[axis]) / self.resolution_m)
            last = ceil((high[axis] - self.origin_m[axis]) / self.resolution_m)
            spans.append(slice(min(max(first, 0), limit), min(max(last, 0), limit)))
        return spans[0], spans[1]

    def _measure(self, boxes: list[Box], far_corner: Vec2) -> Array:
        x, y = self._centres(slice(0, self.shape[0]), slice(0, self.shape[1]))
        edge_x = np.minimum(x - self.origin_m[0], far_corner[0] - x)
        edge_y = np.minimum(y - self.origin_m[1], far_corner[1] - y)
        gaps = np.minimum(np.minimum(edge_x, edge_y), CLEARANCE_CAP_M)
        for box in boxes:
            corners = np.array(box.corners())
            low, high = corners.min(axis=0) - CLEARANCE_CAP_M, corners.max(axis=0) + CLEARANCE_CAP_M
            rows, columns = self._window((low[0], low[1]), (high[0], high[1]))
            if rows.start >= rows.stop or columns.start >= columns.stop:
                continue
            x, y = self._centres(rows, columns)
            gaps[rows, columns] = np.minimum(gaps[rows, columns], _box_gaps(box, x, y))
        return gaps

    def _keep_off_edges(self, terrain: tuple[Terrain, ...], max_step_m: float) -> None:
        """Reduce the clearances near edges, where the ground changes by more than a step."""
        if not terrain:
            return
        ground = np.zeros(self.shape)
        for piece in terrain:
            corners = np.array(piece.corners())
            (x0, y0), (x1, y1) = corners.min(axis=0), corners.max(axis=0)
            rows, columns = self._window((x0, y0), (x1, y1))
            x, y = self._centres(rows, columns)
            dx, dy = x - piece.position_m[0], y - piece.position_m[1]
            c, s = cos(piece.heading_rad), sin(piece.heading_rad)
            along, across = c * dx + s * dy, c * dy - s * dx
            inside = (np.abs(along) <= piece.size_m[0] / 2) & (np.abs(across) <= piece.size_m[1] / 2)
            profile = np.array(piece.profile())
            height = piece.position_m[2] + np.interp(along, profile[:, 0], profile[:, 1])
            ground[rows, columns] = np.where(inside, np.maximum(ground[rows, columns], height), ground[rows, columns])
        edge = np.zeros(self.shape, dtype=bool)
        for axis in (0, 1):
            steep = np.abs(np.diff(ground, axis=axis)) > max_step_m
            before, after = [slice(None)] * 2, [slice(None)] * 2
            before[axis], after[axis] = slice(None, -1), slice(1, None)
            edge[tuple(before)] |= steep
            edge[tuple(after)] |= steep
        if edge.any():
            # An edge lies between two marked cells: half a cell from either centre.
            gaps = distance_transform_edt(~edge) * self.resolution_m + 0.5 * self.resolution_m
            gaps[edge] = 0.5 * self.resolution_m
            self.clearances = np.minimum(self.clearances, gaps)

    @cached_property
    def graph(self) -> tuple[NDArray[np.int32], NDArray[np.int64], csr_matrix]:
        """Ids of the free cells [rows, columns], their rows and columns [n, 2], and the graph of steps [n, n], m."""
        ids, source, target, length = links(self.free, self.resolution_m)
        cells = np.argwhere(self.free)
        return ids, cells, csr_matrix((length, (source, target)), shape=(len(cells), len(cells)))

    def cell(self, x_m: float, y_m: float) -> tuple[int, int]:
        """Return row and column of the cell that contains a point (the nearest cell for a point off the floor)."""
        column = floor((x_m - self.origin_m[0]) / self.resolution_m)
        row = floor((y_m - self.origin_m[1]) / self.resolution_m)
        return min(max(row, 0), self.shape[0] - 1), min(max(column, 0), self.shape[1] - 1)

    def centre(self, row: int, column: int) -> Vec2:
        """Return the centre of a cell, m."""
        x = self.origin_m[0] + (column + 0.5) * self.resolution_m
        return (x, self.origin_m[1] + (row + 0.5) * self.resolution_m)

    def free_cell(self, x_m: float, y_m: float) -> tuple[int, int]:
        """Return row and column of the free cell nearest to a point."""
        row, column = self.cell(x_m, y_m)
        return int(self._nearest[0, row, column]), int(self._nearest[1, row, column])

    def nearest_free(self, x_m: float, y_m: float) -> Vec2 | None:
        """Return the point if it is free, else the nearest free cell's centre within 1 m, else None."""
        if self.is_free(x_m, y_m):
            return (x_m, y_m)
        point = self.centre(*self.free_cell(x_m, y_m))
        return point if hypot(point[0] - x_m, point[1] - y_m) <= _SNAP_M else None

    @cached_property
    def _spaces(self) -> NDArray[np.int32]:
        """Number of the connected space that each free cell belongs to [n]."""
        return np.asarray(connected_components(self.graph[2], directed=False)[1])

    def space(self, x_m: float, y_m: float) -> int:
        """Return the number of the connected space of the free cell nearest to a point; paths stay in one space."""
        return int(self._spaces[self.graph[0][self.free_cell(x_m, y_m)]])

    def nearest_in_largest_space(self, x_m: float, y_m: float) -> Vec2:
        """Return the nearest cell's centre in the largest connected space.

        The nearest free cell may lie in a pocket between furniture, from which no path leads anywhere.
        """
        cells = self.graph[1][self._spaces == np.bincount(self._spaces).argmax()]
        centres = np.array(self.origin_m) + (cells[:, ::-1] + 0.5) * self.resolution_m
        x, y = centres[int(np.hypot(*(centres - (x_m, y_m)).T).argmin())]
        return (float(x), float(y))

    def is_free(self, x_m: float, y_m: float) -> bool:
        """Return whether the robot's centre may be at a point."""
        return self.clearance_m(x_m, y_m) >= self.required_m - _HAIR_M

    def clearance_m(self, x_m: float, y_m: float) -> float:
        """Return the distance from a point to the nearest obstacle or floor edge, m, at most 2; negative inside."""
        return float(self.clearances_at(np.array(((x_m, y_m),)))[0])

    def clearances_at(self, points_m: Array) -> Array:
        """Return `clearance_m` of many points: [n, 2] -> [n]."""
        grid = self.clearances
        u = (points_m[..., 0] - self.origin_m[0]) / self.resolution_m - 0.5
        v = (points_m[..., 1] - self.origin_m[1]) / self.resolution_m - 0.5
        outside = (u < -0.5) | (v < -0.5) | (u > self.shape[1] - 0.5) | (v > self.shape[0] - 0.5)
        # Called with few points, where numpy.clip takes longer than the arithmetic.
        column = np.minimum(np.maximum(u.astype(np.int64), 0), self.shape[1] - 2)
        row = np.minimum(np.maximum(v.astype(np.int64), 0), self.shape[0] - 2)
        a, b = np.minimum(np.maximum(u - column, 0.0), 1.0), np.minimum(np.maximum(v - row, 0.0), 1.0)
        rest, right, below = 1 - a, column + 1, row + 1
        low = grid[row, column] * rest + grid[row, right] * a
        high = grid[below, column] * rest + grid[below, right] * a
        return np.asarray(np.where(outside, -1.0, low * (1 - b) + high * b))

    def _tree(self, goal: Vec2) -> tuple[Array, NDArray[np.int32]] | None:
        """Return the distance of every free cell to the goal and its next cell; None if the goal is not free."""
        point = self.nearest_free(*goal)
        if point is None:
            return None
        row, column = self.free_cell(*point)
        if (row, column) not in self._trees:
            if len(self._trees) >= 32:
                self._trees.pop(next(iter(self._trees)))
            ids, _, steps = self.graph
            self._trees[row, column] = dijkstra(
                steps, directed=False, indices=int(ids[row, column]), return_predecessors=True
            )
        return self._trees[row, column]

    def distance_field(self, goal: Vec2) -> Array:
        """Return the path length over free cells to the goal [rows, columns], m; inf where there is no path."""
        field = np.full(self.shape, np.inf)
        tree = self._tree(goal)
        if tree is not None:
            field[self.free] = tree[0]
        return field

    def field_at(self, field: Array, x_m: float, y_m: float) -> float:
        """Return a field's value at the nearest free cell of a point; inf if there is none within 1 m."""
        row, column = self.free_cell(x_m, y_m)
        cx, cy = self.centre(row, column)
        if hypot(cx - x_m, cy - y_m) > _SNAP_M:
            return float("inf")
        return float(field[row, column])

    def blended_at(self, field: Array, x_m: float, y_m: float) -> float:
        """Return a field's value at a point, interpolated between the surrounding free cells (continuous)."""
        u = (x_m - self.origin_m[0]) / self.resolution_m - 0.5
        v = (y_m - self.origin_m[1]) / self.resolution_m - 0.5
        total = weights = 0.0
        for row, column in itertools.product((floor(v), floor(v) + 1), (floor(u), floor(u) + 1)):
            if 0 <= row < self.shape[0] and 0 <= column < self.shape[1] and np.isfinite(field[row, column]):
                weight = (1 - abs(row - v)) * (1 - abs(column - u))
                total, weights = total + weight * float(field[row, column]), weights + weight
        return total / weights if weights > 0 else self.field_at(field, x_m, y_m)

    def path(self, start: Vec2, goal: Vec2) -> list[Vec2] | None:
        """Return the points of a shortest feasible path from start to goal, both included; None if there is none."""
        first, last, tree = self.nearest_free(*start), self.nearest_free(*goal), self._tree(goal)
        if first is None or last is None or tree is None:
            return None
        _, onwards = tree
        ids, cells, _ = self.graph
        node = int(ids[self.free_cell(*first)])
        if not np.isfinite(tree[0][node]):
            return None
        points = [first]
        while node >= 0:
            points.append(self.centre(*(int(v) for v in cells[node])))
            node = int(onwards[node])
        points.append(last)
        taut = self._pulled(points)
        return [*([start] if first != start else []), *taut, *([goal] if last != goal else [])]

    def distance_m(self, start: Vec2, goal: Vec2) -> float:
        """Return the length of the shortest feasible path, m; inf if there is none."""
        points = self.path(start, goal)
        return float("inf") if points is None else length_m(points)

    def sees(self, a: Vec2, b: Vec2) -> bool:
        """Return whether the straight line between two points is free."""
        count = max(2, ceil(hypot(b[0] - a[0], b[1] - a[1]) / (0.5 * self.resolution_m)) + 1)
        share, rest = _shares(count)
        points = np.array(a) * rest + np.array(b) * share
        return bool((self.clearances_at(points) >= self.required_m - _HAIR_M).all())

    def _pulled(self, points: list[Vec2]) -> list[Vec2]:
        """Shorten a chain of cells like a taut string: skip points, then move every corner inwards."""
        taut = self._shortened(points)
        for _ in range(6):
            before = length_m(taut)
            for index in range(1, len(taut) - 1):
                taut[index] = self._drawn(taut[index - 1], taut[index], taut[index + 1])
            taut = self._shortened(taut)
            if before - length_m(taut) < 1e-3:
                break
        return taut

    def _shortened(self, points: list[Vec2]) -> list[Vec2]:
        """Return the path without the points that a straight free line can skip."""
        kept, at = [points[0]], 0
        while at < len(points) - 1:
            step, good = 1, 1
            # Doubling, then bisection: a blocked line usually stays blocked further on.
            while at + step < len(points) and self.sees(points[at], points[at + step]):
                good, step = step, step * 2
            low, high = good, min(step, len(points) - at)
            while high - low > 1:
                middle = (low + high) // 2
                if self.sees(points[at], points[at + middle]):
                    low = middle
                else:
                    high = middle
            at += low
            kept.append(points[at])
        return kept

    def _drawn(self, before: Vec2, corner: Vec2, after: Vec2) -> Vec2:
        """Return a corner moved towards the line between its neighbours as far as both segments stay free."""
        dx, dy = after[0] - before[0], after[1] - before[1]
        square = dx * dx + dy * dy
        if square == 0:
            return corner
        share = ((corner[0] - before[0]) * dx + (corner[1] - before[1]) * dy) / square
        share = min(max(share, 0.0), 1.0)
        target = (before[0] + share * dx, before[1] + share * dy)
        low, high, best = 0.0, 1.0, corner
        for _ in range(7):
            middle = 0.5 * (low + high)
            point = (corner[0] + middle * (target[0] - corner[0]), corner[1] + middle * (target[1] - corner[1]))
            if self.sees(before, point) and self.sees(point, after):
                low, best = middle, point
            else:
                high = middle
        return best


@lru_cache(maxsize=1024)
def _shares(count: int) -> tuple[Array, Array]:
    """Return the shares [count, 1] of a line's end and of its start at points from the start to the end."""
    share = np.linspace(0.0, 1.0, count)[:, None]
    return share, 1 - share


def links(
    free: NDArray[np.bool_], resolution_m: float
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32], Array]:
    """Link free cells with their 16 neighbours: return ids [rows, columns] (-1: not free), from, to, length (m).

    Each pair of cells occurs once.
    """
    ids = np.full(free.shape, -1, dtype=np.int32)
    ids[free] = np.arange(int(free.sum()), dtype=np.int32)
    sources, targets, lengths = [], [], []
    for columns, rows, passed in _STEPS:
        there = _shifted(ids, rows, columns)
        linked = (ids >= 0) & (there >= 0)
        for side_columns, side_rows in passed:
            linked &= _shifted(ids, int(side_rows), int(side_columns)) >= 0
        sources.append(ids[linked])
        targets.append(there[linked])
        lengths.append(np.full(len(sources[-1]), hypot(columns, rows) * resolution_m))
    return ids, np.concatenate(sources), np.concatenate(targets), np.concatenate(lengths)


def length_m(points: list[Vec2]) -> float:
    """Return the length of a polyline, m."""
    return sum(hypot(b[0] - a[0], b[1] - a[1]) for a, b in itertools.pairwise(points))


def _shifted(ids: NDArray[np.int32], rows: int, columns: int) -> NDArray[np.int32]:
    """Return for each cell the id of the cell at an offset of rows and columns; -1 off the grid."""
    out = np.full_like(ids, -1)
    height, width = ids.shape
    to_rows = slice(max(-rows, 0), height - max(rows, 0))
    from_rows = slice(max(rows, 0), height - max(-rows, 0))
    to_columns = slice(max(-columns, 0), width - max(columns, 0))
    from_columns = slice(max(columns, 0), width - max(-columns, 0))
    out[to_rows, to_columns] = ids[from_rows, from_columns]
    return out


def _box_gaps(box: Box, x: Array, y: Array) -> Array:
    """Return the signed distance from points to a box's outline on the floor, m; negative inside."""
    dx, dy = x - box.centre_m[0], y - box.centre_m[1]
    c, s = box.axis
    along = np.abs(dx * c + dy * s) - box.size_m[0] / 2
    across = np.abs(dy * c - dx * s) - box.size_m[1] / 2
    outside = np.hypot(np.maximum(along, 0.0), np.maximum(across, 0.0))
    return np.asarray(outside + np.minimum(np.maximum(along, across), 0.0))
