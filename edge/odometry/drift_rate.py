"""Estimates the drift of the robot's odometry: its error per metre against an independent reference."""

from __future__ import annotations

import math
import sys
from collections import deque
from dataclasses import dataclass

WINDOW_M = 1.0
"""The drift of a metre: short enough to be current, long enough to stand out of the reference's own noise."""
MOST_COMPARISONS = 2048
"""Number of comparisons kept in a limited memory: a robot that turns on the spot adds them without driving a metre."""


@dataclass(frozen=True)
class DriftRate:
    """RMS error of one metre of odometry: m (each of forward and left) and rad, with one standard error each.

    `distance_m`: driven distance behind the estimate. None: no comparison yet, or no reference for it.
    """

    m_per_m: float | None
    m_per_m_sigma: float | None
    rad_per_m: float | None
    rad_per_m_sigma: float | None
    distance_m: float


@dataclass(frozen=True)
class Comparison:
    """Odometry less reference over a short interval (forward, left, yaw), and the variance of the reference."""

    distance_m: float
    forward_m: float
    left_m: float
    yaw_rad: float
    variance_m2: float
    variance_rad2: float


class DriftMonitor:
    """Running estimate over the last `memory_m` of driving; windows of one metre overlap, one for every comparison."""

    def __init__(self, memory_m: float = 20.0) -> None:
        self._memory_m = memory_m
        self._most = MOST_COMPARISONS if math.isfinite(memory_m) else sys.maxsize
        self._part: deque[Comparison] = deque()
        self._part_m = 0.0
        self._windows: deque[tuple[float, float, float, float]] = deque()
        self._driven_m = 0.0
        self._sums = [0.0, 0.0, 0.0]

    def add(self, comparison: Comparison) -> None:
        """Take the comparison of one more interval."""
        part = self._part
        part.append(comparison)
        self._part_m += comparison.distance_m
        self._driven_m += comparison.distance_m
        while self._part_m - part[0].distance_m >= WINDOW_M or len(part) > self._most:
            self._part_m -= part.popleft().distance_m
        if self._part_m < WINDOW_M:
            return
        forward = sum(c.forward_m for c in part)
        left = sum(c.left_m for c in part)
        yaw = sum(c.yaw_rad for c in part)
        square = 0.5 * (forward * forward + left * left) - sum(c.variance_m2 for c in part)
        turn = yaw * yaw - sum(c.variance_rad2 for c in part)
        # Weighted by the added distance, so that standing still does not repeat the last metre.
        weight = comparison.distance_m
        metre = self._part_m * self._part_m
        entry = (weight, weight * square / metre, weight * turn / metre, self._driven_m)
        self._windows.append(entry)
        for index in range(3):
            self._sums[index] += entry[index]
        while self._driven_m - self._windows[0][3] > self._memory_m or len(self._windows) > self._most:
            old = self._windows.popleft()
            for index in range(3):
                self._sums[index] -= old[index]

    def __len__(self) -> int:
        """Return the number of kept comparisons and windows."""
        return len(self._part) + len(self._windows)

    def rate(self) -> DriftRate:
        """The estimate now."""
        weight = self._sums[0]
        if weight <= 0:
            return DriftRate(None, None, None, None, self._driven_m)
        translation = math.sqrt(max(self._sums[1] / weight, 0.0))
        rotation = math.sqrt(max(self._sums[2] / weight, 0.0))
        # A metre is about one independent sample; the standard error of an RMS of n is 1/sqrt(2 n) of it.
        metres = max(weight, 1.0)
        return DriftRate(
            translation, translation / math.sqrt(4 * metres), rotation, rotation / math.sqrt(2 * metres), self._driven_m
        )
