"""Reproducible faults of a CAN bus. Pure: frames and times in, frames out.

One shim stands for one direction. With the same seed, the n-th frame suffers the same fault at any time; only the
duration of a fault depends on the clock.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from math import isfinite
from typing import Final

import numpy as np

from firmware_bridge.can.frame import ERROR_BUS_OFF, ERROR_RESTARTED, Frame

# A frame of 8 bytes with its stuff bits, about 130 bits, on a bus of 500 kbit/s.
FRAME_S: Final = 130 / 500_000
BABBLER_ID: Final = 0x000  # highest priority: wins every arbitration
_PROBABILITIES: Final = ("drop", "corrupt", "duplicate", "delay")


@dataclass(frozen=True)
class FaultPlan:
    """Faults of a bus: probabilities per frame (0..1), and timed faults.

    Probabilities: `drop`, `corrupt` (flips 1 to 3 data bits), `duplicate`, `delay` (by `delay_s`; later frames
    overtake). Every `bus_off_every_s` the bus is off for `bus_off_s` (0: never). A babbling idiot sends `babble_hz`
    frames of highest priority from `babble_from_s` for `babble_s` seconds; other frames wait or are never sent.
    """

    drop: float = 0.0
    corrupt: float = 0.0
    duplicate: float = 0.0
    delay: float = 0.0
    delay_s: float = 0.05
    bus_off_every_s: float = 0.0
    bus_off_s: float = 0.2
    babble_hz: float = 0.0
    babble_from_s: float = 0.0
    babble_s: float = 1e9

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            high = 1.0 if name in _PROBABILITIES else float("inf")
            if not (isfinite(value) and 0.0 <= value <= high):
                raise ValueError(f"CAN fault {name}: expected 0..{high:g}, found {value}")
        if 0.0 < self.bus_off_every_s <= self.bus_off_s:
            raise ValueError(f"CAN fault bus_off_every_s: expected more than bus_off_s, found {self.bus_off_every_s}")


class FaultShim:
    """One direction of a faulty bus: `put` frames in and `take` the arriving ones, with a monotonic clock."""

    def __init__(self, plan: FaultPlan, seed: int, direction: int) -> None:
        """Create one direction: 0 to the base, 1 from it; their faults are independent.

        `plan` may be replaced at any time; while `held_off` is true, the bus is off.
        """
        self.plan = plan
        self.held_off = False
        self._rng = np.random.default_rng((seed, 0xCA0, direction))
        self._waiting: list[tuple[float, int, Frame]] = []
        self._order = 0
        self._free_s = 0.0
        self._babbled_until_s: float | None = None  # None: not babbling
        self._off = False
        self._last_take_s = 0.0

    def put(self, frame: Frame, now_s: float) -> None:
        """Send a frame."""
        plan = self.plan
        # Always the same draws, so that the probability of one fault does not change the others' random numbers.
        drop, corrupt, duplicate, delay = (float(value) for value in self._rng.random(4))
        bits = self._rng.integers(0, 8 * max(len(frame.data), 1), self._rng.integers(1, 4))
        if self.is_off(now_s):
            return
        if drop < plan.drop:
            return
        if corrupt < plan.corrupt and frame.data:
            frame = self._corrupted(frame, bits.tolist())
        arrives_s = self._arrival(now_s)
        if arrives_s is None:
            return
        if delay < plan.delay:
            arrives_s += plan.delay_s
        self._queue(frame, arrives_s)
        if duplicate < plan.duplicate:
            self._queue(frame, arrives_s)

    def _corrupted(self, frame: Frame, bits: list[int]) -> Frame:
        data = bytearray(frame.data)
        for bit in set(bits):
            data[bit // 8] ^= 1 << bit % 8
        return Frame(frame.identifier, bytes(data), frame.error)

    def _arrival(self, now_s: float) -> float | None:
        """Return when a frame sent now gets onto the bus beside the babbler; None if never."""
        plan = self.plan
        if not self._babbling(now_s):
            return now_s
        share = plan.babble_hz * FRAME_S
        if share >= 1.0:
            return None
        self._free_s = max(self._free_s, now_s) + FRAME_S / (1.0 - share)
        return self._free_s

    def _babbling(self, now_s: float) -> bool:
        plan = self.plan
        return plan.babble_hz > 0 and plan.babble_from_s <= now_s < plan.babble_from_s + plan.babble_s

    def is_off(self, now_s: float) -> bool:
        """Return whether the bus is off at that time."""
        every_s = self.plan.bus_off_every_s
        return self.held_off or (every_s > 0 and now_s >= every_s and now_s % every_s < self.plan.bus_off_s)

    def _queue(self, frame: Frame, arrives_s: float) -> None:
        self._order += 1
        heapq.heappush(self._waiting, (arrives_s, self._order, frame))

    def take(self, now_s: float) -> list[Frame]:
        """Return the frames that have arrived, including the bus's error frames and the babbler's frames."""
        arrived = self._bus_state(now_s)
        if not self.is_off(now_s):
            arrived += self._babble(now_s)
        self._last_take_s = now_s
        while self._waiting and self._waiting[0][0] <= now_s:
            frame = heapq.heappop(self._waiting)[2]
            if not self._off:
                arrived.append(frame)
        return arrived

    def _bus_state(self, now_s: float) -> list[Frame]:
        off = self.is_off(now_s)
        if off == self._off:
            return []
        self._off = off
        return [Frame(ERROR_BUS_OFF if off else ERROR_RESTARTED, bytes(8), error=True)]

    def _babble(self, now_s: float) -> list[Frame]:
        """Return the babbler's frames since the last call, limited by the bus's capacity."""
        if not self._babbling(now_s):
            self._babbled_until_s = None
            return []
        if self._babbled_until_s is None:  # starts now, even if its period began earlier
            self._babbled_until_s = max(self.plan.babble_from_s, self._last_take_s)
        period_s = max(1 / self.plan.babble_hz, FRAME_S)
        count = int((now_s - self._babbled_until_s) / period_s + 1e-9)
        self._babbled_until_s += count * period_s
        return [Frame(BABBLER_ID, bytes(8))] * count
