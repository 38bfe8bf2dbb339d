"""Sends zero velocity while a command is late, so that one slow tick does not end the run.

Without it the bridge's deadman would: its stop needs a new arming. Only zeros are sent, and for at most HOLD_NS: a
control thread that hangs still ends the run. A process that is frozen as a whole is left to the deadman.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Final, Protocol

LATE_NS: Final = 200_000_000
"""Age of the last command from which zero is sent instead, ns: two periods, and 50 ms before the bridge's deadman."""
REPEAT_NS: Final = 50_000_000
"""Time between two zeros, ns."""
HOLD_NS: Final = 1_000_000_000
"""Age of the last command from which nothing more is sent, ns; the deadman then ends the run."""


class LateCommand:
    """Decides when a zero is due. No clock, no thread."""

    def __init__(self) -> None:
        self._sent_ns: int | None = None
        self._due_ns = 0

    def step(self, sent_ns: int | None, now_ns: int) -> tuple[bool, int]:
        """Return whether to send a zero now, and when to ask again, ns.

        `sent_ns`: stamp of the control thread's last command; None before the first.
        """
        if sent_ns is None or now_ns - sent_ns >= HOLD_NS:
            return False, now_ns + REPEAT_NS
        if sent_ns != self._sent_ns:
            self._sent_ns, self._due_ns = sent_ns, sent_ns + LATE_NS
        if now_ns < self._due_ns:
            return False, self._due_ns
        self._due_ns = now_ns + REPEAT_NS
        return True, self._due_ns


class CommandHold(Protocol):
    """Where the control thread's commands go, and a zero in their place."""

    @property
    def sent_ns(self) -> int | None:
        """Stamp of the control thread's last command, ns; None before the first."""

    def hold(self, stamp_ns: int) -> bool:
        """Send zero after the last command and before the next one; False when it was not sent."""


def hold_while_late(
    commands: CommandHold, ended: threading.Event, clock: Callable[[], int] = time.monotonic_ns
) -> None:
    """Send a zero whenever one is due, until `ended`; run it in a thread of its own."""
    late, next_ns = LateCommand(), 0
    while not ended.wait(max(0, next_ns - clock()) / 1e9):
        now_ns = clock()
        due, next_ns = late.step(commands.sent_ns, now_ns)
        if due:
            commands.hold(now_ns)
