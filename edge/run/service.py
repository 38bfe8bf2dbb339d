"""Reports the runner to systemd (ready, status line, watchdog, stopping) and writes its lines for the operator.

The runner is ready once it drives on time, or while it waits for an operator. Without systemd nothing is sent.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Final, TextIO, cast

from edge.safety.watchdog import WatchdogFeeder
from firmware_bridge.system.line_log import LineLog
from firmware_bridge.system.notify import Notifier

STATUS_PERIOD_NS: Final = 5_000_000_000
CAPACITY: Final = 512
"""Lines for the operator that wait to be written."""


class ServiceReporter:
    """Thin shell around `WatchdogFeeder` and `Notifier`; every call returns at once and raises nothing.

    Order of use: `starting` before each long step of start-up, `on_wait` while the runner waits for an operator and
    until it drives, `on_tick` from the control thread after every tick, `stopping` once. The runner reports ready when
    the control thread has been on time for a whole window, or when it begins to wait for an operator.
    """

    def __init__(
        self,
        notifier: Notifier,
        *,
        tick_period_ns: int,
        describe: Callable[[], str],
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`describe()` returns the status line's short text; the control thread calls it, so it must not wait."""
        self._notifier = notifier
        self._feeder = WatchdogFeeder(ping_period_ns=notifier.watchdog_period_ns, tick_period_ns=tick_period_ns)
        self._describe = describe
        self._clock = clock
        self._ready = False
        self._status_ns: int | None = None
        self._fed_ns = 0
        self._waited = ""

    def starting(self, text: str, at_most_s: float) -> None:
        """Announce a start-up step of at most this duration, s; systemd ends a start that takes longer."""
        self._notifier.extend(at_most_s)
        self._notifier.status(text)

    def on_wait(self, text: str) -> None:
        """Report the reason `text` for waiting; called several times a second."""
        if not self._notifier.enabled:
            return
        now_ns, period_ns = self._clock(), self._notifier.watchdog_period_ns
        if not self._ready:
            self._ready, self._fed_ns, self._waited = self._notifier.ready(text), now_ns, text
            return
        if text != self._waited and self._notifier.status(text):
            self._waited = text
        # Ping twice as often as necessary: when driving begins, the first ticks do not ping yet.
        if period_ns is not None and now_ns - self._fed_ns >= period_ns // 2 and self._notifier.watchdog():
            self._fed_ns = now_ns

    def on_tick(self, on_time: bool) -> None:
        """Account for one tick of the control thread."""
        if not self._notifier.enabled:
            return
        now_ns = self._clock()
        ping = self._feeder.on_tick(on_time, now_ns)
        if not self._ready:
            # Repeated until it has been sent: without it systemd would end a runner that drives.
            self._ready = self._feeder.healthy and self._notifier.ready(self._describe())
            return
        if ping:
            self._notifier.watchdog()
        if self._status_ns is None or now_ns - self._status_ns >= STATUS_PERIOD_NS:
            self._status_ns = now_ns
            self._notifier.status(self._describe())

    def stopping(self, text: str) -> None:
        """Report that the run ends."""
        self._notifier.stopping(text)


class Descriptor:
    """The stream of a `LineLog`. It has no buffer, and so no lock that a blocked write would hold at exit."""

    def __init__(self, number: int) -> None:
        self._number = number

    def write(self, text: str) -> int:
        """Write the whole text, however long the reader takes; raises OSError."""
        data = memoryview(text.encode("utf-8", "backslashreplace"))
        while data:
            data = data[os.write(self._number, data) :]
        return len(text)

    def flush(self) -> None:
        """Do nothing: no text is buffered."""


def operator_lines(prefix: str, descriptor: int = 2) -> LineLog:
    """Return a log to standard error; a blocked or broken pipe neither delays nor ends the run."""
    return LineLog(cast(TextIO, Descriptor(descriptor)), prefix, capacity=CAPACITY)
