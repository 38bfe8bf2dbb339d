"""What can go wrong between two nodes of a bus, on purpose and repeatably. Pure: frames and times in, frames out.

One shim stands for one direction. The n-th frame meets the same fate for the same seed, whatever the clock says; only
how long a fault lasts is a matter of time.
"""

from __future__ import annotations

import heapq
from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import isfinite
from typing import Final

import numpy as np

from sim_hil.protocols.can.e2e import Frame
from sim_hil.protocols.can.node import ERROR_BUS_OFF, ERROR_RESTARTED

# A frame of 8 bytes with its stuff bits, about 130 bits, on a bus of 500 kbit/s.
FRAME_S: Final = 130 / 500_000
BABBLER_ID: Final = 0x000  # wins every arbitration
_PROBABILITIES: Final = ("drop", "corrupt", "duplicate", "delay")


@dataclass(frozen=True)
class FaultPlan:
    """Probabilities per frame (0..1), and what happens by the clock.

    `drop`, `corrupt` (1 to 3 bits of the data flipped), `duplicate`, `delay` (by `delay_s`; later frames overtake it).
    Every `bus_off_every_s` the bus is off for `bus_off_s` (0: never). A babbling idiot sends `babble_hz` frames of the
    highest priority from `babble_from_s` on for `babble_s` seconds; the others wait, or find no gap at all.
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

    @staticmethod
    def parse(text: str) -> FaultPlan:
        """From `drop=0.1,corrupt=0.05`; raises ValueError with one clear line."""
        known = {each.name for each in fields(FaultPlan)}
        values: dict[str, float] = {}
        for part in text.split(","):
            name, equals, number = part.partition("=")
            if not equals or name not in known:
                raise ValueError(f"CAN faults: expected NAME=NUMBER of {', '.join(sorted(known))}, found {part!r}")
            try:
                values[name] = float(number)
            except ValueError:
                raise ValueError(f"CAN faults: {name}: expected a number, found {number!r}") from None
        return FaultPlan(**values)


class FaultShim:
    """One direction of a faulty bus: `put` frames in, `take` what arrives; both with a clock that never goes back."""

    def __init__(self, plan: FaultPlan, seed: int, direction: int) -> None:
        """`direction`: 0 to the base, 1 from it; the two go wrong independently.

        `plan` may be replaced while it runs; `held_off`: the bus is off until it is taken back.
        """
        self.plan = plan
        self.held_off = False
        self._rng = np.random.default_rng((seed, 0xCA0, direction))
        self._waiting: list[tuple[float, int, Frame]] = []
        self._order = 0
        self._free_s = 0.0
        self._babbled_until_s: float | None = None  # None: it is silent
        self._off = False
        self._looked_s = 0.0
        self._done = dict.fromkeys(("drop", "corrupt", "duplicate", "delay", "bus_off", "babble", "starved"), 0)

    @property
    def done(self) -> Mapping[str, int]:
        """How often each fault has happened."""
        return dict(self._done)

    def put(self, frame: Frame, now_s: float) -> None:
        """Give a frame to the bus."""
        plan = self.plan
        # The same four draws for every frame, so that one fault's probability does not move the others' dice.
        drop, corrupt, duplicate, delay = (float(value) for value in self._rng.random(4))
        bits = self._rng.integers(0, 8 * max(len(frame.data), 1), self._rng.integers(1, 4))
        if self.is_off(now_s):
            return
        if drop < plan.drop:
            self._done["drop"] += 1
            return
        if corrupt < plan.corrupt and frame.data:
            frame = self._corrupted(frame, bits.tolist())
        arrives_s = self._arrival(now_s)
        if arrives_s is None:
            return
        if delay < plan.delay:
            self._done["delay"] += 1
            arrives_s += plan.delay_s
        self._queue(frame, arrives_s)
        if duplicate < plan.duplicate:
            self._done["duplicate"] += 1
            self._queue(frame, arrives_s)

    def _corrupted(self, frame: Frame, bits: list[int]) -> Frame:
        self._done["corrupt"] += 1
        data = bytearray(frame.data)
        for bit in set(bits):
            data[bit // 8] ^= 1 << bit % 8
        return Frame(frame.identifier, bytes(data), frame.error)

    def _arrival(self, now_s: float) -> float | None:
        """When a frame that is sent now gets its gap beside the babbler; None when there is none."""
        plan = self.plan
        if not self._babbling(now_s):
            return now_s
        share = plan.babble_hz * FRAME_S
        if share >= 1.0:
            self._done["starved"] += 1
            return None
        self._free_s = max(self._free_s, now_s) + FRAME_S / (1.0 - share)
        return self._free_s

    def _babbling(self, now_s: float) -> bool:
        plan = self.plan
        return plan.babble_hz > 0 and plan.babble_from_s <= now_s < plan.babble_from_s + plan.babble_s

    def is_off(self, now_s: float) -> bool:
        """Whether nothing passes at that time."""
        every_s = self.plan.bus_off_every_s
        return self.held_off or (every_s > 0 and now_s >= every_s and now_s % every_s < self.plan.bus_off_s)

    def _queue(self, frame: Frame, arrives_s: float) -> None:
        self._order += 1
        heapq.heappush(self._waiting, (arrives_s, self._order, frame))

    def take(self, now_s: float) -> list[Frame]:
        """What arrives up to now, error frames of the bus and the babbler's frames included."""
        arrived = self._bus_state(now_s)
        if not self.is_off(now_s):
            arrived += self._babble(now_s)
        self._looked_s = now_s
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
        self._done["bus_off"] += off
        return [Frame(ERROR_BUS_OFF if off else ERROR_RESTARTED, bytes(8), error=True)]

    def _babble(self, now_s: float) -> list[Frame]:
        """The babbler's frames since the last look; it fills the bus and no more."""
        if not self._babbling(now_s):
            self._babbled_until_s = None
            return []
        if self._babbled_until_s is None:  # from now on, however long its time has been running
            self._babbled_until_s = max(self.plan.babble_from_s, self._looked_s)
        period_s = max(1 / self.plan.babble_hz, FRAME_S)
        count = int((now_s - self._babbled_until_s) / period_s + 1e-9)
        self._babbled_until_s += count * period_s
        self._done["babble"] += count
        return [Frame(BABBLER_ID, bytes(8))] * count
