"""Record of one finished episode: a line of `results.jsonl`, an entry of `episodes`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

DELAY_POINTS = ("mean", "p50", "p99", "max")


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
        for name in ("ne_m", "spl", "path_m", "shortest_m", "time_s", "timeout_s", "wall_s"):
            value = getattr(self, name)
            if not (_is_number(value) and value >= 0):
                raise ResultError(f"episode {self.id}: expected {name} of 0 or more, found {value!r}")
        if not (isinstance(self.task, str) and self.task):
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
        if self.delay_s is not None and set(self.delay_s) != set(DELAY_POINTS):
            raise ResultError(f"episode {self.id}: expected delay_s with {', '.join(DELAY_POINTS)}")

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
        except TypeError as error:
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
