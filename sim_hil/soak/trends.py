"""How a soak's figures change with its time: one value a minute, and the line through them with its interval. Pure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import theilslopes

from sim_hil.realtime.host_stall import Stalls, stalled_ns

Array = NDArray[np.float64]
Analysis = Mapping[str, Any]

BRIDGE_PERIOD_MS: Final = 20.0  # rate_hz = 50 in the simulated robot's file
WINDOW_S: Final = 60.0
LEAST_WINDOWS: Final = 10


def offsets_s(legs: Sequence[Analysis]) -> list[float]:
    """Return each leg's start time, s since the soak began; legs may come from several machines."""
    return [float(sum(leg["elapsed_s"] for leg in legs[:index])) for index in range(len(legs))]


def soak_times_s(leg: Analysis, offset_s: float, stamps_ns: Sequence[int]) -> Array:
    """Return stamps [n] of a leg as seconds of the soak."""
    times: Array = (np.array(stamps_ns, float) - leg["begin_ns"]) / 1e9 + offset_s
    return times


@dataclass(frozen=True)
class Series:
    """One figure over time: `read` gives the stamps (ns) and values of a leg, `percentile` is that of a window."""

    unit: str
    percentile: float
    read: Callable[[Analysis], tuple[list[int], list[float | None]]]


class Trend(NamedTuple):
    """Change per hour with its 95 % interval, the value at the soak's begin, and the number of windows."""

    per_h: float
    low: float
    high: float
    begin: float
    number: int


def _of_lives(stamps: str, values: str) -> Callable[[Analysis], tuple[list[int], list[float | None]]]:
    def read(leg: Analysis) -> tuple[list[int], list[float | None]]:
        lives = leg["lives"]
        return [t for life in lives for t in life[stamps]], [v for life in lives for v in life[values]]

    return read


def stalls_of(leg: Analysis) -> Stalls:
    """Return a leg's stalls of the machine; none where they were not measured."""
    return np.array(leg.get("stalls") or [], np.int64).reshape(-1, 2)


def jitter_ms(leg: Analysis) -> Array:
    """Return how far each gap between two commands [n] is off the bridge's period, less the machine's stalls, ms.

    Only what stalls after a command is due counts: also on one processor alone, where the scheduler may have put the
    bridge. A short gap is reduced by the stalls of the gap before it.
    """
    off: Array = np.array(leg["command_gap_ms"], float) - BRIDGE_PERIOD_MS
    end_ns = np.array(leg["command_ns"], np.int64)
    begin_ns = end_ns - np.rint((off + BRIDGE_PERIOD_MS) * 1e6).astype(np.int64)
    stalls = stalls_of(leg)
    due_ns = begin_ns + round(BRIDGE_PERIOD_MS * 1e6)
    stalled = stalled_ns(stalls, np.minimum(due_ns, end_ns), end_ns) / 1e6
    follows = np.abs(begin_ns[1:] - end_ns[:-1]) < 1_000_000
    before = np.concatenate((np.zeros(min(1, len(off))), np.where(follows, stalled[:-1], 0)))
    jitter: Array = np.maximum(np.abs(off) - np.where(off > 0, stalled, before), 0)
    return jitter


def _jitter(leg: Analysis) -> tuple[list[int], list[float | None]]:
    return leg["command_ns"], jitter_ms(leg).tolist()


SERIES: Final[Mapping[str, Series]] = {
    "tick_ms.p99": Series("ms", 99, _of_lives("tick_ns", "tick_ms")),
    "delay_s.p50": Series("s", 50, _of_lives("tick_ns", "delay_s")),
    "generation_ms.p50": Series("ms", 50, _of_lives("ready_ns", "generation_ms")),
    "bridge_jitter_ms.p99": Series("ms", 99, _jitter),
}
"""Figures whose trend is drawn and may stand in a budget."""


def windows(legs: Sequence[Analysis], series: Series) -> tuple[Array, Array]:
    """Return (middle of each window with data, s of the soak; its value)."""
    found: list[tuple[Array, Array]] = []
    for leg, offset_s in zip(legs, offsets_s(legs), strict=True):
        stamps, values = series.read(leg)
        found.append((soak_times_s(leg, offset_s, stamps), np.array([np.nan if v is None else v for v in values])))
    at = np.concatenate([times for times, _ in found]) if found else np.array([])
    values_all = np.concatenate([each for _, each in found]) if found else np.array([])
    good = np.isfinite(values_all)
    where = np.floor(at[good] / WINDOW_S)
    indices = np.unique(where)
    reduced = [float(np.percentile(values_all[good][where == index], series.percentile)) for index in indices]
    return (indices + 0.5) * WINDOW_S, np.array(reduced)


def trend(at_s: Array, values: Array) -> Trend | None:
    """Return the Theil-Sen line through `values` [n] at `at_s` [n]; None below LEAST_WINDOWS values."""
    if len(values) < LEAST_WINDOWS:
        return None
    per_s, begin, low, high = (float(v) for v in theilslopes(values, at_s, 0.95))
    return Trend(3600 * per_s, 3600 * low, 3600 * high, begin, len(values))


def trends(legs: Sequence[Analysis]) -> dict[str, Trend | None]:
    """Return the trend of every series."""
    return {name: trend(*windows(legs, series)) for name, series in SERIES.items()}
