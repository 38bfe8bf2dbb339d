"""Slope of samples over time by the Theil-Sen estimator, which is robust to steps and spikes. Pure.

Samples within seconds of each other are correlated, so an interval from all of them would be too narrow. Therefore they
are first reduced to the median of each block.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import theilslopes

Array = NDArray[np.float64]

WARM_UP_S: Final = 300.0
"""Warm-up of a process, s, in which caches, histories and arenas fill (nano, 2 cores: of the runner's 279 MiB after
5 min, 12 MiB came in the first minute, 4 MiB in the next four, 0.2 MiB in the last)."""
SHORTEST_S: Final = 240.0
"""Least time after the warm-up for a meaningful slope per hour, s."""
BLOCK_S: Final = 10.0
"""Length of a block of samples that is reduced to its median, s."""


@dataclass(frozen=True)
class Slope:
    """Growth per hour with its 95 % interval, over the `seconds` of a process's life after the warm-up."""

    per_h: float
    low: float
    high: float
    seconds: float


def slope(
    times_s: Sequence[float], values: Sequence[float], warm_up_s: float = WARM_UP_S, shortest_s: float = SHORTEST_S
) -> Slope | None:
    """Return the slope of `values` [n] over `times_s` [n], s since the process began; None if it ran too shortly."""
    times, found = np.asarray(times_s, float), np.asarray(values, float)
    kept = times >= warm_up_s
    times, found = times[kept], found[kept]
    if len(times) < 2 or times[-1] - times[0] < shortest_s:
        return None
    at, medians = _blocks(times, found)
    per_s, _, low, high = (float(v) for v in theilslopes(medians, at, 0.95))
    return Slope(3600 * per_s, 3600 * low, 3600 * high, float(times[-1] - times[0]))


def _blocks(times: Array, values: Array) -> tuple[Array, Array]:
    blocks = np.floor((times - times[0]) / BLOCK_S).astype(int)
    chosen = [blocks == block for block in np.unique(blocks)]
    return np.array([times[one].mean() for one in chosen]), np.array([np.median(values[one]) for one in chosen])
