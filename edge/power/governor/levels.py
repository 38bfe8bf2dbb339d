"""Learns the device's power with and without reasoning, from metered power and the share of reasoning."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

SMOOTH_S = 2.0
"""Time constant with which power and reasoning share are smoothed before the comparison."""
LEARN_S = 4.0
"""Time constant: a few times the period of the samples, shorter than a generation."""


@dataclass(frozen=True)
class Levels:
    """Power without reasoning, and the additional power of a running generation, W."""

    base_w: float
    rise_w: float

    def at(self, share: float) -> float:
        """Return the power with that share of reasoning, W."""
        return self.base_w + self.rise_w * share


class LevelEstimator:
    """Estimator of both levels by normalised least mean squares: a sample updates the level that it depends on."""

    def __init__(self, start: Levels | None) -> None:
        self._start = start
        self._base_w: float | None = None if start is None else start.base_w
        self._rise_w: float | None = None if start is None else start.rise_w
        self._smooth: tuple[float, float] | None = None

    @property
    def levels(self) -> Levels | None:
        """The estimate; None before the first sample without an initial model."""
        return None if self._base_w is None else Levels(self._base_w, self._rise_w or 0.0)

    def add(self, power_w: float, share: float, dt_s: float) -> None:
        """Take a sample during which reasoning ran `share` (0 to 1) of the time."""
        if self._base_w is None:
            self._base_w = power_w
        if self._smooth is not None:
            # A meter that averages over a second is late: delay the reasoning share equally before the comparison.
            keep = math.exp(-dt_s / SMOOTH_S)
            power_w += (self._smooth[0] - power_w) * keep
            share += (self._smooth[1] - share) * keep
        self._smooth = (power_w, share)
        if self._rise_w is None:
            if share < 0.5:
                self._base_w += (power_w - self._base_w) * (1 - math.exp(-dt_s / LEARN_S))
                return
            self._rise_w = max(0.0, (power_w - self._base_w) / share)
        busy_w = self._base_w + self._rise_w
        error = power_w - (self._base_w * (1 - share) + busy_w * share)
        step = error * (1 - math.exp(-dt_s / LEARN_S)) / ((1 - share) ** 2 + share**2)
        busy_w += step * share
        if share < 0.02:
            busy_w += step  # a change of idle power applies during reasoning too
        self._base_w += step * (1 - share)
        self._rise_w = max(0.0, busy_w - self._base_w)


class GenerationTimes:
    """Durations of generations under each token cap, from counts of busy time and finished generations."""

    KEEP = 4

    def __init__(self, caps: int) -> None:
        self._recent: tuple[deque[float], ...] = tuple(deque(maxlen=self.KEEP) for _ in range(caps))
        self._done = 0
        self._busy_s = 0.0
        self._abandoned = 0

    def update(self, generations: int, busy_s: float, cap: int, abandoned: int = 0) -> None:
        """Counts so far, which only grow, and the cap under which the last generation was started.

        `abandoned`: generations that were begun and not finished; their time is not a generation's duration.
        """
        if abandoned > self._abandoned and generations == self._done:
            self._busy_s = busy_s
        self._abandoned = abandoned
        if generations > self._done:
            if cap < len(self._recent):
                self._recent[cap].append((busy_s - self._busy_s) / (generations - self._done))
            self._done, self._busy_s = generations, busy_s

    def longest_s(self, cap: int) -> float | None:
        """Return the longest of the last few durations under that cap, s; None before the first."""
        return max(self._recent[cap], default=None)

    def nearest(self, cap: int) -> tuple[int, float] | None:
        """Return the nearest measured cap and its mean duration, s; None without any."""
        known = [(abs(other - cap), other) for other in range(len(self._recent)) if self._recent[other]]
        if not known:
            return None
        other = min(known)[1]
        return other, sum(self._recent[other]) / len(self._recent[other])


def worst_share(generation_s: float, pause_s: float, window_s: float) -> float:
    """Return the largest share of a window in generations that repeat after a pause."""
    cycle_s = generation_s + pause_s
    if cycle_s <= 0:
        return 1.0
    whole = math.floor(window_s / cycle_s)
    return min(1.0, (whole * generation_s + min(window_s - whole * cycle_s, generation_s)) / window_s)


def pause_for(share: float, generation_s: float, window_s: float, tolerance_s: float = 0.01) -> float:
    """Return the shortest pause that keeps every window's share at or below `share`, s; infinite where none does."""
    if share >= 1.0:
        return 0.0
    if share <= 0.0 or generation_s >= share * window_s:
        # One generation in a window must fit whatever the pause.
        return math.inf if generation_s > share * window_s or share <= 0.0 else window_s
    low, high = 0.0, window_s
    while high - low > tolerance_s:
        middle = (low + high) / 2
        low, high = (middle, high) if worst_share(generation_s, middle, window_s) > share else (low, middle)
    return high
