"""The path since an instruction began, in few points: a language model that sees 9 s is given the minutes before.

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
Way: TypeAlias = tuple[Point, ...]
"""(x m, y m) with one decimal in the newest robot frame, oldest first; without the robot itself, which is at (0, 0)."""

MAX_POINTS = 8
TOLERANCE_M = 0.5
"""Tolerance of a path in a prompt: passing people bends it by less, a turn into a corridor or a room by more."""
PERIOD_NS = 1_000_000_000
"""Between two poses that are kept."""
MOVED_M = 0.1
"""A robot that stands keeps no new pose."""
FARTHEST_M = 999.9
"""Largest coordinate that a prompt gives, m, so that its length has a bound."""
CAPACITY = 512
"""Poses kept, more than 8 minutes of driving; then half of them go, those that the way's form needs least."""


def simplified(points: Sequence[Point], most: int, tolerance_m: float) -> list[Point]:
    """At most `most` (2 or more) of the points, in their order: always the first and the last.

    The farthest point from those chosen so far comes next, until none is farther than the tolerance, m. Deterministic:
    of equally far points the oldest.
    """
    return [points[i] for i in _kept(points, most, tolerance_m)]


def _kept(points: Sequence[Point], most: int, tolerance_m: float) -> list[int]:
    if most < 2:
        raise ValueError(f"a way has a start and an end: expected most of 2 or more, found {most}")
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
    """Distance of points [N, 2] to the segment from a to b, m: to the segment, for a way may go out and back."""
    along = b - a
    square = float(along @ along)
    # A segment shorter than any odometry resolves has no direction.
    share = np.clip((xy - a) @ along / square, 0.0, 1.0) if square > 1e-12 else np.zeros(len(xy))
    apart = xy - a - share[:, None] * along
    distances: npt.NDArray[np.float64] = np.hypot(apart[:, 0], apart[:, 1])
    return distances


class PathMemory:
    """Where the robot has been since the first pose; bounded, however long that is. For one thread.

    What is kept depends on the poses alone, not on how many come with one call: a memory that is fed the frames of the
    token ring now and then is equal to one that is fed at 10 Hz.
    """

    def __init__(self) -> None:
        self._points: list[Point] = []
        self._newest_ns: int | None = None
        self._due_ns: int | None = None

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest pose that was seen, kept or not; None before the first."""
        return self._newest_ns

    @property
    def points(self) -> tuple[Point, ...]:
        """Points kept, (x m, y m) in the odometry frame, oldest first; fewer than CAPACITY."""
        return tuple(self._points)

    def put(self, stamp_ns: int, T_odom_base: SE2) -> None:
        """See a pose; one that is not newer than the newest changes nothing."""
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

    def way(self, T_odom_base: SE2) -> Way:
        """The way up to a pose, which is the newest, in that robot frame; () while no pose was seen."""
        here = (T_odom_base.x_m, T_odom_base.y_m)
        # One more than the prompt gets: the last is the robot's own place.
        chosen = simplified([*self._points, here], MAX_POINTS + 1, TOLERANCE_M)[:-1]
        T_base_odom = T_odom_base.inverse()
        return tuple(prompt_point(T_base_odom @ SE2(x, y, 0.0)) for x, y in chosen)


def prompt_point(T_base_point: SE2) -> Point:
    """A place in the robot's frame as a prompt gives it: to 0.1 m, without a negative zero, of a bounded length."""
    x_m, y_m = (
        round(min(max(value, -FARTHEST_M), FARTHEST_M), 1) + 0.0 for value in (T_base_point.x_m, T_base_point.y_m)
    )
    return (x_m, y_m)


def way_of(poses: Iterable[tuple[int, SE2]]) -> Way:
    """The way of (stamp ns, `T_odom_base`) since an instruction began, oldest first, as seen from the last of them."""
    memory = PathMemory()
    newest: SE2 | None = None
    for stamp_ns, newest in poses:
        memory.put(stamp_ns, newest)
    return () if newest is None else memory.way(newest)
