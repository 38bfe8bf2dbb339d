"""The paper's evaluation metrics (equations 6 to 10) of one episode's planar 30 Hz trajectory; pure functions."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from math import hypot
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sim_hil.benchmark.suite.episode import Episode

Array = NDArray[np.float64]
Vec2 = tuple[float, float]

FRAME_HZ: Final = 30
"""Rate at which trajectories, collisions and ends are evaluated, Hz: the paper's simulation rate."""
ENDS = ("reached", "timeout", "fell", "stopped")


def navigation_error_m(position_xy: Vec2, goal_xy: Vec2) -> float:
    """Return NE (equation 7): planar distance from the robot's final position to the goal, m."""
    return hypot(position_xy[0] - goal_xy[0], position_xy[1] - goal_xy[1])


def is_success(position_xy: Vec2, goal_xy: Vec2, threshold_m: float) -> bool:
    """Return S (equation 6): whether the final position is within the threshold of the goal (the paper's is 1.5 m)."""
    return navigation_error_m(position_xy, goal_xy) < threshold_m


def path_length_m(positions_xy: Array) -> float:
    """Return PL (equation 8): summed distance between successive positions [n, 2] recorded at FRAME_HZ, m."""
    if len(positions_xy) < 2:
        return 0.0
    steps = np.diff(positions_xy, axis=0)
    return float(np.sum(np.hypot(steps[:, 0], steps[:, 1])))


def spl(success: bool, shortest_m: float, path_m: float) -> float:
    """Return one episode's term of SPL (equation 9), 0..1; `shortest_m` is the shortest feasible path's length.

    Raises ValueError unless `shortest_m` is positive.
    """
    if not shortest_m > 0:
        raise ValueError(f"spl: expected a shortest path of more than 0 m, found {shortest_m}")
    return shortest_m / max(shortest_m, path_m) if success else 0.0


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
