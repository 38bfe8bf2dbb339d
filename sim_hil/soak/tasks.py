"""Tasks of a soak: drawn from the robot's pose to a landmark of the scene, and tracked by ground truth. Seeded."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from math import hypot, inf
from typing import Any, Final

import numpy as np

from sim_hil.benchmark.env.metrics import spl
from sim_hil.benchmark.language.instructions import WordingError, wordings
from sim_hil.benchmark.language.route import RouteError, describe_route
from sim_hil.benchmark.language.tasks import facing, goal_before, goals, path_to, sample_task
from sim_hil.benchmark.suite.build import timeout_s
from sim_hil.benchmark.suite.robots import robot_grid
from sim_hil.realtime.truth import TruePose
from sim_hil.scene.scene import Scene, SceneObject, Vec2, Vec3

THRESHOLD_M: Final = 1.5  # paper, equation 6
LENGTH_M: Final = (4.0, 40.0)
LONGEST_S: Final = 60.0
"""Longest task at full speed, s: a slow robot gets shorter routes, so that a leg contains several tasks."""
TRIES: Final = 24
_SLOW: Final = 0.6  # mean speed among people as a share of the speed limit


@dataclass(frozen=True)
class SoakTask:
    """Task to drive from `start` (x m, y m, heading rad) to `goal_xy` (m); `shortest_m`: shortest feasible path.

    `first`: how the robot must turn on the spot to face its route (`tasks.facing`).
    """

    number: int
    instruction: str
    start: Vec3
    goal_xy: Vec2
    goal_label: str
    shortest_m: float
    timeout_s: float
    first: str = ""


class Journey:
    """Random sequence of tasks in one scene. Raises ValueError for a scene without free space or landmarks."""

    def __init__(
        self, scene: Scene, seed: int, leg: int, speed_mps: float, robot: str = "go2", people: int = 0
    ) -> None:
        """`robot`: simulated robot whose size and largest step decide where it can drive."""
        self.scene = scene
        self._people = people
        self._rng = np.random.default_rng((seed, 62, leg))
        self._grid = robot_grid(scene, robot)
        self._speed_mps = speed_mps
        self._length_m = (LENGTH_M[0], min(LENGTH_M[1], max(2 * LENGTH_M[0], LONGEST_S * speed_mps)))
        self._count = 0

    def begin(self) -> Vec3:
        """Return a start pose for a leg from which a task exists. Raises ValueError."""
        why = ""
        for _ in range(TRIES):
            try:
                return sample_task(self.scene, self._grid, self._rng, length_m=self._length_m).start
            except RouteError as error:
                why = str(error)
        raise ValueError(f"scene {self.scene.name}: no task found in {TRIES} tries ({why}); give another scene")

    def next(self, at: Vec3) -> SoakTask | None:
        """Return a task from pose `at`; None if no landmark can be reached.

        If no route can be described unambiguously (such as from a corner), the instruction is a plain "Go to the ...".
        A robot that stands against furniture may have no path from its own cell: the path then begins at the nearest
        cell from which the scene can be reached.
        """
        before = (goal_before(self._grid, thing) for thing in goals(self.scene))
        if self._grid.space(at[0], at[1]) in {self._grid.space(*goal) for goal in before if goal is not None}:
            task = self._next(at, at)
            if task is not None:
                return task
        x_m, y_m = self._grid.nearest_in_largest_space(at[0], at[1])
        return self._next(at, (x_m, y_m, at[2]))

    def _next(self, at: Vec3, begin: Vec3) -> SoakTask | None:
        """Return a task for a robot at pose `at` whose path begins at pose `begin`; None if there is none."""
        gap_m = hypot(begin[0] - at[0], begin[1] - at[1])
        things = goals(self.scene)
        order = [things[int(index)] for index in self._rng.permutation(len(things))]
        seed = int(self._rng.integers(2**31))

        @cache  # a search of a tenth of a second
        def goal_path(thing: SceneObject) -> tuple[Vec2, tuple[Vec2, ...], float] | None:
            """Point before a landmark, the path to it and its length."""
            try:
                goal, path = path_to(self._grid, begin, thing)
            except RouteError:
                return None
            return goal, path, gap_m + _length_m(path)

        for lengths_m in (self._length_m, LENGTH_M):
            for thing in order:
                if self._straight_m(at, thing) > lengths_m[1] or (found := goal_path(thing)) is None:
                    continue
                goal, path, length_m = found
                if not lengths_m[0] <= length_m <= lengths_m[1]:
                    continue
                first = facing(begin, path)
                with suppress(RouteError, WordingError):
                    route = describe_route(self.scene, self._grid, list(path), thing)
                    text = wordings(route, 1, seed, held_out=True, first=first)[0]
                    return self._task(at, goal, thing, length_m, text, first)
        for thing in order:
            if (found := goal_path(thing)) is not None and found[2] >= LENGTH_M[0]:
                goal, path, length_m = found
                return self._task(at, goal, thing, length_m, f"Go to the {thing.landmark}.", facing(begin, path))
        return None

    def _straight_m(self, at: Vec3, thing: SceneObject) -> float:
        goal = goal_before(self._grid, thing)
        return inf if goal is None else hypot(goal[0] - at[0], goal[1] - at[1])

    def _task(self, at: Vec3, goal: Vec2, thing: SceneObject, length_m: float, text: str, first: str) -> SoakTask:
        self._count += 1
        # The benchmark's, so that rates of success compare; a speed limit below its robots' needs more.
        outdoor = self.scene.ceiling_height_m == 0
        longest_s = max(timeout_s(length_m, self._people, outdoor), 20.0 + length_m / (_SLOW * self._speed_mps))
        return SoakTask(self._count, text, at, goal, thing.label, length_m, longest_s, first)


def _length_m(path: tuple[Vec2, ...]) -> float:
    return sum(hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(path))


class TaskRun:
    """Tracker of one task's poses from `started_ns` on."""

    def __init__(self, task: SoakTask, started_ns: int) -> None:
        self.task = task
        self.started_ns = started_ns
        self._last: TruePose | None = None
        self._ne_m = hypot(task.goal_xy[0] - task.start[0], task.goal_xy[1] - task.start[1])
        self._path_m = 0.0
        self._touched: set[str] = set()

    def add(self, pose: TruePose) -> str | None:
        """Add a pose; return "reached" or "timeout" if it ends the task, else None."""
        if pose.t_ns < self.started_ns:
            return None
        if self._last is not None:
            self._path_m += hypot(pose.x_m - self._last.x_m, pose.y_m - self._last.y_m)
        self._last = pose
        self._touched.update(pose.touching)
        self._ne_m = hypot(self.task.goal_xy[0] - pose.x_m, self.task.goal_xy[1] - pose.y_m)
        if self._ne_m < THRESHOLD_M:
            return "reached"
        return "timeout" if (pose.t_ns - self.started_ns) / 1e9 >= self.task.timeout_s else None

    def outcome(self, end: str) -> dict[str, Any]:
        """Return the outcome so far as JSON values.

        `end`: reached, timeout, stopped (the runner ended) or cut (the leg ended); `spl` in percent.
        """
        reached, task = end == "reached", self.task
        last_ns = self.started_ns if self._last is None else self._last.t_ns
        return {
            "number": task.number,
            "end": end,
            "success": reached,
            "ne_m": round(self._ne_m, 3),
            "spl": round(100 * spl(reached, task.shortest_m, self._path_m), 2),
            "path_m": round(self._path_m, 3),
            "shortest_m": round(task.shortest_m, 3),
            "time_s": round((last_ns - self.started_ns) / 1e9, 3),
            "collisions": sorted(self._touched),
            "goal": task.goal_label,
            "instruction": task.instruction,
            "first": task.first,
        }
