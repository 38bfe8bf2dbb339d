"""When the runner may tell systemd's watchdog that it works: only while the control thread ticks on time.

A process whose control thread is late, hung or dead must not be kept alive by a thread that knows nothing of it.
"""

from __future__ import annotations

from collections import deque
from typing import Final

WINDOW_TICKS: Final = 10
NEEDED_ON_TIME: Final = 8
"""Of the last WINDOW_TICKS; one or two late ticks are the bridge's business (its deadman), not a reason to restart."""


class WatchdogFeeder:
    """Pure: told of every tick, says when a ping is due. No clock, no socket."""

    def __init__(self, *, ping_period_ns: int | None, tick_period_ns: int) -> None:
        """`ping_period_ns`: `Notifier.watchdog_period_ns`; None: no ping is ever due. Raises ValueError."""
        if tick_period_ns <= 0 or (ping_period_ns is not None and ping_period_ns <= 0):
            raise ValueError(f"periods must be positive, found {ping_period_ns} and {tick_period_ns} ns")
        self._ping_period_ns = ping_period_ns
        self._tick_period_ns = tick_period_ns
        self._recent: deque[bool] = deque(maxlen=WINDOW_TICKS)
        self._ticked_ns: int | None = None
        self._pinged_ns: int | None = None

    @property
    def healthy(self) -> bool:
        """Enough of the newest ticks were on time; False until there have been enough of them."""
        return len(self._recent) == WINDOW_TICKS and sum(self._recent) >= NEEDED_ON_TIME

    def on_tick(self, on_time: bool, now_ns: int) -> bool:
        """Whether to ping now. Deadlines that were slept over since the last tick count as ticks that were late."""
        if self._ticked_ns is not None:
            passed = (now_ns - self._ticked_ns + self._tick_period_ns // 2) // self._tick_period_ns
            self._recent.extend([False] * min(max(0, passed - 1), WINDOW_TICKS))
        self._ticked_ns = now_ns
        self._recent.append(on_time)
        if self._ping_period_ns is None or not self.healthy:
            return False
        if self._pinged_ns is not None and now_ns - self._pinged_ns < self._ping_period_ns - self._tick_period_ns:
            return False  # the next tick is not too late for it
        self._pinged_ns = now_ns
        return True
