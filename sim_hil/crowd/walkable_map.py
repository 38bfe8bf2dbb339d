"""Map for people: walkable floor, clearances, and shortest paths to destinations.

Clearances come from the navigation grid. Paths are computed on a coarser grid with higher cost beside walls and on
streets; for every destination, each cell stores the cell a few steps further on.
"""

from __future__ import annotations

from math import hypot, sqrt
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra

from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Scene, Vec2

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Cell = TypeVar("Cell", bound=np.generic)

BODY_RADIUS_M = 0.22
_REQUIRED_M = 0.30  # a person's radius plus a margin
_HEAD_M = 1.9  # objects that begin above this height are no obstacles
_KERB_M = 0.25  # height of a step that people can climb
_FINE_CELLS, _COARSE_CELLS = 150_000, 30_000
_AHEAD_M = 1.3
_WALL_PRICE, _WALL_PRICE_M = 2.0, 0.8  # extra price of a metre directly at a wall, and the distance where it ends
_STREET_PRICE = 6.0
_SIGHT_SAMPLES = 24
_NEIGHBOURS = ((1, 0), (0, 1), (1, 1), (1, -1))


class CrowdMap:
    """Clearances and paths of one scene. Raises ValueError if it has no walkable floor."""

    def __init__(self, scene: Scene) -> None:
        (x0, y0), (x1, y1) = scene.floor_min_m, scene.floor_max_m
        area = (x1 - x0) * (y1 - y0)
        fine = min(max(sqrt(area / _FINE_CELLS), 0.1), 0.2)
        grid = NavGrid(scene, clearance_m=_REQUIRED_M, resolution_m=fine, height_m=_HEAD_M, max_step_m=_KERB_M)
        self._fine, self._origin = fine, np.array(grid.origin_m)
        self._gaps = np.ascontiguousarray(grid.clearances)
        self._rows, self._columns = self._gaps.shape
        self._flat = self._gaps.ravel()
        self._skip = max(1, round(sqrt(area / _COARSE_CELLS) / fine))
        self._coarse = fine * self._skip
        self._ground = _ground(scene, self._gaps.shape, grid.origin_m, fine) if scene.terrain else None
        self._build_ways(scene)

    def _build_ways(self, scene: Scene) -> None:
        half, skip = self._skip // 2, self._skip
        gaps = self._gaps[half::skip, half::skip]
        self._shape = gaps.shape
        free = gaps >= _REQUIRED_M
        ids = np.full(gaps.shape, -1, dtype=np.int64)
        ids[free] = np.arange(int(free.sum()))
        price = 1.0 + _WALL_PRICE * np.clip(1.0 - gaps / _WALL_PRICE_M, 0.0, 1.0)
        price *= self._streets(scene)
        sources, targets, costs = [], [], []
        for dx, dy in _NEIGHBOURS:
            here, there = _pair(ids, dx, dy)
            middle = np.minimum(*_pair(gaps, dx, dy)) if skip == 1 else self._between(dx, dy)
            linked = (here >= 0) & (there >= 0) & (middle >= 0.8 * _REQUIRED_M)
            a, b = _pair(price, dx, dy)
            sources.append(here[linked])
            targets.append(there[linked])
            costs.append((hypot(dx, dy) * self._coarse * 0.5 * (a + b))[linked])
        source, target, cost = np.concatenate(sources), np.concatenate(targets), np.concatenate(costs)
        count = int(free.sum())
        graph = csr_matrix((cost, (source, target)), shape=(count, count))
        _, parts = connected_components(graph, directed=False)
        # People only use the largest connected part; other parts cannot be reached.
        largest = int(np.argmax(np.bincount(parts))) if count else 0
        self._graph = graph
        self._cells = np.argwhere(free)
        self._home = parts == largest
        self._calm = self._streets(scene)[free] == 1.0
        inside = np.zeros(gaps.shape, dtype=np.uint8)
        inside[self._cells[self._home, 0], self._cells[self._home, 1]] = 1
        if not inside.any():
            raise ValueError(f"people: scene {scene.name} has no room for anybody")
        # For each cell the nearest cell of that part, so that people pushed off it can return.
        _, labels = cv2.distanceTransformWithLabels(
            1 - inside, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
        )
        lookup = np.zeros(int(labels.max()) + 1, dtype=np.int64)
        lookup[labels[inside > 0]] = ids[inside > 0]
        self._node = lookup[labels].ravel()

    def _between(self, dx: int, dy: int) -> Array:
        """Return the clearance half way between each coarse cell and its neighbour."""
        half, skip = self._skip // 2, self._skip
        rows = half + skip * np.arange(self._shape[0])
        columns = half + skip * np.arange(self._shape[1])
        middle_rows = np.clip(rows + round(dy * skip / 2), 0, self._rows - 1)
        middle_columns = np.clip(columns + round(dx * skip / 2), 0, self._columns - 1)
        middles = self._gaps[np.ix_(middle_rows, middle_columns)]
        return _pair(middles, dx, dy)[0]

    def _streets(self, scene: Scene) -> Array:
        """Return the price factor of each cell: higher on streets, except on crossings."""
        prices = np.ones(self._shape, dtype=np.float32)
        for kind, price in (("street", _STREET_PRICE), ("crossing", 1.0)):
            for area in scene.areas:
                if area.kind == kind:
                    corners = (np.array(area.polygon) - self._origin) / self._coarse - 0.5
                    cv2.fillPoly(prices, [np.round(corners).astype(np.int32)], price)
        return prices.astype(np.float64)

    @property
    def cell_m2(self) -> float:
        """Area of one walkable cell."""
        return self._coarse * self._coarse

    # -- clearances ------------------------------------------------------------------------------------------------

    def gaps_at(self, x: Array, y: Array) -> Array:
        """Return the distance to the nearest obstacle for points of any shape, m, with the grid's resolution."""
        column = ((x - self._origin[0]) * (1.0 / self._fine)).astype(np.int64)
        row = ((y - self._origin[1]) * (1.0 / self._fine)).astype(np.int64)
        column = np.minimum(np.maximum(column, 0), self._columns - 1)
        row = np.minimum(np.maximum(row, 0), self._rows - 1)
        return np.asarray(self._flat[row * self._columns + column])

    def slopes_at(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Return the distance to the nearest obstacle, m, and its gradient (x, y; not normalised)."""
        g00, g10, g01, g11, a, b = self._around(self._flat, x, y)
        low, high = g00 + (g10 - g00) * a, g01 + (g11 - g01) * a
        slope_x = (g10 - g00) + ((g11 - g01) - (g10 - g00)) * b
        return low + (high - low) * b, slope_x, high - low

    def heights_at(self, x: Array, y: Array) -> Array:
        """Return the height of the ground [n], m; a kerb is climbed within one cell of the grid."""
        if self._ground is None:
            return np.zeros(len(x))
        g00, g10, g01, g11, a, b = self._around(self._ground, x, y)
        low, high = g00 + (g10 - g00) * a, g01 + (g11 - g01) * a
        return low + (high - low) * b

    def _around(self, flat: Array, x: Array, y: Array) -> tuple[Array, Array, Array, Array, Array, Array]:
        """Return a grid's values at the four cells around each point, and the interpolation weights."""
        u = (x - self._origin[0]) * (1.0 / self._fine) - 0.5
        v = (y - self._origin[1]) * (1.0 / self._fine) - 0.5
        u = np.minimum(np.maximum(u, 0.0), self._columns - 1.001)
        v = np.minimum(np.maximum(v, 0.0), self._rows - 1.001)
        column, row = u.astype(np.int64), v.astype(np.int64)
        first = row * self._columns + column
        above = first + self._columns
        return flat[first], flat[first + 1], flat[above], flat[above + 1], u - column, v - row

    # -- destinations ----------------------------------------------------------------------------------------------

    def nodes_at(self, x: Array, y: Array) -> Ints:
        """Return the walkable cell nearest to each point."""
        column = ((x - self._origin[0]) * (1.0 / self._coarse)).astype(np.int64)
        row = ((y - self._origin[1]) * (1.0 / self._coarse)).astype(np.int64)
        column = np.minimum(np.maximum(column, 0), self._shape[1] - 1)
        row = np.minimum(np.maximum(row, 0), self._shape[0] - 1)
        return np.asarray(self._node[row * self._shape[1] + column])

    def point(self, node: int) -> Vec2:
        """Return the centre of a walkable cell, m."""
        row, column = self._cells[node]
        offset = (self._skip // 2 + 0.5) * self._fine
        return (
            float(self._origin[0] + column * self._coarse + offset),
            float(self._origin[1] + row * self._coarse + offset),
        )

    def walkable(self) -> tuple[Array, Array, Array]:
        """Return x, y and clearance, m, of every reachable cell outside streets."""
        cells = self._cells[self._home & self._calm]
        offset = (self._skip // 2 + 0.5) * self._fine
        x = self._origin[0] + cells[:, 1] * self._coarse + offset
        y = self._origin[1] + cells[:, 0] * self._coarse + offset
        return x, y, self._gaps[cells[:, 0] * self._skip + self._skip // 2, cells[:, 1] * self._skip + self._skip // 2]

    def set_destinations(self, points: list[Vec2]) -> None:
        """Compute the paths to these points, which are addressed by their indices from now on."""
        goals = self.nodes_at(np.array([p[0] for p in points]), np.array([p[1] for p in points]))
        costs, onwards = dijkstra(self._graph, directed=False, indices=goals, return_predecessors=True)
        jumps = max(1, round(_AHEAD_M / self._coarse))
        tables = []
        for goal, nodes in zip(goals, onwards, strict=True):
            step = np.where(nodes < 0, np.arange(len(nodes)), nodes)
            step[goal] = goal
            ahead = step
            for _ in range(jumps - 1):
                ahead = step[ahead]
            tables.append(ahead.astype(np.int32))
        self._table = np.stack(tables)
        self._costs: NDArray[np.float32] = costs.astype(np.float32)
        offset = (self._skip // 2 + 0.5) * self._fine
        self._x = self._origin[0] + self._cells[:, 1] * self._coarse + offset
        self._y = self._origin[1] + self._cells[:, 0] * self._coarse + offset

    def ahead(self, destinations: Ints, x: Array, y: Array) -> tuple[Array, Array]:
        """Return the point to walk towards, about 1.3 m ahead on the path to each of `destinations`."""
        nodes = self._table[destinations, self.nodes_at(x, y)]
        return self._x[nodes], self._y[nodes]

    def ways_m(self, x: float, y: float) -> Array:
        """Return the cost of the path to each destination, in m of open floor; inf if there is none."""
        node = int(self.nodes_at(np.array((x,)), np.array((y,)))[0])
        return self._costs[:, node].astype(np.float64)

    def sees(self, ax: Array, ay: Array, bx: Array, by: Array) -> NDArray[np.bool_]:
        """Return whether the line between points a and b is free [n]."""
        shares = np.linspace(0.0, 1.0, _SIGHT_SAMPLES)
        dx, dy = bx - ax, by - ay
        gaps = self.gaps_at(ax[:, None] + dx[:, None] * shares, ay[:, None] + dy[:, None] * shares)
        # Half the distance between samples, so that a thin wall between two samples is detected.
        reach = np.maximum(np.hypot(dx, dy) * (0.5 / (_SIGHT_SAMPLES - 1)), 0.06)
        return np.asarray(gaps.min(axis=1) > reach)


def _ground(scene: Scene, shape: tuple[int, int], origin: Vec2, resolution: float) -> Array:
    """Return the height of the ground at every cell's centre [rows * columns], m."""
    heights = np.zeros(shape)
    y, x = (origin[axis] + (np.arange(shape[1 - axis]) + 0.5) * resolution for axis in (1, 0))
    for terrain in scene.terrain:
        corners = np.array(terrain.corners())
        rows = np.flatnonzero((y >= corners[:, 1].min()) & (y <= corners[:, 1].max()))
        columns = np.flatnonzero((x >= corners[:, 0].min()) & (x <= corners[:, 0].max()))
        for row in rows:
            for column in columns:
                height = terrain.height_m(float(x[column]), float(y[row]))
                if height is not None:
                    heights[row, column] = max(heights[row, column], height)
    return heights.ravel()


def _pair(grid: NDArray[Cell], dx: int, dy: int) -> tuple[NDArray[Cell], NDArray[Cell]]:
    """Return the cells of a grid that have a neighbour at offset (dx, dy), and those neighbours."""
    rows, columns = grid.shape
    here_rows = slice(0, rows - dy) if dy >= 0 else slice(-dy, rows)
    there_rows = slice(dy, rows) if dy >= 0 else slice(0, rows + dy)
    return grid[here_rows, : columns - dx], grid[there_rows, dx:]
