"""Distribution of a semantic state's delay: the paper's uniform one, or that of a device's latencies.

A state is released L after its newest frame was captured. The next generation starts at that moment and takes L', and
until then the state is used. At a random instant the delay is therefore L plus the time since the release, and the
instant lies in a long L' more likely than in a short one. With a constant L the delay is uniform over [L, 2L].
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.latency_profile import LatencyProfile, load_profile
from tools.train.config.collect import RATE_HZ
from tools.train.config.imitate import DelayConfig

Array = NDArray[np.float64]

_MOST_TIMES: Final = 1000  # larger profiles are reduced to this many quantiles
_ROUNDING: Final = 1e-12  # probabilities below this are set to zero


@dataclass(frozen=True)
class Delays:
    """Distribution of the delay Δt in units of 0.1 s, the spacing of frames."""

    mass: Array
    """[J]: probability that Δt, rounded, is j units; the sum is 1."""

    def __post_init__(self) -> None:
        whole = float(self.mass.sum())
        if self.mass.ndim != 1 or not len(self.mass) or np.any(self.mass < 0) or not math.isclose(whole, 1.0):
            raise ValueError(f"delays: expected probabilities with sum 1, found {self.mass.shape} with sum {whole:g}")

    @staticmethod
    def of(config: DelayConfig) -> Delays:
        """Build the distribution of a configuration. Raises LatencyError for an unusable profile."""
        return Delays.of_profile(load_profile(Path(config.profile))) if config.profile else Delays.uniform(config)

    @staticmethod
    def none() -> Delays:
        """Return the distribution without delay."""
        return Delays(np.ones(1))

    @staticmethod
    def uniform(config: DelayConfig) -> Delays:
        """Return U(low_s, high_s), mixed with U(low_s, near_s)."""
        edges, low_s = _edges(config.high_s), config.low_s
        reached = np.clip((edges - low_s) / (config.high_s - low_s), 0.0, 1.0)
        if config.near_share:
            reached += config.near_share * (np.clip((edges - low_s) / (config.near_s - low_s), 0.0, 1.0) - reached)
        return _of_cdf(reached)

    @staticmethod
    def of_profile(profile: LatencyProfile) -> Delays:
        """Return the delays of a device's runner, generation after generation, from its measured latencies."""
        times = np.array(profile.generation_s)
        ages = times - np.array(profile.anchor_after_s or (0.0,))
        if times.max() <= 0:
            return Delays.none()
        times, ages = _thinned(times), _thinned(ages)
        edges = _edges(float(ages.max() + times.max()))
        # The time e since the release has the density P(L' > e) / E[L'] (renewal theory).
        below = np.cumsum(times) / times.sum()
        elapsed = np.maximum(edges[:, None] - ages[None], 0.0)
        shorter = np.searchsorted(times, elapsed, side="right")
        share = np.where(shorter > 0, below[shorter - 1], 0.0) + elapsed * (len(times) - shorter) / times.sum()
        return _of_cdf(share.mean(axis=1))

    @property
    def beyond(self) -> Array:
        """Probabilities [J] that Δt is more than j units; exactly 0 beyond the longest delay."""
        return np.append(np.cumsum(self.mass[:0:-1])[::-1], 0.0)

    @property
    def mean_s(self) -> float:
        """Mean delay, s."""
        return float(self.mass @ np.arange(len(self.mass))) / RATE_HZ


def _thinned(values: Array) -> Array:
    """Sort values, and reduce them to evenly spaced quantiles if there are more than _MOST_TIMES."""
    ordered = np.sort(values)
    if len(ordered) <= _MOST_TIMES:
        return ordered
    return ordered[np.linspace(0, len(ordered) - 1, _MOST_TIMES).round().astype(np.int64)]


def _edges(longest_s: float) -> Array:
    """Return the upper edges, s, of the bins of 0.1 s up to `longest_s`."""
    return (np.arange(math.ceil(longest_s * RATE_HZ - 1e-9) + 1) + 0.5) / RATE_HZ


def _of_cdf(reached: Array) -> Delays:
    """Build a distribution from the probabilities of being below each upper edge; the last is 1 up to rounding."""
    mass = np.diff(reached, prepend=0.0)
    mass[mass < _ROUNDING] = 0.0
    return Delays(mass / mass.sum())
