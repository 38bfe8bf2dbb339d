"""Whether something grows: slope of samples over time by Theil and Sen, which steps and spikes do not move. Pure.

Samples that follow each other within seconds tell the same thing twice, and an interval from all of them would be too
narrow: they are reduced to the median of each block first.
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
"""Of a process's life: caches, histories and arenas fill (nano, 2 cores: of the runner's 279 MiB after five minutes,
12 came in the first of them, 4 in the next four, the last of them 0.2)."""
SHORTEST_S: Final = 240.0
"""After the warm-up; over less time a slope per hour says nothing."""
BLOCK_S: Final = 10.0


@dataclass(frozen=True)
class Slope:
    """Growth per hour with its 95 % interval, of a process's life from the warm-up on (`seconds` of it)."""

    per_h: float
    low: float
    high: float
    seconds: float


def slope(
    times_s: Sequence[float], values: Sequence[float], warm_up_s: float = WARM_UP_S, shortest_s: float = SHORTEST_S
) -> Slope | None:
    """Slope of `values` [n] over `times_s` [n] since the process began; None where it lived too short a time."""
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
