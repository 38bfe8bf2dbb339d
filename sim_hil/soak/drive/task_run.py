"""Progress of one task by ground truth: distance, contacts and the end. Pure: poses in, outcome out."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot
from typing import Any

from sim_hil.benchmark.env.metrics import spl
from sim_hil.realtime.truth import TruePose
from sim_hil.soak.drive.journey import THRESHOLD_M, SoakTask


@dataclass(frozen=True)
class TaskOutcome:
    """Outcome of a task; `end`: reached, timeout, stopped (runner ended) or cut (leg ended); `spl` in percent."""

    number: int
    end: str
    success: bool
    ne_m: float
    spl: float
    path_m: float
    shortest_m: float
    time_s: float
    collisions: tuple[str, ...]
    goal: str
    instruction: str

    def as_json(self) -> dict[str, Any]:
        """Return the outcome as JSON values for the event log."""
        return {**self.__dict__, "collisions": list(self.collisions)}


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

    def outcome(self, end: str) -> TaskOutcome:
        """Return the outcome with the numbers so far."""
        reached = end == "reached"
        last_ns = self.started_ns if self._last is None else self._last.t_ns
        return TaskOutcome(
            number=self.task.number,
            end=end,
            success=reached,
            ne_m=round(self._ne_m, 3),
            spl=round(100 * spl(reached, self.task.shortest_m, self._path_m), 2),
            path_m=round(self._path_m, 3),
            shortest_m=round(self.task.shortest_m, 3),
            time_s=round((last_ns - self.started_ns) / 1e9, 3),
            collisions=tuple(sorted(self._touched)),
            goal=self.task.goal_label,
            instruction=self.task.instruction,
        )
