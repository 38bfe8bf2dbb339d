"""How old a semantic state is when it is acted on: the paper's uniform delay, or a device's own generation times.

A state is released L after its newest frame was captured; the next generation starts at that moment and is there L'
later, and until then the state is acted on. An instant taken at random therefore sees an age of L plus what has elapsed
since the release, and it is the likelier to lie in a long L' than in a short one. With a constant L the age is uniform
over [L, 2L].
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

_MOST_TIMES: Final = 1000  # of a profile: more are stood for by as many of their order statistics
_ROUNDING: Final = 1e-12


@dataclass(frozen=True)
class Delays:
    """Distribution of the age Δt in tenths of a second, which is how far frames are apart."""

    mass: Array
    """[J]: chance that Δt, rounded, is j tenths of a second; adds up to 1."""

    def __post_init__(self) -> None:
        whole = float(self.mass.sum())
        if self.mass.ndim != 1 or not len(self.mass) or np.any(self.mass < 0) or not math.isclose(whole, 1.0):
            raise ValueError(f"delays: expected chances that add up to 1, found {self.mass.shape} with sum {whole:g}")

    @staticmethod
    def of(config: DelayConfig) -> Delays:
        """The distribution that `config` describes; raises LatencyError for a profile that cannot be used."""
        return Delays.of_profile(load_profile(Path(config.profile))) if config.profile else Delays.uniform(config)

    @staticmethod
    def none() -> Delays:
        """Every state is of now: training that knows of no delay."""
        return Delays(np.ones(1))

    @staticmethod
    def uniform(config: DelayConfig) -> Delays:
        """U(low_s, high_s), mixed with U(low_s, near_s)."""
        edges, low_s = _edges(config.high_s), config.low_s
        reached = np.clip((edges - low_s) / (config.high_s - low_s), 0.0, 1.0)
        if config.near_share:
            reached += config.near_share * (np.clip((edges - low_s) / (config.near_s - low_s), 0.0, 1.0) - reached)
        return _of_cdf(reached)

    @staticmethod
    def of_profile(profile: LatencyProfile) -> Delays:
        """Ages that a device's runner acts on, generation after generation, from its measured times."""
        times = np.array(profile.generation_s)
        ages = times - np.array(profile.anchor_after_s or (0.0,))
        if times.max() <= 0:
            return Delays.none()
        times, ages = _thinned(times), _thinned(ages)
        edges = _edges(float(ages.max() + times.max()))
        # Elapsed time e since a release has density P(L' > e) / E[L']: an instant meets a long interval more often.
        below = np.cumsum(times) / times.sum()
        elapsed = np.maximum(edges[:, None] - ages[None], 0.0)
        shorter = np.searchsorted(times, elapsed, side="right")
        share = np.where(shorter > 0, below[shorter - 1], 0.0) + elapsed * (len(times) - shorter) / times.sum()
        return _of_cdf(share.mean(axis=1))

    @property
    def beyond(self) -> Array:
        """[J]: chance that Δt is more than j tenths of a second; exactly 0 where there is none."""
        return np.append(np.cumsum(self.mass[:0:-1])[::-1], 0.0)

    @property
    def mean_s(self) -> float:
        """Mean age, s."""
        return float(self.mass @ np.arange(len(self.mass))) / RATE_HZ


def _thinned(values: Array) -> Array:
    """Sorted, and evenly spaced ones of them if they are many."""
    ordered = np.sort(values)
    if len(ordered) <= _MOST_TIMES:
        return ordered
    return ordered[np.linspace(0, len(ordered) - 1, _MOST_TIMES).round().astype(np.int64)]


def _edges(longest_s: float) -> Array:
    """Upper edges, s, of the tenths of a second up to `longest_s`."""
    return (np.arange(math.ceil(longest_s * RATE_HZ - 1e-9) + 1) + 0.5) / RATE_HZ


def _of_cdf(reached: Array) -> Delays:
    """From the chance to be below each upper edge; the last one is 1 but for rounding."""
    mass = np.diff(reached, prepend=0.0)
    mass[mass < _ROUNDING] = 0.0
    return Delays(mass / mass.sum())
