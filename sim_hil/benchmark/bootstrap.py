"""Confidence intervals by resampling episodes: seeded, so that the same results give the same interval."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

RESAMPLES = 10_000
SEED = 85  # of every interval of a report
_TAG = 0xB007


def mean_ci95(values: Sequence[float], seed: int = SEED, resamples: int = RESAMPLES) -> tuple[float, float] | None:
    """95 % percentile bootstrap interval of the mean of per-episode values; None for fewer than two of them."""
    if len(values) < 2:
        return None
    means = _resampled_means(np.asarray(values, dtype=np.float64), seed, resamples)
    low, high = np.percentile(means, (2.5, 97.5))
    return float(low), float(high)


def paired_ci95(
    before: Sequence[float], after: Sequence[float], seed: int = SEED, resamples: int = RESAMPLES
) -> tuple[float, float] | None:
    """The same for the mean of `after - before`, episode by episode. Raises ValueError on different lengths."""
    if len(before) != len(after):
        raise ValueError(f"paired bootstrap: expected as many values on both sides, found {len(before)}, {len(after)}")
    return mean_ci95([b - a for a, b in zip(before, after, strict=True)], seed, resamples)


def _resampled_means(values: NDArray[np.float64], seed: int, resamples: int) -> NDArray[np.float64]:
    rng = np.random.default_rng((seed, _TAG))
    picks = rng.integers(0, len(values), size=(resamples, len(values)))
    return np.asarray(values[picks].mean(axis=1))
