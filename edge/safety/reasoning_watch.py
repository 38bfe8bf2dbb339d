"""Is the reasoning thread still getting anywhere? A call that hangs is interrupted, then the run is given up.

Nothing can end a thread that hangs in a driver: after an interrupt that changes nothing only a new process helps.
"""

from __future__ import annotations

from enum import Enum
from typing import Final

CALL_MS: Final = 10_000.0
"""The least that a call may take."""
GENERATIONS: Final = 3.0
"""As many times the longest generation so far: a single call is a part of one."""
GIVE_UP_NS: Final = 20_000_000_000
"""After the interrupt. Fault matrix row 17 wants reasoning back within 30 s; the robot stands by then (its age)."""
LOOK_NS: Final = 1_000_000_000
"""The most that one look counts: a process that was frozen has not hung."""


class Hang(Enum):
    """What is to be done."""

    NONE = "none"
    INTERRUPT = "interrupt"
    """Once for each hang."""
    GIVE_UP = "give up"


class ReasoningWatch:
    """Pure: told at every look when the thread was last between two calls."""

    def __init__(self) -> None:
        self._progress_ns: int | None = None
        self._looked_ns = 0
        self._stood_ns = 0
        self._interrupted_ns: int | None = None

    def step(self, progress_ns: int, longest_ms: float | None, now_ns: int) -> Hang:
        """`progress_ns`: `ReasoningLoop.last_progress_ns`; `longest_ms`: the longest generation so far, if any."""
        if progress_ns != self._progress_ns:
            self._progress_ns, self._stood_ns, self._interrupted_ns = progress_ns, 0, None
        else:
            self._stood_ns += min(max(0, now_ns - self._looked_ns), LOOK_NS)
        self._looked_ns = now_ns
        if self._interrupted_ns is not None:
            return Hang.GIVE_UP if self._stood_ns - self._interrupted_ns >= GIVE_UP_NS else Hang.NONE
        if self._stood_ns < max(CALL_MS, GENERATIONS * (longest_ms or 0.0)) * 1e6:
            return Hang.NONE
        self._interrupted_ns = self._stood_ns
        return Hang.INTERRUPT

    @property
    def stood_s(self) -> float:
        """For how long there has been no progress."""
        return self._stood_ns / 1e9
