"""What one direction of a link does to packets. Pure: sizes and times in, times of arrival out.

The fate of the n-th packet (lost, doubled, overtaken, how much later than others) is the same for the same seed,
whatever the clock says; only queueing and partitions are a matter of time.
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
    """One direction of a link. All zero, as by default, is a perfect one.

    `loss_percent` of packets are lost, in bursts of `loss_burst` on average (1: each for itself). A packet arrives
    after `delay_ms`, more or less `jitter_ms` (standard deviation), never before the one sent before it, unless it is
    one of the `reorder_percent` that are held `reorder_ms` longer and overtaken. `duplicate_percent` arrive twice.
    `rate_kbps` (0: any) is what passes, in kilobits a second; up to `queue_bytes` wait, the rest is lost. Nothing
    passes during `partitions`, seconds from the start: [[from, to], ...].
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
    """What has happened to packets so far."""

    packets: int = 0
    delivered: int = 0
    lost: int = 0
    partitioned: int = 0
    queue_full: int = 0
    duplicated: int = 0
    reordered: int = 0


class Direction:
    """One direction of a link; its clock starts at 0 and never goes back."""

    def __init__(self, impairment: Impairment, seed: tuple[int, ...]) -> None:
        self.impairment = impairment
        """May be replaced while packets pass."""
        self.cut = False
        """A partition for as long as this is set."""
        self.tally = Tally()
        self._rng = np.random.default_rng(seed)
        self._losing = False
        self._free_s = 0.0  # when the line has sent what is queued
        self._last_s = -_STALE_S

    def offer(self, size_bytes: int, now_s: float) -> tuple[float, ...]:
        """When a packet given to the line now arrives: never, once or twice."""
        tally, rule = self.tally, self.impairment
        tally.packets += 1
        # As many draws for every packet, so that one's fate does not move the next one's dice.
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
        """Two states, passing and losing (Gilbert): bursts of the mean length, in the long run the share of losses."""
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
        """When the line has sent the packet; None when its queue is full."""
        if rule.rate_kbps == 0.0:
            return now_s
        bytes_per_s = 125.0 * rule.rate_kbps
        begin_s = max(self._free_s, now_s)
        if (begin_s - now_s) * bytes_per_s + size_bytes > rule.queue_bytes:
            return None
        self._free_s = begin_s + size_bytes / bytes_per_s
        return self._free_s
