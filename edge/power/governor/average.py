"""Time-weighted averages of power in bounded memory: of the last seconds for the budget, of a run for its result."""

from __future__ import annotations

import bisect
import math
from collections import deque
from collections.abc import Callable
from typing import Final

BIN_W: Final = 0.05
BINS: Final = 8192
"""Number of bins, up to 409.6 W; larger values share the last bin."""
_LONGEST_S: Final = 1.0


class PowerHistory:
    """Energy of the last seconds, at any sample rate, in bounded memory.

    A sample applies until the next one, at most for `hold_s`; averages leave out a longer gap. The first sample's power
    also applies before it.
    """

    def __init__(self, keep_s: float, hold_s: float = 1.0, capacity: int = 4096) -> None:
        self._keep_ns = round(keep_s * 1e9)
        self._hold_ns = round(hold_s * 1e9)
        # (begin, end, W): ordered, not overlapping.
        self._pieces: deque[tuple[int, int, float]] = deque(maxlen=capacity)
        self._newest: tuple[int, float] | None = None
        self._first_w: float | None = None

    def add(self, stamp_ns: int, power_w: float) -> None:
        """Append a sample; one that is not newer than the last is dropped."""
        if self._newest is not None:
            last_ns, last_w = self._newest
            if stamp_ns <= last_ns:
                return
            self._pieces.append((last_ns, min(stamp_ns, last_ns + self._hold_ns), last_w))
        else:
            self._first_w = power_w
        self._newest = (stamp_ns, power_w)
        oldest_ns = stamp_ns - self._keep_ns
        while self._pieces and self._pieces[0][1] <= oldest_ns:
            self._pieces.popleft()
            self._first_w = None

    def energy_j(self, begin_ns: int, end_ns: int) -> tuple[float, float]:
        """Return (energy in J, seconds covered by samples) of an interval."""
        if self._newest is None or end_ns <= begin_ns:
            return 0.0, 0.0
        newest_ns, newest_w = self._newest
        energy, covered = 0.0, 0
        for piece_begin, piece_end, power_w in (*self._pieces, (newest_ns, newest_ns + self._hold_ns, newest_w)):
            length = min(piece_end, end_ns) - max(piece_begin, begin_ns)
            if length > 0:
                energy += power_w * length
                covered += length
        first_ns = self._pieces[0][0] if self._pieces else newest_ns
        before = min(first_ns, end_ns) - begin_ns
        if self._first_w is not None and before > 0:
            energy += self._first_w * before
            covered += before
        return energy / 1e9, covered / 1e9

    def energy_since(self, now_ns: int) -> Callable[[int], float]:
        """Return a function from an instant to the energy from then until now, J; built in one pass, cheap to call."""
        begins: list[int] = []
        energies: list[float] = []
        powers: list[float] = []
        total = 0.0
        newest = () if self._newest is None else ((self._newest[0], self._newest[0] + self._hold_ns, self._newest[1]),)
        for begin_ns, end_ns, power_w in reversed((*self._pieces, *newest)):
            if begin_ns < now_ns:
                total += power_w * (min(end_ns, now_ns) - begin_ns)
                begins.append(-begin_ns)
                energies.append(total)
                powers.append(power_w)
        before_w = self._first_w or 0.0

        def energy_j(since_ns: int) -> float:
            # `begins` are negated instants: they go back in time and bisect needs increasing values.
            index = bisect.bisect_left(begins, -since_ns)
            if index == len(begins):
                first_ns = -begins[-1] if begins else now_ns
                return (total + before_w * max(0, first_ns - since_ns)) / 1e9
            inside = energies[index] - powers[index] * (since_ns + begins[index])
            return max(inside, energies[index - 1] if index else 0.0) / 1e9

        return energy_j

    def average_w(self, now_ns: int, window_s: float) -> float | None:
        """Return the mean power of the last `window_s`, W; None without a sample in it."""
        energy, covered = self.energy_j(now_ns - round(window_s * 1e9), now_ns)
        if covered <= 0:
            return None if self._newest is None else self._newest[1]
        return energy / covered


class PowerStatistics:
    """Mean and percentiles of a run by a histogram of power; a sample applies for at most 1 s."""

    def __init__(self) -> None:
        self._seconds = [0.0] * BINS
        self._energy_j = 0.0
        self._total_s = 0.0
        self._last: tuple[int, float] | None = None

    def add(self, stamp_ns: int, power_w: float) -> None:
        """Append a sample; one that is not newer than the last is dropped."""
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
        """Return the time-weighted mean, W; None before the second sample."""
        return self._energy_j / self._total_s if self._total_s else None

    def percentile_w(self, share: float) -> float | None:
        """Return the power that is not exceeded for that share of the time, W, rounded up to the bin's end."""
        if not self._total_s:
            return None
        seconds, wanted = 0.0, share * self._total_s
        for index, length_s in enumerate(self._seconds):
            seconds += length_s
            if length_s and (seconds >= wanted or math.isclose(seconds, wanted)):
                return (index + 1) * BIN_W
        return BINS * BIN_W
