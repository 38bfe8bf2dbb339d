"""The autopilot's clock by TIMESYNC: how old a report is when it arrives. Pure."""

from __future__ import annotations

from typing import Final

_PERIOD_NS: Final = 1_000_000_000
_KEPT: Final = 16
_MAX_WAITING: Final = 4
_MAX_ROUND_TRIP_NS: Final = 1_000_000_000
_STEP_NS: Final = 1_000_000_000  # a clock that jumps by more was restarted
MAX_AGE_NS: Final = 500_000_000
"""Age from which a report is dropped: our choice, far above the delay of a working link."""


class VehicleClock:
    """Offset of the autopilot's clock to ours, from the exchange with the shortest round trip of the last 16."""

    def __init__(self) -> None:
        self._waiting: list[int] = []
        self._samples: list[tuple[int, int]] = []  # round trip and offset, ns
        self._due_ns = 0

    def due(self, now_ns: int) -> bool:
        """Return whether to send a TIMESYNC request with `ts1 = now_ns` now."""
        if now_ns < self._due_ns:
            return False
        self._due_ns = now_ns + _PERIOD_NS
        self._waiting = [*self._waiting[1 - _MAX_WAITING :], now_ns]
        return True

    def answer(self, vehicle_ns: int, sent_ns: int, now_ns: int) -> None:
        """Take an answer: the autopilot's time and our own `ts1`; one that was not requested is ignored."""
        trip_ns = now_ns - sent_ns
        if sent_ns not in self._waiting or not 0 <= trip_ns <= _MAX_ROUND_TRIP_NS or vehicle_ns <= 0:
            return
        self._waiting.remove(sent_ns)
        offset_ns = vehicle_ns - (sent_ns + now_ns) // 2
        if self._samples and abs(offset_ns - self._offset_ns) > _STEP_NS:
            self._samples.clear()
        self._samples = [*self._samples[1 - _KEPT :], (trip_ns, offset_ns)]

    @property
    def _offset_ns(self) -> int:
        return min(self._samples)[1]

    def is_timely(self, stamp_ns: int, now_ns: int) -> bool:
        """Return whether a report's stamp is less than MAX_AGE_NS from now; True while the offset is unknown."""
        return not self._samples or abs(now_ns + self._offset_ns - stamp_ns) <= MAX_AGE_NS
