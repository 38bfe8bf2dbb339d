"""The record of one finished episode, whoever ran it: a line of `results.jsonl`, an entry of `episodes`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

DELAY_POINTS = ("mean", "p50", "p99", "max")


class ResultError(ValueError):
    """A record that cannot be a result; one line: what, expected, found."""


@dataclass(frozen=True)
class EpisodeResult:
    """One finished episode; rates in percent (design section 9). Equal for every number of jobs but for the last three.

    `spl` is this episode's share of equation 9: 100 times success, times shortest over longer of shortest and driven.
    """

    id: str
    task: str
    """Episodes of one task share start, goal and instructions; intervals resample tasks."""
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
    """Labels of what was hit; "person" also for one within 0.5 m."""
    first_collision_s: float | None
    fell: bool
    end: str
    """Why it was over: reached, timeout, fell or stopped."""
    path_m: float
    shortest_m: float
    time_s: float
    timeout_s: float
    trajectory_sha256: str
    delay_s: Mapping[str, float] | None
    """mean, p50, p99 and max of the semantic delay in the ticks that drove by one; None: none did."""
    generations: int | None
    """Released semantic states; None for a policy that has none."""
    stopped_by: str
    """The fault by which the runner's own supervisor ended the run; empty: it did not."""
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
        """What `of_json` reads."""
        values = asdict(self)
        return {**values, "collisions": list(self.collisions)}

    @staticmethod
    def of_json(content: object) -> EpisodeResult:
        """A record that `as_json` has written; raises ResultError."""
        known = {each.name for each in fields(EpisodeResult)}
        if not isinstance(content, Mapping) or set(content) != known:
            raise ResultError(f"result: expected an object with the keys {sorted(known)}")
        try:
            return EpisodeResult(**{**content, "collisions": tuple(content["collisions"])})
        except TypeError as error:
            raise ResultError(f"result: {error}") from error


@dataclass(frozen=True)
class FailedRun:
    """An episode without a result: its process ended before it, as often as it was tried."""

    id: str
    attempts: int
    why: str

    @staticmethod
    def of_json(content: object) -> FailedRun:
        """What `asdict` makes of one; raises ResultError."""
        types = {"id": str, "attempts": int, "why": str}
        if not isinstance(content, Mapping) or {key: type(value) for key, value in content.items()} != types:
            raise ResultError("failed run: expected an object with id (text), attempts (whole number) and why (text)")
        return FailedRun(**content)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
