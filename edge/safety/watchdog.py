"""Decides from the threads' progress when to ping systemd's watchdog and when to restart because of reasoning.

No other thread may keep a process alive whose control thread is late, hung or dead. A reasoning thread that hangs in a
driver cannot be ended: after an interrupt without effect only a new process helps.
"""

from __future__ import annotations

from collections import deque
from enum import Enum
from typing import Final

WINDOW_TICKS: Final = 10
NEEDED_ON_TIME: Final = 8
"""Required ticks on time of the last WINDOW_TICKS; one or two late ticks are left to the bridge's deadman."""
CALL_MS: Final = 10_000.0
"""Shortest time limit of a call, ms."""
GENERATIONS: Final = 3.0
"""Multiple of the longest generation so far that a call may take: a single call is a part of one."""
GIVE_UP_NS: Final = 20_000_000_000
"""Time limit after the interrupt: fault matrix row 17 requires reasoning within 30 s. The robot stands meanwhile."""
MAX_STEP_NS: Final = 1_000_000_000
"""Largest duration that one step counts: a process that was frozen has not hung."""


class WatchdogFeeder:
    """Decides from every tick when a ping is due. No clock, no socket."""

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
        """Whether enough of the newest ticks were on time; False during the first WINDOW_TICKS."""
        return len(self._recent) == WINDOW_TICKS and sum(self._recent) >= NEEDED_ON_TIME

    def on_tick(self, on_time: bool, now_ns: int) -> bool:
        """Return whether to ping now. Missed deadlines since the last tick count as late ticks."""
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


class Hang(Enum):
    """Action for a call that hangs."""

    NONE = "none"
    INTERRUPT = "interrupt"
    """Issued once a hang."""
    GIVE_UP = "give up"


class ReasoningWatch:
    """Decides from the time at which the reasoning thread was last between two calls. No clock."""

    def __init__(self) -> None:
        self._progress_ns: int | None = None
        self._stepped_ns = 0
        self._hung_ns = 0
        self._interrupted_ns: int | None = None

    def step(self, progress_ns: int, longest_ms: float | None, now_ns: int) -> Hang:
        """`progress_ns`: `ReasoningLoop.last_progress_ns`; `longest_ms`: the longest generation so far, if any."""
        if progress_ns != self._progress_ns:
            self._progress_ns, self._hung_ns, self._interrupted_ns = progress_ns, 0, None
        else:
            self._hung_ns += min(max(0, now_ns - self._stepped_ns), MAX_STEP_NS)
        self._stepped_ns = now_ns
        if self._interrupted_ns is not None:
            return Hang.GIVE_UP if self._hung_ns - self._interrupted_ns >= GIVE_UP_NS else Hang.NONE
        if self._hung_ns < max(CALL_MS, GENERATIONS * (longest_ms or 0.0)) * 1e6:
            return Hang.NONE
        self._interrupted_ns = self._hung_ns
        return Hang.INTERRUPT

    @property
    def hung_s(self) -> float:
        """Duration without progress, s."""
        return self._hung_ns / 1e9
