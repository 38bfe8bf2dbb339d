"""Load of the bus: what the DBC file plans, and what was seen. Pure."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

_WINDOW_NS: Final = 1_000_000_000
_HIGH: Final = 0.8  # our choice: above it, frames of low priority wait for several cycles
_MOST_IDS: Final = 64  # unknown identifiers remembered in one window


def bits_of_frame(length: int) -> int:
    """Return the bits that a CAN 2.0A frame takes at most, with stuff bits and interframe space.

    Source: 34 bits of head and CRC and the data may be stuffed after every fourth bit; 13 more bits may not.
    """
    stuffed = 34 + 8 * length
    return stuffed + 13 + (stuffed - 1) // 4


def planned_load(messages: Iterable[tuple[int, float]], bitrate_bps: int) -> float:
    """Return the share of the bus that cyclic messages of (bytes, cycle time in s) take."""
    return sum(bits_of_frame(length) / cycle_s for length, cycle_s in messages) / bitrate_bps


class TrafficWatch:
    """Load of the bus in the last full second, and the unknown identifier with the most frames."""

    def __init__(self, bitrate_bps: int, now_ns: int) -> None:
        self._bitrate_bps = bitrate_bps
        self._bits = 0
        self._ids: dict[int, int] = {}
        self._end_ns = now_ns + _WINDOW_NS
        self._high = False

    def note(self, identifier: int, length: int, *, known: bool) -> None:
        """Count one frame of the bus, received or sent."""
        self._bits += bits_of_frame(length)
        if not known and (identifier in self._ids or len(self._ids) < _MOST_IDS):
            self._ids[identifier] = self._ids.get(identifier, 0) + 1

    def step(self, now_ns: int) -> str | None:
        """Return one line when the load has become high or normal again."""
        if now_ns < self._end_ns:
            return None
        duration_s = 1.0 + (now_ns - self._end_ns) / 1e9
        load = self._bits / duration_s / self._bitrate_bps
        ids, was_high, self._high = self._ids, self._high, load > _HIGH
        self._bits, self._ids, self._end_ns = 0, {}, now_ns + _WINDOW_NS
        if self._high == was_high:
            return None
        if not self._high:
            return f"CAN bus load {load:.0%}: normal again"
        busiest = max(ids, key=ids.__getitem__, default=None)
        most = "" if busiest is None else f"; most unknown frames have identifier 0x{busiest:x} ({ids[busiest]} in 1 s)"
        return f"CAN bus load {load:.0%}: commands may be late{most}"
