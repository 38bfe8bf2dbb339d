"""Outcome of an episode, measured on its 30 Hz trajectory."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_hil.benchmark.env.metrics import is_success, navigation_error_m, path_length_m, spl
from sim_hil.benchmark.suite.episode import Episode

Array = NDArray[np.float64]
ENDS = ("reached", "timeout", "fell", "stopped")


@dataclass(frozen=True)
class Outcome:
    """Metrics of one episode (paper equations 6 to 10); `spl` 0..1, lengths in m, times in s of simulation.

    `end`: why the episode ended: goal reached, timeout, fall, or stopped by the caller. `collisions`: labels of
    touched objects; "person" also counts one within 0.5 m. `first_collision_s`: time of the first collision.
    """

    id: str
    success: bool
    end: str
    ne_m: float
    spl: float
    collided: bool
    collisions: tuple[str, ...]
    first_collision_s: float | None
    fell: bool
    path_m: float
    shortest_m: float
    time_s: float
    trajectory_sha256: str

    def __post_init__(self) -> None:
        if self.end not in ENDS:
            raise ValueError(f"outcome of {self.id}: expected an end of {', '.join(ENDS)}, found {self.end!r}")


def trajectory_sha256(trajectory: Array) -> str:
    """Return the SHA-256 of [n, 3] poses (x m, y m, heading rad) as little-endian doubles; equal for equal motion."""
    return hashlib.sha256(np.ascontiguousarray(trajectory, dtype="<f8").tobytes()).hexdigest()


def measure(
    episode: Episode,
    trajectory: Array,
    *,
    end: str,
    time_s: float,
    collisions: tuple[str, ...],
    first_collision_s: float | None,
    fell: bool,
) -> Outcome:
    """Compute the outcome from the 30 Hz poses `trajectory` [n, 3], which include the start."""
    last = (float(trajectory[-1, 0]), float(trajectory[-1, 1]))
    success = is_success(last, episode.goal_xy, episode.threshold_m)
    path_m = path_length_m(trajectory[:, :2])
    return Outcome(
        id=episode.id,
        success=success,
        end=end,
        ne_m=navigation_error_m(last, episode.goal_xy),
        spl=spl(success, episode.shortest_m, path_m),
        collided=bool(collisions),  # equation 10: at any time of the episode
        collisions=collisions,
        first_collision_s=first_collision_s,
        fell=fell,
        path_m=path_m,
        shortest_m=episode.shortest_m,
        time_s=time_s,
        trajectory_sha256=trajectory_sha256(trajectory),
    )
