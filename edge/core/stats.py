"""Summaries of measured samples for result files, in memory that does not grow with the length of a run."""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence

import numpy as np

EXACT = 65_536
"""Number of samples stored exactly: 1.8 h of ticks at 10 Hz in 512 KiB."""
_LOW, _RATIO, _BINS = 1e-3, 1.01, 2084
"""Histogram of later samples: bins 1 % wide from 0.001 to 10⁶, in the samples' unit."""
_QUANTILES = {"p50": 0.5, "p99": 0.99, "p999": 0.999, "max": 1.0}


class Samples:
    """Measured values: percentiles are exact for the first `EXACT` of them, then within 1 %; the maximum always is."""

    def __init__(self, exact: int = EXACT) -> None:
        self._values = array("d", bytes(8 * exact))
        self._bins = array("q", bytes(8 * (_BINS + 2)))
        self._count = 0
        self._max = -math.inf
        self.newest: float | None = None

    def __len__(self) -> int:
        return self._count

    def add(self, value: float) -> None:
        """Count one value; a value that is not finite is left out."""
        if not math.isfinite(value):
            return
        if self._count < len(self._values):
            self._values[self._count] = value
        position = 0 if value < _LOW else 1 + int(math.log(value / _LOW) / math.log(_RATIO))
        self._bins[min(position, _BINS + 1)] += 1
        self._count += 1
        self._max = max(self._max, value)
        self.newest = value

    def quantile(self, share: float) -> float | None:
        """Return the smallest value that `share` of all samples or more do not exceed (nearest rank); None if empty."""
        if self._count == 0:
            return None
        if share >= 1:
            return self._max
        if self._count <= len(self._values):
            kept = np.frombuffer(self._values, dtype=np.float64)[: self._count]
            return float(np.percentile(kept, share * 100, method="inverted_cdf"))
        rank, seen = math.ceil(share * self._count), 0
        for position, count in enumerate(self._bins):
            seen += count
            if seen >= rank:
                return min(_LOW * _RATIO**position, self._max)
        return self._max


def percentiles(samples: Samples | Sequence[float], *points: str) -> dict[str, float | None]:
    """`p50`, `p99`, `p999`, `max` of the samples (nearest rank: each is a value that occurred); None if empty."""
    if not isinstance(samples, Samples):
        counted = Samples(len(samples))
        for value in samples:
            counted.add(value)
        samples = counted
    values = {point: samples.quantile(_QUANTILES[point]) for point in points}
    return {point: None if value is None else round(value, 4) for point, value in values.items()}
