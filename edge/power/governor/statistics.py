"""Mean and 99th percentile of a run's power in bounded memory."""

from __future__ import annotations

import math
from typing import Final

BIN_W: Final = 0.05
BINS: Final = 8192
"""Up to 409.6 W; what is above shares the last bin."""
_LONGEST_S: Final = 1.0


class PowerStatistics:
    """A histogram in which each sample weighs as long as it was in force, at most 1 s."""

    def __init__(self) -> None:
        self._seconds = [0.0] * BINS
        self._energy_j = 0.0
        self._total_s = 0.0
        self._last: tuple[int, float] | None = None

    def add(self, stamp_ns: int, power_w: float) -> None:
        """The next sample; one that is not newer than the last is dropped."""
        if self._last is not None:
            last_ns, last_w = self._last
            if stamp_ns <= last_ns:
                return
            length_s = min((stamp_ns - last_ns) / 1e9, _LONGEST_S)
            self._seconds[min(int(last_w / BIN_W), BINS - 1)] += length_s
            self._energy_j += last_w * length_s
            self._total_s += length_s
        self._last = (stamp_ns, power_w)

    @property
    def mean_w(self) -> float | None:
        """Mean weighted by time; None before the second sample."""
        return self._energy_j / self._total_s if self._total_s else None

    def percentile_w(self, share: float) -> float | None:
        """Power that is not exceeded for that share of the time, rounded up to the bin's end."""
        if not self._total_s:
            return None
        seconds, wanted = 0.0, share * self._total_s
        for index, length_s in enumerate(self._seconds):
            seconds += length_s
            if length_s and (seconds >= wanted or math.isclose(seconds, wanted)):
                return (index + 1) * BIN_W
        return BINS * BIN_W
