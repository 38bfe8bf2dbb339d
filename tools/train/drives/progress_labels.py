"""True progress along a described route: the next turn, and the number of openings of its kind that were passed.

Openings are counted as the instruction's ordinals count them: before "the third door on the left" two are passed.
"""

from __future__ import annotations

import itertools
from math import atan2, hypot
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.sparse.csgraph import dijkstra

from edge.core.geometry import SE2, wrap_angle
from edge.reasoning.decoding_rules import TURNED_RAD
from edge.state.reasoning_text import LEFT, Progress
from sim_hil.benchmark.language.openings import Frame
from sim_hil.benchmark.language.route import Step
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Vec2
from tools.train.drives.scenarios import Scenario

Array = NDArray[np.float64]

_SPACING_M: Final = 0.1  # distance between two points of a route
_REACH_M: Final = 25.0  # longest walking distance to the route that is computed exactly
_TURNED_M: Final = 1.0  # within this distance past a turn, a robot still in the old corridor has not turned
_BEYOND_M: Final = 0.3  # distance past an opening at which it counts as missed
_ASIDE_M: Final = 2.0  # largest lateral distance from the turn at which a robot has driven straight past it


class RouteProgress:
    """Maps a pose to progress along a scenario's route, also far away from it.

    A pose belongs to the route's point with the shortest walking distance, around walls: a robot that drives past a
    turn stays at that turn, and one that drives back loses progress.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scene, self._steps = scenario.scene, scenario.route.steps
        self._points = _dense(scenario.task.path)
        self._grid = scenario.site.grid
        self._nearest, self._gap_m = _nearest_points(self._grid, self._points)
        self._at = [self._index_near(step.at) for step in self._steps]
        self._areas = [self._area_labels(i) for i in range(len(self._steps) + 1)]

    @property
    def length_m(self) -> float:
        """Length of the route, m."""
        return (len(self._points) - 1) * _SPACING_M

    def at(self, pose: SE2) -> Progress:
        """Return the next turn and the number of openings of its kind passed on its side since the previous turn."""
        index = self._step_at(pose)
        if index == len(self._steps):
            return Progress(index + 1, index, 0)
        return Progress(index + 1, len(self._steps), self._passed(index, pose))

    def next_step(self, pose: SE2) -> Step | None:
        """Return the next step of the route; None on the last leg."""
        index = self._step_at(pose)
        return self._steps[index] if index < len(self._steps) else None

    def to_next_m(self, pose: SE2) -> float:
        """Return the distance to the next turn, or on the last leg to the goal, m."""
        index, place = self._step_at(pose), self._place(pose)
        end = self._at[index] if index < len(self._steps) else len(self._points) - 1
        return max(0.0, (end - place) * _SPACING_M) + self._strayed(pose)

    def left_m(self, pose: SE2) -> float:
        """Return the distance to the goal along the route, m."""
        return (len(self._points) - 1 - self._place(pose)) * _SPACING_M + self._strayed(pose)

    def strayed_m(self, pose: SE2) -> float:
        """Return the walking distance to the route, m; approximate beyond 25 m."""
        row, column = self._grid.cell(pose.x_m, pose.y_m)
        return float(self._gap_m[row, column])

    def _strayed(self, pose: SE2) -> float:
        """Return that distance minus 1 m, the tolerance for driving beside the line."""
        return max(0.0, self.strayed_m(pose) - 1.0)

    def _place(self, pose: SE2) -> int:
        row, column = self._grid.cell(pose.x_m, pose.y_m)
        return int(self._nearest[row, column])

    def _step_at(self, pose: SE2) -> int:
        """Return the index of the next step; on the last leg the number of steps."""
        place = self._place(pose)
        index = sum(place >= at for at in self._at)
        if index and self._overshot(index - 1, pose):
            return index - 1
        if index and (place - self._at[index - 1]) * _SPACING_M < _TURNED_M:
            step = self._steps[index - 1]
            area = self._scene.area_at(pose.x_m, pose.y_m)
            here = area is not None and area.label == self._area_before(index - 1)
            if step.side != "straight" and (here or not _has_turned(step, pose)):
                index -= 1
        return index

    def _overshot(self, index: int, pose: SE2) -> bool:
        """Return whether the robot went straight past a turn, across the corridor that the turn leads into."""
        step = self._steps[index]
        if not step.ordinal:
            return False
        frame, xy = Frame(step.ahead), (pose.x_m, pose.y_m)
        area = self._scene.area_at(*xy)
        beyond = frame.along(xy) > step.counted[step.ordinal - 1].high_m + _BEYOND_M
        aside_m = abs(frame.across(xy) - frame.across(step.at))
        return beyond and aside_m < _ASIDE_M and area is not None and area.label not in self._areas[index + 1]

    def _passed(self, index: int, pose: SE2) -> int:
        step = self._steps[index]
        if not step.ordinal:
            return 0
        frame = Frame(step.ahead)
        area = self._scene.area_at(pose.x_m, pose.y_m)
        # Beside the corridor, such as in a room, the point where the robot left the corridor counts.
        on_leg = area is not None and (area.label in self._areas[index] or self._overshot(index, pose))
        point = (pose.x_m, pose.y_m) if on_leg else tuple(self._points[self._place(pose)])
        here = frame.along((float(point[0]), float(point[1])))
        return sum(
            opening.middle_m < here for opening in step.counted if not self._is_taken(step, opening.middle_m, here)
        )

    def _is_taken(self, step: Step, middle_m: float, here: float) -> bool:
        """Return whether an opening is the one to take and not completely behind: turning in does not pass it."""
        taken = step.counted[step.ordinal - 1]
        return middle_m == taken.middle_m and here <= taken.high_m

    def _index_near(self, point: Vec2) -> int:
        gaps = np.hypot(self._points[:, 0] - point[0], self._points[:, 1] - point[1])
        return int(np.argmin(gaps))

    def _area_before(self, index: int) -> str:
        """Return the label of the area before a step's turn; "" outside all areas."""
        x, y = self._points[max(0, self._at[index] - 2)]
        area = self._scene.area_at(float(x), float(y))
        return area.label if area is not None else ""

    def _area_labels(self, index: int) -> frozenset[str]:
        """Return the areas on the route from the previous step to this one, or to the goal."""
        first = self._at[index - 1] if index else 0
        last = self._at[index] if index < len(self._steps) else len(self._points)
        found = (self._scene.area_at(float(x), float(y)) for x, y in self._points[first:last])
        return frozenset(area.label for area in found if area is not None)


def _has_turned(step: Step, pose: SE2) -> bool:
    """Return whether the robot heads so far to the side of a turn that the runner's rule lets it be done."""
    rotated_rad = wrap_angle(pose.theta_rad - atan2(step.ahead[1], step.ahead[0]))
    return (rotated_rad if step.side == LEFT else -rotated_rad) >= TURNED_RAD


def _dense(path: tuple[Vec2, ...]) -> Array:
    """Return points [n, 2] of a path, 0.1 m apart."""
    line = np.array(path)
    steps = [hypot(b[0] - a[0], b[1] - a[1]) for a, b in itertools.pairwise(path)]
    along = np.concatenate(((0.0,), np.cumsum(steps)))
    marks = np.arange(0.0, along[-1] + _SPACING_M / 2, _SPACING_M)
    return np.stack((np.interp(marks, along, line[:, 0]), np.interp(marks, along, line[:, 1])), axis=1)


def _nearest_points(grid: NavGrid, points: Array) -> tuple[NDArray[np.int64], Array]:
    """Return for every cell the index of the route's nearest point by walking, and the distance, m.

    Both are [rows, columns]. Cells that are occupied or too far away take the values of the nearest reachable cell.
    """
    ids, _, graph = grid.graph
    first: dict[int, int] = {}
    for index, (x, y) in enumerate(points):
        first.setdefault(int(ids[grid.free_cell(float(x), float(y))]), index)
    gaps, _, sources = dijkstra(
        graph, directed=False, indices=list(first), min_only=True, return_predecessors=True, limit=_REACH_M
    )  # fmt: skip
    index_of = np.zeros(len(gaps), np.int64)
    index_of[list(first)] = list(first.values())
    reached, nearest, gap = np.zeros(grid.shape, bool), np.zeros(grid.shape, np.int64), np.zeros(grid.shape)
    reached[grid.free] = np.isfinite(gaps)
    nearest[reached] = index_of[sources[np.isfinite(gaps)]]
    gap[reached] = gaps[np.isfinite(gaps)]
    away, (rows, columns) = distance_transform_edt(~reached, return_indices=True)
    return nearest[rows, columns], gap[rows, columns] + away * grid.resolution_m
