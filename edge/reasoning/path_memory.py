"""The path since an instruction began, in few points: the model's frames cover 9 s only, the path covers minutes.

The paper's "historical trajectory" (appendix B) for instructions that count turns and doors: odometry poses about 1 s
apart, simplified by splitting at the farthest point (Ramer, Douglas and Peucker), given in the newest robot frame.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from edge.core.geometry import SE2

Point: TypeAlias = tuple[float, float]
PastPath: TypeAlias = tuple[Point, ...]
"""(x m, y m) with one decimal in the newest robot frame, oldest first; without the robot itself, which is at (0, 0)."""

MAX_POINTS = 8
TOLERANCE_M = 0.5
"""Tolerance of a path in a prompt: passing people bends it by less, a turn into a corridor or a room by more."""
PERIOD_NS = 1_000_000_000
"""Time between two kept poses."""
MOVED_M = 0.1
"""Motion below which no new pose is kept."""
FARTHEST_M = 999.9
"""Largest coordinate in a prompt, m, which bounds the prompt's length."""
CAPACITY = 512
"""Number of kept poses, over 8 minutes of driving; then the half that shapes the path least is dropped."""


def simplified(points: Sequence[Point], most: int, tolerance_m: float) -> list[Point]:
    """Return at most `most` (2 or more) of the points, in their order, always with the first and the last.

    Each step adds the point farthest from the simplified path, until none is farther than the tolerance, m. Of equally
    far points it adds the oldest.
    """
    return [points[i] for i in _kept(points, most, tolerance_m)]


def _kept(points: Sequence[Point], most: int, tolerance_m: float) -> list[int]:
    if most < 2:
        raise ValueError(f"a path has a start and an end: expected most of 2 or more, found {most}")
    if len(points) <= 2:
        return list(range(len(points)))
    xy = np.asarray(points, dtype=np.float64)
    kept = [0, len(points) - 1]
    waiting: list[tuple[float, int, int, int]] = []

    def split_at_farthest(first: int, last: int) -> None:
        if last - first > 1:
            far_m = _distances(xy[first + 1 : last], xy[first], xy[last])
            index = int(np.argmax(far_m))
            if far_m[index] > tolerance_m:
                heapq.heappush(waiting, (-float(far_m[index]), first + 1 + index, first, last))

    split_at_farthest(*kept)
    while waiting and len(kept) < most:
        _, split, first, last = heapq.heappop(waiting)
        kept.append(split)
        split_at_farthest(first, split)
        split_at_farthest(split, last)
    return sorted(kept)


def _distances(
    xy: npt.NDArray[np.float64], a: npt.NDArray[np.float64], b: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Return the distances of points [N, 2] to the segment from a to b, m; not to its line: a path may turn back."""
    along = b - a
    square = float(along @ along)
    # A segment shorter than any odometry resolves has no direction.
    share = np.clip((xy - a) @ along / square, 0.0, 1.0) if square > 1e-12 else np.zeros(len(xy))
    apart = xy - a - share[:, None] * along
    distances: npt.NDArray[np.float64] = np.hypot(apart[:, 0], apart[:, 1])
    return distances


class PathMemory:
    """The robot's path since the first pose, in bounded memory. For one thread.

    The kept poses depend on the input poses alone, not on their number per call: a memory that takes the token ring's
    frames once in a while equals one that takes them at 10 Hz.
    """

    def __init__(self) -> None:
        self._points: list[Point] = []
        self._newest_ns: int | None = None
        self._due_ns: int | None = None

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest input pose, kept or not, ns; None before the first."""
        return self._newest_ns

    @property
    def points(self) -> tuple[Point, ...]:
        """Kept points, (x m, y m) in the odometry frame, oldest first; fewer than CAPACITY."""
        return tuple(self._points)

    def put(self, stamp_ns: int, T_odom_base: SE2) -> None:
        """Take a pose; one that is not newer than the newest changes nothing."""
        if self._newest_ns is not None and stamp_ns <= self._newest_ns:
            return
        self._newest_ns = stamp_ns
        if self._due_ns is not None and stamp_ns < self._due_ns:
            return
        self._due_ns = stamp_ns + PERIOD_NS
        point = (T_odom_base.x_m, T_odom_base.y_m)
        if self._points and math.dist(point, self._points[-1]) < MOVED_M:
            return
        self._points.append(point)
        if len(self._points) >= CAPACITY:
            self._points = simplified(self._points, CAPACITY // 2, 0.0)

    def past_path(self, T_odom_base: SE2) -> PastPath:
        """Return the path up to the newest pose, in that robot frame; () before the first pose."""
        here = (T_odom_base.x_m, T_odom_base.y_m)
        # One point more than in the prompt: the last is the robot itself.
        chosen = simplified([*self._points, here], MAX_POINTS + 1, TOLERANCE_M)[:-1]
        T_base_odom = T_odom_base.inverse()
        return tuple(prompt_point(T_base_odom @ SE2(x, y, 0.0)) for x, y in chosen)


def prompt_point(T_base_point: SE2) -> Point:
    """Round a point in the robot frame for a prompt: to 0.1 m, clamped, without a negative zero."""
    x_m, y_m = (
        round(min(max(value, -FARTHEST_M), FARTHEST_M), 1) + 0.0 for value in (T_base_point.x_m, T_base_point.y_m)
    )
    return (x_m, y_m)


def past_path_of(poses: Iterable[tuple[int, SE2]]) -> PastPath:
    """Return the path of (stamp ns, `T_odom_base`), oldest first, in the last pose's robot frame."""
    memory = PathMemory()
    newest: SE2 | None = None
    for stamp_ns, newest in poses:
        memory.put(stamp_ns, newest)
    return () if newest is None else memory.past_path(newest)
