"""Files of one finished episode: its record, a line of `results.jsonl`, and its log, one row per control period."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge.core.cli import write_whole
from edge.core.geometry import SE2
from edge.core.stats import percentiles
from firmware_bridge.system.input_file import read_json

DELAY_POINTS = ("mean", "p50", "p99", "max")
COLUMNS = ("time_s", "x_m", "y_m", "theta_rad", "odom_x_m", "odom_y_m", "vx_mps", "vy_mps", "wz_radps", "delay_s")
"""True pose, odometry position, command, semantic delay (null while there is no semantic state)."""
_TEXTS = ("id", "task", "scene", "robot", "instruction", "end", "trajectory_sha256", "stopped_by", "clock", "host")
_WHOLE_NUMBERS = ("people", "seed", "wording", "attempts")


class ResultError(ValueError):
    """An invalid record; one line: what, expected, found."""


@dataclass(frozen=True)
class EpisodeResult:
    """Result of one finished episode; rates in percent. Only the last three fields depend on the number of jobs.

    `spl`: this episode's term of equation 9, 100 * success * shortest_m / max(shortest_m, path_m).
    """

    id: str
    task: str
    """Name of the task; its episodes share start, goal and instructions, and intervals resample tasks."""
    scene: str
    people: int
    robot: str
    seed: int
    wording: int
    instruction: str
    success: bool
    ne_m: float
    spl: float
    collided: bool
    collisions: tuple[str, ...]
    """Labels of what the robot hit; "person" also counts one within 0.5 m."""
    first_collision_s: float | None
    fell: bool
    end: str
    """Why the episode ended: reached, timeout, fell or stopped."""
    path_m: float
    shortest_m: float
    time_s: float
    timeout_s: float
    trajectory_sha256: str
    delay_s: Mapping[str, float] | None
    """Mean, p50, p99 and max of the semantic delay over ticks with a semantic state, s; None: no such tick."""
    generations: int | None
    """Number of released semantic states; None for a policy without any."""
    stopped_by: str
    """Fault by which the runner's supervisor stopped the robot; empty: none."""
    clock: str
    wall_s: float
    attempts: int
    host: str

    def __post_init__(self) -> None:
        for kind, what, names in ((str, "text", _TEXTS), (int, "a whole number", _WHOLE_NUMBERS)):
            for name in names:
                if type(getattr(self, name)) is not kind:
                    raise ResultError(f"episode {self.id}: expected {name} as {what}, found {getattr(self, name)!r}")
        if not all(isinstance(label, str) for label in self.collisions):
            raise ResultError(f"episode {self.id}: expected collisions as texts, found {self.collisions!r}")
        for name in ("ne_m", "spl", "path_m", "shortest_m", "time_s", "timeout_s", "wall_s"):
            value = getattr(self, name)
            if not (_is_number(value) and value >= 0):
                raise ResultError(f"episode {self.id}: expected {name} of 0 or more, found {value!r}")
        if not self.task:
            raise ResultError(f"episode {self.id}: expected the name of its task, found {self.task!r}")
        if self.spl > 100 or (self.spl > 0 and not self.success):
            raise ResultError(f"episode {self.id}: expected spl of 0..100 and 0 without success, found {self.spl!r}")
        for name in ("success", "collided", "fell"):
            if not isinstance(getattr(self, name), bool):
                raise ResultError(f"episode {self.id}: expected {name} to be true or false")
        if self.collided != bool(self.collisions):
            raise ResultError(f"episode {self.id}: collided is {self.collided}, collisions are {self.collisions}")
        if len(self.trajectory_sha256) != 64:
            raise ResultError(f"episode {self.id}: expected a SHA-256, found {self.trajectory_sha256!r}")
        if self.delay_s is not None and not (
            set(self.delay_s) == set(DELAY_POINTS) and all(map(_is_number, self.delay_s.values()))
        ):
            raise ResultError(f"episode {self.id}: expected delay_s with {', '.join(DELAY_POINTS)} in s")

    def as_json(self) -> dict[str, Any]:
        """Return the record as JSON values, to be read by `of_json`."""
        values = asdict(self)
        return {**values, "collisions": list(self.collisions)}

    @staticmethod
    def of_json(content: object) -> EpisodeResult:
        """Read a record written by `as_json`. Raises ResultError."""
        known = {each.name for each in fields(EpisodeResult)}
        if not isinstance(content, Mapping) or set(content) != known:
            raise ResultError(f"result: expected an object with the keys {sorted(known)}")
        try:
            return EpisodeResult(**{**content, "collisions": tuple(content["collisions"])})
        except (TypeError, AttributeError) as error:
            raise ResultError(f"result: {error}") from error


@dataclass(frozen=True)
class FailedRun:
    """An episode without a result, because its process died in every attempt."""

    id: str
    attempts: int
    why: str

    @staticmethod
    def of_json(content: object) -> FailedRun:
        """Read the output of `asdict`. Raises ResultError."""
        types = {"id": str, "attempts": int, "why": str}
        if not isinstance(content, Mapping) or {key: type(value) for key, value in content.items()} != types:
            raise ResultError("failed run: expected an object with id (text), attempts (whole number) and why (text)")
        return FailedRun(**content)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


@dataclass
class EpisodeLog:
    """Log with one row per control period; generations and final positions of people are added on writing."""

    rows: list[tuple[float | None, ...]] = field(default_factory=list)

    def add(
        self, time_s: float, T_world_base: SE2, T_odom_base: SE2, command: tuple[float, float, float],
        delay_s: float | None,
    ) -> None:  # fmt: skip
        """Add a period: the state at its beginning, and its command."""
        odom = T_odom_base.as_tuple()[:2]
        self.rows.append((time_s, *T_world_base.as_tuple(), *odom, *command, delay_s))

    def delay_summary(self) -> dict[str, float] | None:
        """Return mean, p50, p99 and max of the delays, s; None if there are none."""
        delays = [row[-1] for row in self.rows if row[-1] is not None]
        if not delays:
            return None
        points = percentiles(delays, "p50", "p99", "max")
        mean = round(sum(delays) / len(delays), 4)
        return {"mean": mean, **{name: value for name, value in points.items() if value is not None}}

    def write(
        self,
        path: Path,
        generations: Sequence[Mapping[str, object]],
        people: NDArray[np.float64],
        goal_xy: Sequence[float],
    ) -> None:
        """Write the log as JSON. Raises OSError."""
        columns = {
            name: [None if row[i] is None else round(float(row[i] or 0.0), 4) for row in self.rows]
            for i, name in enumerate(COLUMNS)
        }
        places = [[round(float(v), 3) for v in row] for row in people]
        content = {"columns": columns, "generations": list(generations), "people": places, "goal_xy": list(goal_xy)}
        write_whole(path, json.dumps(content) + "\n")


def read_log(path: Path) -> dict[str, Any]:
    """Read a log written by `EpisodeLog.write`. Raises OSError or ValueError."""
    content = read_json(path)
    if not isinstance(content, dict) or set(content) != {"columns", "generations", "people", "goal_xy"}:
        raise ValueError(f"{path}: expected the log of an episode")
    if set(content["columns"]) != set(COLUMNS):
        raise ValueError(f"{path}: expected the columns {', '.join(COLUMNS)}")
    return content
