"""The runner as a service (ready, a status line, watchdog, stopping; nothing without systemd), and its lines.

Ready is a runner that drives on time, or one that waits for an operator who may take hours.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Final, TextIO, cast

from edge.safety.watchdog import WatchdogFeeder
from firmware_bridge.line_log import LineLog
from firmware_bridge.notify import Notifier

STATUS_PERIOD_NS: Final = 5_000_000_000
CAPACITY: Final = 512
"""Lines for the operator that wait to be written."""


class ServiceReporter:
    """Thin shell around `WatchdogFeeder` and `Notifier`; every call returns at once and raises nothing.

    Order of use: `starting` before each long step of start-up, `on_wait` while the runner waits for an operator and
    until it drives, `on_tick` from the control thread after every tick, `stopping` once. Ready is said when the control
    thread has been on time for a whole window or the waiting begins, so what systemd counts as started is a runner that
    drives, or will do so when an operator permits it.
    """

    def __init__(
        self,
        notifier: Notifier,
        *,
        tick_period_ns: int,
        describe: Callable[[], str],
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`describe()`: the status line's text, short; called in the control thread, so it must not wait."""
        self._notifier = notifier
        self._feeder = WatchdogFeeder(ping_period_ns=notifier.watchdog_period_ns, tick_period_ns=tick_period_ns)
        self._describe = describe
        self._clock = clock
        self._ready = False
        self._status_ns: int | None = None
        self._fed_ns = 0
        self._waited = ""

    def starting(self, text: str, at_most_s: float) -> None:
        """Start-up goes on with a step that takes at most this long; more than that and systemd ends the start."""
        self._notifier.extend(at_most_s)
        self._notifier.status(text)

    def on_wait(self, text: str) -> None:
        """One turn of the loop that waits to be armed; `text`: what for. Called several times a second."""
        if not self._notifier.enabled:
            return
        now_ns, period_ns = self._clock(), self._notifier.watchdog_period_ns
        if not self._ready:
            self._ready, self._fed_ns, self._waited = self._notifier.ready(text), now_ns, text
            return
        if text != self._waited and self._notifier.status(text):
            self._waited = text
        # Twice as often as need be: at the change to driving, the first ticks feed nothing yet.
        if period_ns is not None and now_ns - self._fed_ns >= period_ns // 2 and self._notifier.watchdog():
            self._fed_ns = now_ns

    def on_tick(self, on_time: bool) -> None:
        """Account for one tick of the control thread."""
        if not self._notifier.enabled:
            return
        now_ns = self._clock()
        ping = self._feeder.on_tick(on_time, now_ns)
        if not self._ready:
            # Said until it has been sent: without it systemd would end a runner that drives.
            self._ready = self._feeder.healthy and self._notifier.ready(self._describe())
            return
        if ping:
            self._notifier.watchdog()
        if self._status_ns is None or now_ns - self._status_ns >= STATUS_PERIOD_NS:
            self._status_ns = now_ns
            self._notifier.status(self._describe())

    def stopping(self, text: str) -> None:
        """The run ends, by itself, by a fault or on request."""
        self._notifier.stopping(text)


class Descriptor:
    """What `LineLog` writes to. No buffer, so no lock that a blocked write would keep until the interpreter's end."""

    def __init__(self, number: int) -> None:
        self._number = number

    def write(self, text: str) -> int:
        """Write all of it, however long the reader takes; raises OSError."""
        data = memoryview(text.encode("utf-8", "backslashreplace"))
        while data:
            data = data[os.write(self._number, data) :]
        return len(text)

    def flush(self) -> None:
        """Nothing is kept back."""


def operator_lines(prefix: str, descriptor: int = 2) -> LineLog:
    """Lines to standard error: a pager that is not read or a pipe that broke delays and ends nothing."""
    return LineLog(cast(TextIO, Descriptor(descriptor)), prefix, capacity=CAPACITY)
