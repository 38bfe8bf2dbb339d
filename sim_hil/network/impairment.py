"""Impairment of one direction of a link. Pure: packet sizes and times in, arrival times out.

With the same seed, the n-th packet is lost, duplicated, reordered and delayed in the same way at any time; only
queueing and partitions depend on the clock.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

import numpy as np

_PERCENT: Final = ("loss_percent", "duplicate_percent", "reorder_percent")
_LARGEST: Final = 1e9
_STALE_S: Final = 1e9


@dataclass(frozen=True)
class Impairment:
    """Impairment of one direction of a link; the defaults describe a perfect link.

    `loss_percent` of packets are lost, in bursts of `loss_burst` packets on average (1: independently). A packet
    arrives after `delay_ms` with `jitter_ms` (standard deviation), in order of sending, except for the
    `reorder_percent` that arrive `reorder_ms` later. `duplicate_percent` arrive twice. `rate_kbps`: capacity in
    kilobits a second (0: unlimited); up to `queue_bytes` are queued, the rest is lost. During `partitions`, in seconds
    from the start ([[from, to], ...]), all packets are lost.
    """

    loss_percent: float = 0.0
    loss_burst: float = 1.0
    delay_ms: float = 0.0
    jitter_ms: float = 0.0
    duplicate_percent: float = 0.0
    reorder_percent: float = 0.0
    reorder_ms: float = 20.0
    rate_kbps: float = 0.0
    queue_bytes: int = 65536
    partitions: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "partitions":
                continue
            high = 100.0 if field.name in _PERCENT else _LARGEST
            low = 1.0 if field.name == "loss_burst" else 0.0
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
                raise ValueError(f"{field.name}: expected {low:g} to {high:g}, found {str(value)[:60]}")
        for begin, end in self.partitions:
            if not 0 <= begin < end <= _LARGEST:
                raise ValueError(f"partitions: expected pairs of seconds from < to, found [{begin}, {end}]")


PERFECT: Final = Impairment()


@dataclass
class Tally:
    """Packet counts so far."""

    packets: int = 0
    delivered: int = 0
    lost: int = 0
    partitioned: int = 0
    queue_full: int = 0
    duplicated: int = 0
    reordered: int = 0


class Direction:
    """State of one direction of a link; its clock starts at 0 and is monotonic."""

    def __init__(self, impairment: Impairment, seed: tuple[int, ...]) -> None:
        self.impairment = impairment
        """Current impairment; may be replaced at any time."""
        self.cut = False
        """While true, all packets are lost (partition)."""
        self.tally = Tally()
        self._rng = np.random.default_rng(seed)
        self._losing = False
        self._free_s = 0.0  # time at which the queue is empty
        self._last_s = -_STALE_S

    def offer(self, size_bytes: int, now_s: float) -> tuple[float, ...]:
        """Send a packet; return its arrival times: none, one or two."""
        tally, rule = self.tally, self.impairment
        tally.packets += 1
        # Always the same number of draws, so that one packet's impairment does not change the next one's.
        change, duplicate, reorder = (float(value) for value in self._rng.random(3))
        wobble, late_wobble = (float(value) for value in self._rng.standard_normal(2))
        lost = self._loses(rule, change)
        if self.cut or any(begin <= now_s < end for begin, end in rule.partitions):
            tally.partitioned += 1
            return ()
        if lost:
            tally.lost += 1
            return ()
        sent_s = self._sent(rule, size_bytes, now_s)
        if sent_s is None:
            tally.queue_full += 1
            return ()
        arrives_s = sent_s + 1e-3 * max(rule.delay_ms + rule.jitter_ms * wobble, 0.0)
        if 100.0 * reorder < rule.reorder_percent:
            tally.reordered += 1
            arrives_s += 1e-3 * rule.reorder_ms
        else:
            arrives_s = self._last_s = max(arrives_s, self._last_s)
        tally.delivered += 1
        if 100.0 * duplicate >= rule.duplicate_percent:
            return (arrives_s,)
        tally.duplicated += 1
        return (arrives_s, arrives_s + 1e-3 * abs(rule.jitter_ms * late_wobble))

    def _loses(self, rule: Impairment, chance: float) -> bool:
        """Return whether a packet is lost, by Gilbert's two-state model with the given loss share and burst length."""
        share = 0.01 * rule.loss_percent
        if share in (0.0, 1.0):
            self._losing = share == 1.0
        elif rule.loss_burst == 1.0:
            self._losing = chance < share
        elif self._losing:
            self._losing = chance >= 1.0 / rule.loss_burst
        else:
            self._losing = chance < min(share / (1.0 - share) / rule.loss_burst, 1.0)
        return self._losing

    def _sent(self, rule: Impairment, size_bytes: int, now_s: float) -> float | None:
        """Return the time at which the packet is sent; None if the queue is full."""
        if rule.rate_kbps == 0.0:
            return now_s
        bytes_per_s = 125.0 * rule.rate_kbps
        begin_s = max(self._free_s, now_s)
        if (begin_s - now_s) * bytes_per_s + size_bytes > rule.queue_bytes:
            return None
        self._free_s = begin_s + size_bytes / bytes_per_s
        return self._free_s
