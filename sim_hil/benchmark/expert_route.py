"""Where the expert means to go: the cheapest way to the goal with room to spare, led round people who stand in it.

One tree over the whole scene, built once, knows the way from everywhere. Twice a second a window around the robot is
searched anew with a price on the places that people take up, its border being worth what the tree says.
"""

from __future__ import annotations

from math import ceil, hypot
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from sim_hil.nav_grid import NavGrid, links
from sim_hil.scene import Scene, Vec2

Array = NDArray[np.float64]

WINDOW_M: Final = 6.0  # half the side of the window searched anew
SPACING_M: Final = 0.1  # between the points of a route
ROOM_M: Final = 0.5  # nearer than this beyond its clearance to a wall, a metre costs more
_WALL_PRICE: Final = 3.0  # a metre right along a wall costs so much more
_STREET_PRICE: Final = 4.0  # a metre of street, off the crossings, costs so many
_STANDING_PRICE: Final = 15.0  # a metre through somebody who stands there costs so much more
_WALKING_PRICE: Final = 3.0
_PERSON_M: Final = 0.75  # as far as that price reaches in full; it ends twice as far
_SLOW_MPS: Final = 0.25
_NO_ROOM: Final = 1000.0
_DETOUR: Final = 1.01  # a straight piece may cost so much more than the crooked one


class RoutePlanner:
    """Ways to one goal. `clearance_m` is the least distance from the robot's centre to anything solid.

    Raises ValueError when the scene has no room for it.
    """

    def __init__(self, scene: Scene, goal_xy: Vec2, clearance_m: float, max_step_m: float) -> None:
        self.grid = NavGrid(scene, clearance_m=clearance_m, max_step_m=max_step_m)
        self._goal = goal_xy
        self._price = self._static_price(scene)
        self._tree = self.grid.cost_tree(goal_xy, self._price)

    def _static_price(self, scene: Scene) -> Array:
        lack = np.clip(1.0 - (self.grid.clearances - self.grid.required_m) / ROOM_M, 0.0, 1.0)
        price = 1.0 + _WALL_PRICE * lack * lack
        street = np.zeros(self.grid.shape, np.uint8)
        # Crossings last: they are streets that one may cross.
        for kind, value in (("street", 1), ("crossing", 0)):
            for area in scene.areas:
                if area.kind == kind:
                    cells = [self.grid.cell(x, y)[::-1] for x, y in area.polygon]
                    cv2.fillPoly(street, [np.array(cells, np.int32)], value)
        return np.asarray(np.where(street > 0, price * _STREET_PRICE, price))

    def reachable(self, x_m: float, y_m: float) -> bool:
        """Whether there is a way to the goal from a point."""
        return bool(np.isfinite(self.grid.field_at(self._tree.cost, x_m, y_m)))

    def left(self, x_m: float, y_m: float) -> float:
        """Price of the way left to the goal, nobody being in it; a metre with room costs 1."""
        return self.grid.field_at(self._tree.cost, x_m, y_m)

    def route(self, start: Vec2, people: Array, velocities: Array, reach_m: float) -> Array:
        """[n, 2]: points SPACING_M apart from `start` towards the goal, up to `reach_m` of way, led round people.

        `people` [k, 2] m and `velocities` [k, 2] m/s. Just the start where there is no way.
        """
        first = self.grid.nearest_free(*start)
        if first is None or not self.reachable(*first):
            return np.array([start])
        cells = self._cells(first, people, velocities, reach_m)
        points = [first, *(self.grid.centre(*divmod(cell, self.grid.shape[1])) for cell in cells)]
        if hypot(points[-1][0] - self._goal[0], points[-1][1] - self._goal[1]) < 2 * self.grid.resolution_m:
            points[-1] = self._goal
        taut = self._relaxed(self._straightened(_spaced(points), people, velocities))
        return taut if first == start else np.vstack((np.array(start), taut))

    def _cells(self, first: Vec2, people: Array, velocities: Array, reach_m: float) -> list[int]:
        """Flat cells from `first` on: through the window where somebody is in it, then along the tree."""
        grid = self.grid
        row, column = grid.free_cell(*first)
        cell, width = row * grid.shape[1] + column, grid.shape[1]
        near = np.max(np.abs(people - np.array(first)), axis=1) < WINDOW_M if len(people) else np.zeros(0, bool)
        cells = [cell]
        if near.any():
            cells = self._through_window(row, column, people[near], velocities[near])
            cell = cells[-1]
        limit = ceil(reach_m / grid.resolution_m)
        while len(cells) < limit:
            cell = int(self._tree.onwards[divmod(cell, width)])
            if cell < 0:
                break
            cells.append(cell)
        return cells

    def _through_window(self, row: int, column: int, people: Array, velocities: Array) -> list[int]:
        grid, reach = self.grid, round(WINDOW_M / self.grid.resolution_m)
        rows = slice(max(row - reach, 0), min(row + reach + 1, grid.shape[0]))
        columns = slice(max(column - reach, 0), min(column + reach + 1, grid.shape[1]))
        free = grid.free[rows, columns]
        price = self._price[rows, columns] + self._crowd_price(rows, columns, people, velocities)
        ids, source, target, length = links(free, grid.resolution_m)
        cells = price[free]
        lengths = length * 0.5 * (cells[source] + cells[target])
        worth = self._tree.cost[rows, columns]
        rim = free & np.isfinite(worth)
        rim[1:-1, 1:-1] = False
        goal_row, goal_column = grid.free_cell(*self._goal)
        if rows.start <= goal_row < rows.stop and columns.start <= goal_column < columns.stop:
            rim[goal_row - rows.start, goal_column - columns.start] = True
        # One more node stands for the goal: the rim is joined to it by what the way from there costs.
        count = int(free.sum())
        ends = ids[rim]
        graph = csr_matrix(
            (
                np.concatenate((lengths, worth[rim] + 1e-6)),
                (np.concatenate((source, ends)), np.concatenate((target, np.full(len(ends), count)))),
            ),
            shape=(count + 1, count + 1),
        )
        _, onwards = dijkstra(graph, directed=False, indices=count, return_predecessors=True)
        where = np.argwhere(free)
        node, way = int(ids[row - rows.start, column - columns.start]), []
        while 0 <= node < count:
            way.append(int((where[node, 0] + rows.start) * grid.shape[1] + where[node, 1] + columns.start))
            node = int(onwards[node])
        return way

    def _straightened(self, line: Array, people: Array, velocities: Array) -> Array:
        """The way with every detour of the grid replaced by a straight piece that costs no more."""
        prices = self._prices_at(line, people, velocities)
        paid = np.concatenate(((0.0,), np.cumsum(0.5 * (prices[1:] + prices[:-1])))) * SPACING_M

        def cheap(i: int, j: int) -> bool:
            a, b = line[i], line[j]
            points = a + (b - a) * np.linspace(0.0, 1.0, j - i + 1)[:, None]
            price = self._prices_at(points, people, velocities)
            cost = float(np.mean(price)) * hypot(b[0] - a[0], b[1] - a[1])
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

    def _prices_at(self, points: Array, people: Array, velocities: Array) -> Array:
        """Price of a metre at each point [n, 2], people included; prohibitive where there is no room."""
        column = ((points[:, 0] - self.grid.origin_m[0]) / self.grid.resolution_m).astype(np.int64)
        row = ((points[:, 1] - self.grid.origin_m[1]) / self.grid.resolution_m).astype(np.int64)
        row, column = np.clip(row, 0, self.grid.shape[0] - 1), np.clip(column, 0, self.grid.shape[1] - 1)
        price = np.where(self.grid.free[row, column], self._price[row, column], _NO_ROOM)
        if len(people):
            slow = np.hypot(velocities[:, 0], velocities[:, 1]) < _SLOW_MPS
            there = people + velocities * ~slow[:, None]
            gap = np.hypot(points[:, None, 0] - there[:, 0], points[:, None, 1] - there[:, 1])
            weight = np.where(slow, _STANDING_PRICE, _WALKING_PRICE)
            price = price + np.sum(weight * np.clip(2.0 - gap / _PERSON_M, 0.0, 1.0), axis=1)
        return np.asarray(price)

    def _relaxed(self, line: Array) -> Array:
        """The same way with its corners rounded, as far as there is room."""
        if len(line) < 5:
            return line
        rounded = _smooth(_smooth(line, 5), 3)
        fits = self.grid.clearances_at(rounded) >= self.grid.required_m - 0.02
        return np.asarray(np.where(fits[:, None], rounded, line))

    def _crowd_price(self, rows: slice, columns: slice, people: Array, velocities: Array) -> Array:
        size = self.grid.resolution_m
        x = self.grid.origin_m[0] + (np.arange(columns.start, columns.stop) + 0.5) * size
        y = self.grid.origin_m[1] + (np.arange(rows.start, rows.stop) + 0.5) * size
        price = np.zeros((len(y), len(x)))
        for (px, py), (vx, vy) in zip(people, velocities, strict=True):
            slow = hypot(vx, vy) < _SLOW_MPS
            # Somebody who walks will have gone on when the robot gets there; somebody who stands will not.
            ahead = 0.0 if slow else 1.0
            gap = np.hypot(x[None, :] - (px + ahead * vx), y[:, None] - (py + ahead * vy))
            weight = _STANDING_PRICE if slow else _WALKING_PRICE
            price += weight * np.clip(2.0 - gap / _PERSON_M, 0.0, 1.0)
        return price


def _spaced(points: list[Vec2]) -> Array:
    """The polyline as points SPACING_M apart."""
    line = np.array(points)
    steps = np.hypot(*np.diff(line, axis=0).T) if len(line) > 1 else np.zeros(0)
    along = np.concatenate(((0.0,), np.cumsum(steps)))
    marks = np.arange(0.0, along[-1] + SPACING_M / 2, SPACING_M)
    return np.stack((np.interp(marks, along, line[:, 0]), np.interp(marks, along, line[:, 1])), axis=1)


def _smooth(line: Array, half: int) -> Array:
    """Each point moved to the mean of the `half` before and after it; the ends stay."""
    padded = np.vstack((np.repeat(line[:1], half, 0), line, np.repeat(line[-1:], half, 0)))
    sums = np.cumsum(np.vstack((np.zeros((1, 2)), padded)), axis=0)
    smooth = (sums[2 * half + 1 :] - sums[: -2 * half - 1]) / (2 * half + 1)
    # Towards the ends, where one side runs out, the mean would pull the line off its end points.
    inward = np.minimum(np.arange(len(line)), np.arange(len(line))[::-1])
    share = np.clip(inward / half, 0.0, 1.0)[:, None]
    return np.asarray(line * (1 - share) + smooth * share)
