"""Route planner of the expert: the cheapest path to the goal, with clearance to walls and around standing people.

The search uses cells twice as wide as the navigation grid's; each is represented by its point with most clearance.
This makes a search of the whole scene, with a price for standing people, fast enough to run twice a second.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from sim_hil.scene.nav_grid import NavGrid, links
from sim_hil.scene.scene import Scene, Vec2

Array = NDArray[np.float64]

SPACING_M: Final = 0.1  # between the points of a route
ROOM_M: Final = 0.5  # clearance beyond the required one below which a metre costs more
_WALL_PRICE: Final = 3.0  # extra price of a metre directly along a wall
_STREET_PRICE: Final = 4.0  # factor on the price of a metre of street outside the crossings
# Distance from a standing person, m, and the extra price of a metre there; passing between two people is possible.
_CROWD: Final = ((0.5, 60.0), (0.7, 12.0), (1.4, 0.0))
_WAY_M: Final = 2.0  # distance from the prescribed route within which a cell counts as on it
_STRAY_PRICE: Final = 5.0  # extra price of a metre at twice that distance
_SHORT_PRICE: Final = 4.0  # price of each metre between the route's end and the goal
_SHUFFLE_M: Final = 0.25  # movements of a standing person below this do not trigger a new search
_NO_ROOM: Final = 1000.0  # price of a metre without clearance
_DETOUR: Final = 1.01  # a straight segment may cost up to this factor more than the segment it replaces
_KEEP: Final = (1.2, 2.5)  # the previous route is kept while it costs at most 1.2 times the new one plus 2.5


class PlannerGround:
    """The part of a planner that does not depend on the goal; the planners of one scene and robot may share it.

    `grid`: the robot's navigation grid. `prices`: of a metre in each of its cells. `ids`: node of each coarse cell, -1
    without one. `nodes`: the nodes' points [n, 2], m; `cells`: their rows and columns in the grid. `links`: lengths, m.
    """

    def __init__(self, scene: Scene, grid: NavGrid) -> None:
        self.grid = grid
        self.prices = self._static_price(scene)
        self._coarsen()

    def _static_price(self, scene: Scene) -> Array:
        lack = np.clip(1.0 - (self.grid.clearances - self.grid.required_m) / ROOM_M, 0.0, 1.0)
        price = 1.0 + _WALL_PRICE * lack * lack
        street = np.zeros(self.grid.shape, np.uint8)
        # Crossings come last, because they overlap streets.
        for kind, value in (("street", 1), ("crossing", 0)):
            for area in scene.areas:
                if area.kind == kind:
                    cells = [self.grid.cell(x, y)[::-1] for x, y in area.polygon]
                    cv2.fillPoly(street, [np.array(cells, np.int32)], value)
        return np.asarray(np.where(street > 0, price * _STREET_PRICE, price))

    def _coarsen(self) -> None:
        """Merge blocks of 2 x 2 cells: free if one of them is, represented by the one with most clearance."""
        grid = self.grid
        rows, columns = (size + size % 2 for size in grid.shape)
        room = np.full((rows, columns), -np.inf)
        room[: grid.shape[0], : grid.shape[1]] = np.where(grid.free, grid.clearances, -np.inf)
        quads = room.reshape(rows // 2, 2, columns // 2, 2).transpose(0, 2, 1, 3).reshape(rows // 2, columns // 2, 4)
        pick = np.argmax(quads, axis=2)
        free = np.isfinite(quads.max(axis=2))
        row = 2 * np.arange(rows // 2)[:, None] + pick // 2
        column = 2 * np.arange(columns // 2)[None, :] + pick % 2
        self.ids, source, target, _ = links(free, 2 * grid.resolution_m)
        self.cells = row[free], column[free]
        self.nodes = np.stack(
            (
                grid.origin_m[0] + (column[free] + 0.5) * grid.resolution_m,
                grid.origin_m[1] + (row[free] + 0.5) * grid.resolution_m,
            ),
            axis=1,
        )
        gaps = self.nodes[source] - self.nodes[target]
        count = len(self.nodes)
        self.links = csr_matrix((np.hypot(gaps[:, 0], gaps[:, 1]), (source, target)), shape=(count, count))
        self.link_source = np.repeat(np.arange(count), np.diff(self.links.indptr))


class RoutePlanner:
    """Planner of routes to one goal.

    `near_m`: a route may end within this distance of the goal if people occupy it. `prescribed`: points (m) of a
    preferred route.
    """

    def __init__(
        self, ground: PlannerGround, goal_xy: Vec2, near_m: float = 0.0, prescribed: Sequence[Vec2] = ()
    ) -> None:
        self.grid = ground.grid
        self._goal = goal_xy
        self._price = ground.prices * self._stray_price(prescribed)
        self._ids, self._nodes = ground.ids, ground.nodes
        self._links, self._link_source = ground.links, ground.link_source
        self._node_price = self._price[ground.cells]
        self._goal_node = self._node(*self._goal)
        self._ends, self._end_prices = self._ends_near(near_m)
        self._costs, self._onwards = self._search(np.zeros((0, 2)))
        self._empty_costs = self._costs
        self._searched = b""

    def _stray_price(self, prescribed: Sequence[Vec2]) -> Array:
        """Return the price factor of each cell for leaving the prescribed route."""
        off = np.ones(self.grid.shape, np.uint8)
        if not prescribed:
            return off.astype(np.float64)
        cells = [self.grid.cell(x, y)[::-1] for x, y in prescribed]
        cv2.polylines(off, [np.array(cells, np.int32)], isClosed=False, color=0)
        gap_m = cv2.distanceTransform(off, cv2.DIST_L2, 5) * self.grid.resolution_m
        return np.asarray(1.0 + _STRAY_PRICE * np.clip(gap_m / _WAY_M - 1.0, 0.0, 1.0), np.float64)

    def _node(self, x_m: float, y_m: float) -> int:
        """Return the node of the free cell nearest to a point; -1 if there is none nearby."""
        point = self.grid.nearest_free(x_m, y_m)
        if point is None:
            return -1
        row, column = self.grid.free_cell(*point)
        return int(self._ids[row // 2, column // 2])

    def _ends_near(self, near_m: float) -> tuple[NDArray[np.int64], Array]:
        """Return the nodes at which a route may end, and the extra price of each compared with the goal."""
        if self._goal_node < 0:
            return np.zeros(0, np.int64), np.zeros(0)
        gaps = np.hypot(self._nodes[:, 0] - self._goal[0], self._nodes[:, 1] - self._goal[1])
        # A place behind a wall is not near the goal, however short the straight line.
        ways = dijkstra(self._links, directed=False, indices=self._goal_node, limit=2 * near_m + 0.1)
        ends = np.flatnonzero((gaps < near_m) & (ways < 1.5 * near_m))
        ends = np.union1d(ends, [self._goal_node])
        return ends, np.where(ends == self._goal_node, 0.0, _SHORT_PRICE * gaps[ends])

    def _search(self, standing: Array) -> tuple[Array, NDArray[np.int32]]:
        """Return each node's cost to the goal and its next node, with people standing at [k, 2] m."""
        if self._goal_node < 0:
            return np.full(len(self._nodes), np.inf), np.full(len(self._nodes), -1, np.int32)
        price = self._node_price + _crowd_price(self._nodes, standing)
        joins = self._links
        data = joins.data * 0.5 * (price[self._link_source] + price[joins.indices])
        # An additional node is linked to every possible end.
        count, total = len(self._nodes), joins.nnz + len(self._ends)
        priced = csr_matrix(
            (
                np.concatenate((data, self._end_prices + price[self._ends] * 1e-6)),
                np.concatenate((joins.indices, self._ends)),
                np.append(joins.indptr, total),
            ),
            shape=(count + 1, count + 1),
        )
        costs, onwards = dijkstra(priced, directed=False, indices=count, return_predecessors=True)
        return costs[:count], np.where(onwards[:count] == count, -1, onwards[:count])

    def reachable(self, x_m: float, y_m: float) -> bool:
        """Return whether a path leads from a point to the goal."""
        return bool(np.isfinite(self.left(x_m, y_m)))

    def left(self, x_m: float, y_m: float) -> float:
        """Return the price of the path left to the goal without people; a metre with clearance costs 1."""
        node = self._node(x_m, y_m)
        return float(self._empty_costs[node]) if node >= 0 else float("inf")

    def route(self, start: Vec2, standing: Array, reach_m: float, before: Array | None = None) -> Array:
        """Return points [n, 2] SPACING_M apart from `start` towards the goal, up to `reach_m`, around people.

        `standing` [k, 2]: positions of standing people, m. `before`: the rest of the previous route, kept unless the
        new one is clearly better. Without a path, the result is only the start.
        """
        searched = np.round(standing / _SHUFFLE_M).tobytes()
        if searched != self._searched:
            self._costs, self._onwards = self._search(standing)
            self._searched = searched
        node = self._node(*start)
        if node < 0 or not np.isfinite(self._costs[node]):
            return np.array([start])
        points, end = [start], node
        for _ in range(round(reach_m / (2 * self.grid.resolution_m))):
            points.append((float(self._nodes[end, 0]), float(self._nodes[end, 1])))
            if self._onwards[end] < 0:
                if end == self._goal_node:
                    points.append(self._goal)
                break
            end = int(self._onwards[end])
        fresh = self._relaxed(self._straightened(_spaced(points), standing))
        if before is None or len(before) < 5:
            return fresh
        kept = self._extended(before, reach_m)
        share, more = _KEEP
        worth = self._price_of(fresh, standing)
        return kept if self._price_of(kept, standing) <= share * worth + more else fresh

    def _extended(self, line: Array, reach_m: float) -> Array:
        """Return a route extended to `reach_m` along the newest search."""
        missing = reach_m - SPACING_M * (len(line) - 1)
        node = self._node(float(line[-1, 0]), float(line[-1, 1]))
        if missing < 1.0 or node < 0 or hypot(*(line[-1] - np.array(self._goal))) < 2 * SPACING_M:
            return line
        points = [(float(line[-1, 0]), float(line[-1, 1]))]
        for _ in range(round(missing / (2 * self.grid.resolution_m))):
            before, node = node, int(self._onwards[node])
            if node < 0:
                if before == self._goal_node:
                    points.append(self._goal)
                break
            points.append((float(self._nodes[node, 0]), float(self._nodes[node, 1])))
        return np.vstack((line, self._relaxed(_spaced(points))[1:]))

    def _price_of(self, line: Array, standing: Array) -> float:
        """Return the price of a route and of the path from its end to the goal."""
        node = self._node(float(line[-1, 0]), float(line[-1, 1]))
        rest = float(self._costs[node]) if node >= 0 else float("inf")
        return float(np.sum(self._prices_at(line, standing))) * SPACING_M + rest

    def _straightened(self, line: Array, standing: Array) -> Array:
        """Return the route with the grid's detours replaced by straight segments of at most the same price."""
        prices = self._prices_at(line, standing)
        paid = np.concatenate(((0.0,), np.cumsum(0.5 * (prices[1:] + prices[:-1])))) * SPACING_M

        def cheap(i: int, j: int) -> bool:
            a, b = line[i], line[j]
            points = a + (b - a) * np.linspace(0.0, 1.0, j - i + 1)[:, None]
            cost = float(np.mean(self._prices_at(points, standing))) * hypot(b[0] - a[0], b[1] - a[1])
            return cost <= float(paid[j] - paid[i]) * _DETOUR + 1e-3

        corners, at, last = [0], 0, len(line) - 1
        while at < last:
            step = 4
            while step < last - at and cheap(at, at + step):
                step *= 2
            low, high = max(step // 2, 1), min(step, last - at)
            if high == last - at and cheap(at, last):
                low = high
            while high - low > 1:
                middle = (low + high) // 2
                low, high = (middle, high) if cheap(at, at + middle) else (low, middle)
            at = min(at + low, last)
            corners.append(at)
        return _spaced([(float(x), float(y)) for x, y in line[corners]])

    def _prices_at(self, points: Array, standing: Array) -> Array:
        """Return the price of a metre at each point [n, 2], people included; _NO_ROOM without clearance."""
        column = ((points[:, 0] - self.grid.origin_m[0]) / self.grid.resolution_m).astype(np.int64)
        row = ((points[:, 1] - self.grid.origin_m[1]) / self.grid.resolution_m).astype(np.int64)
        row, column = np.clip(row, 0, self.grid.shape[0] - 1), np.clip(column, 0, self.grid.shape[1] - 1)
        price = np.where(self.grid.free[row, column], self._price[row, column], _NO_ROOM)
        return np.asarray(price + _crowd_price(points, standing))

    def _relaxed(self, line: Array) -> Array:
        """Return the route with its corners rounded where clearance permits."""
        if len(line) < 5:
            return line
        rounded = _smooth(_smooth(line, 5), 3)
        fits = self.grid.clearances_at(rounded) >= self.grid.required_m - 0.02
        return np.asarray(np.where(fits[:, None], rounded, line))


def _crowd_price(points: Array, standing: Array) -> Array:
    """Return the extra price of a metre at each point [n, 2] due to standing people [k, 2]."""
    price = np.zeros(len(points))
    gaps_m, prices = zip(*_CROWD, strict=True)
    for x, y in standing:
        near = np.flatnonzero((np.abs(points[:, 0] - x) < gaps_m[-1]) & (np.abs(points[:, 1] - y) < gaps_m[-1]))
        gap = np.hypot(points[near, 0] - x, points[near, 1] - y)
        # The maximum, not the sum: a metre in a dense group costs no more than one through a single person.
        price[near] = np.maximum(price[near], np.interp(gap, gaps_m, prices))
    return price


def _spaced(points: list[Vec2]) -> Array:
    """Resample a polyline to points SPACING_M apart."""
    line = np.array(points)
    steps = np.hypot(*np.diff(line, axis=0).T) if len(line) > 1 else np.zeros(0)
    along = np.concatenate(((0.0,), np.cumsum(steps)))
    marks = np.arange(0.0, along[-1] + SPACING_M / 2, SPACING_M)
    return np.stack((np.interp(marks, along, line[:, 0]), np.interp(marks, along, line[:, 1])), axis=1)


def _smooth(line: Array, half: int) -> Array:
    """Return each point's mean over `half` neighbours on both sides; the ends stay fixed."""
    padded = np.vstack((np.repeat(line[:1], half, 0), line, np.repeat(line[-1:], half, 0)))
    sums = np.cumsum(np.vstack((np.zeros((1, 2)), padded)), axis=0)
    smooth = (sums[2 * half + 1 :] - sums[: -2 * half - 1]) / (2 * half + 1)
    # Towards the ends, where one side runs out, the mean would pull the line off its end points.
    inward = np.minimum(np.arange(len(line)), np.arange(len(line))[::-1])
    share = np.clip(inward / half, 0.0, 1.0)[:, None]
    return np.asarray(line * (1 - share) + smooth * share)
