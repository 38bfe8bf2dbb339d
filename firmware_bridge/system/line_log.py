"""Writes lines for the operator in a separate thread: a stalled terminal or journal must not delay the bridge."""

from __future__ import annotations

import contextlib
import queue
import threading
from typing import TextIO

from firmware_bridge.system.terminal import one_line


class LineLog:
    """Bounded queue in front of a text stream. `write` never waits; a line that does not fit is dropped and counted."""

    def __init__(self, stream: TextIO, prefix: str, *, capacity: int = 64) -> None:
        self.dropped = 0
        self._stream = stream
        self._prefix = prefix
        self._lines: queue.Queue[str | None] = queue.Queue(capacity)
        self._thread = threading.Thread(target=self._drain, name="line-log", daemon=True)
        self._thread.start()

    def write(self, line: str) -> None:
        """Queue one line."""
        try:
            self._lines.put_nowait(line)
        except queue.Full:
            self.dropped += 1

    def close(self, timeout_s: float) -> None:
        """Wait up to `timeout_s` until the queued lines are written."""
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(None)
        self._thread.join(timeout_s)

    def _drain(self) -> None:
        for line in iter(self._lines.get, None):
            with contextlib.suppress(OSError, ValueError):  # closed or full: no reader is left
                self._stream.write(f"{self._prefix}: {one_line(line)}\n")
                self._stream.flush()
