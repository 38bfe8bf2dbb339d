"""Summaries of measured samples for result files."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def percentiles(samples: Sequence[float], *points: str) -> dict[str, float | None]:
    """`p50`, `p99`, `p999`, `max` of the samples (nearest rank: each is a value that occurred); None if empty."""
    if not samples:
        return dict.fromkeys(points)
    quantiles = {"p50": 50.0, "p99": 99.0, "p999": 99.9, "max": 100.0}
    return {p: round(float(np.percentile(samples, quantiles[p], method="inverted_cdf")), 4) for p in points}
