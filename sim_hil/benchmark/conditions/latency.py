"""Latency of a generation in virtual time: a constant, or a random draw from measured times for each generation.

A profile with durations of decoding calls counts the calls that each text takes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from zlib import crc32

import numpy as np

from edge.inference.latency_profile import LatencyError, LatencyProfile, load_profile

__all__ = ["LatencyError", "LatencyProfile", "LatencySampler", "Timing", "load_profile", "parse_latency"]

_TAG = 0x1A7E


@dataclass(frozen=True)
class Timing:
    """Times of one generation from its start, ns: capture of its newest frame, and release of its result."""

    total_ns: int
    """With `decode_ns`: without the decoding calls after the first token."""
    anchor_after_ns: int
    decode_ns: Callable[[Sequence[int]], int] | None = None
    """Returns the duration of those calls from the tokens that each feeds; None: the text changes no time."""


class LatencySampler:
    """Random latencies for one episode; the same profile, seed and episode id give the same sequence."""

    def __init__(self, profile: LatencyProfile, seed: int, episode_id: str, *, by_calls: bool = False) -> None:
        """`by_calls`: count the decoding calls of each text, where the profile has their durations."""
        self._profile = profile
        self._by_calls = by_calls and bool(profile.call_s)
        self._rng = np.random.default_rng((seed, crc32(episode_id.encode()), _TAG))

    def draw(self) -> Timing:
        """Return the times of the next generation."""
        profile, anchors = self._profile, self._profile.anchor_after_s
        times = profile.rest_s if self._by_calls else profile.generation_s
        index = int(self._rng.integers(len(times))) if len(times) > 1 else 0
        anchor_ns = _ns(anchors[index]) if anchors else 0
        if not self._by_calls:
            return Timing(_ns(times[index]), anchor_ns)
        return Timing(_ns(times[index]), anchor_ns, lambda call_tokens: _ns(profile.decode_s(call_tokens)))


def parse_latency(argument: str) -> LatencyProfile:
    """Parse the value of `--latency`: seconds or `profile:FILE`. Raises LatencyError with one line."""
    kind, _, where = argument.partition(":")
    if kind == "profile":
        return load_profile(Path(where))
    try:
        seconds = float(argument)
    except ValueError:
        raise LatencyError(f"--latency {argument!r}: expected seconds, or profile:FILE") from None
    try:
        return LatencyProfile.constant(seconds)
    except LatencyError as error:
        raise LatencyError(f"--latency {argument!r}: {error}") from error


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
