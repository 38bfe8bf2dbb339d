"""Impairment of a link in both directions: loss, delay, jitter, duplicates, reordering. Pure: packets and times in,
packets out.

With the same seed, the n-th packet of a direction is lost, duplicated, reordered and delayed in the same way at any
time.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from typing import Final, Generic, TypeVar

import numpy as np

T = TypeVar("T")
_MAX_DELAYED: Final = 4096  # packets under way in one direction; more are lost
_MOST_IMPAIRED: Final = 60_000.0
_FORGOTTEN_S: Final = 1e9


@dataclass(frozen=True)
class Impairment:
    """Impairment of both directions of a link; the defaults describe a perfect link.

    `loss_percent` of packets are lost, in bursts of `loss_burst` packets on average (1: independently). A packet
    arrives after `delay_ms` with `jitter_ms` (standard deviation), in order of sending, except for the
    `reorder_percent` that arrive `reorder_ms` later. `duplicate_percent` arrive twice.
    """

    loss_percent: float = 0.0
    loss_burst: float = 1.0
    delay_ms: float = 0.0
    jitter_ms: float = 0.0
    duplicate_percent: float = 0.0
    reorder_percent: float = 0.0
    reorder_ms: float = 20.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            low = 1.0 if name == "loss_burst" else 0.0
            high = 100.0 if name.endswith("percent") else _MOST_IMPAIRED
            if not low <= value <= high:
                raise ValueError(f"{name}: expected {low:g} to {high:g}, found {value}")


PERFECT: Final = Impairment()


class ImpairedDirection(Generic[T]):
    """One direction of an impaired link: `put` packets in and `take` the arriving ones, with a monotonic clock, s."""

    def __init__(self, seed: int, direction: int) -> None:
        """Create one direction; the faults of both are independent."""
        self._rng = np.random.default_rng((seed, 0xDA7A, direction))
        self._losing = False
        self._last_s = -_FORGOTTEN_S
        self._waiting: list[tuple[float, int, T]] = []
        self._order = 0

    def put(self, packet: T, plan: Impairment, now_s: float) -> None:
        """Send a packet."""
        # Always the same draws, so that one fault does not change the random numbers of the others.
        chance, duplicate, reorder = (float(value) for value in self._rng.random(3))
        wobble, late_wobble = (float(value) for value in self._rng.standard_normal(2))
        if self._loses(plan, chance) or len(self._waiting) >= _MAX_DELAYED:
            return
        arrives_s = now_s + 1e-3 * max(plan.delay_ms + plan.jitter_ms * wobble, 0.0)
        if 100.0 * reorder < plan.reorder_percent:
            arrives_s += 1e-3 * plan.reorder_ms
        else:
            arrives_s = self._last_s = max(arrives_s, self._last_s)
        self._queue(packet, arrives_s)
        if 100.0 * duplicate < plan.duplicate_percent:
            self._queue(packet, arrives_s + 1e-3 * abs(plan.jitter_ms * late_wobble))

    def take(self, now_s: float) -> list[T]:
        """Return the packets that have arrived."""
        arrived = []
        while self._waiting and self._waiting[0][0] <= now_s:
            arrived.append(heapq.heappop(self._waiting)[2])
        return arrived

    def _queue(self, packet: T, arrives_s: float) -> None:
        self._order += 1
        heapq.heappush(self._waiting, (arrives_s, self._order, packet))

    def _loses(self, plan: Impairment, chance: float) -> bool:
        """Return whether a packet is lost, by Gilbert's two-state model with the given loss share and burst length."""
        share = 0.01 * plan.loss_percent
        if share in (0.0, 1.0):
            self._losing = share == 1.0
        elif plan.loss_burst == 1.0:
            self._losing = chance < share
        elif self._losing:
            self._losing = chance >= 1.0 / plan.loss_burst
        else:
            self._losing = chance < min(share / (1.0 - share) / plan.loss_burst, 1.0)
        return self._losing
