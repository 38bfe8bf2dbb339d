"""Trace of a simulated run: one JSON object per line, written by a thread so that physics never waits for a disk."""

from __future__ import annotations

import errno
import json
import queue
import threading
from pathlib import Path
from typing import Final

from edge.core.cli import open_stream

_CAPACITY: Final = 4096
_CLOSE_S: Final = 10.0  # longest wait at the end, s: a hanging reader of a FIFO must not block it

POSE_HZ: Final = 10
"""Default rate of poses in a trace, Hz."""


class TraceWriter:
    """Writer of a trace whose `put` never blocks; lines that do not fit the queue are counted in `dropped`.

    Every object has `t_ns`, the time.monotonic_ns of the described event. Lines are in order of arrival, which for
    camera requests is a few milliseconds after `t_ns`. Raises OSError if the file cannot be created.
    """

    def __init__(self, path: Path) -> None:
        self.dropped = 0
        self.error: OSError | None = None
        self._queue: queue.Queue[dict[str, object] | None] = queue.Queue(_CAPACITY)
        self._file = open_stream(path)
        self._thread = threading.Thread(target=self._write, name="trace", daemon=True)
        self._thread.start()

    def put(self, t_ns: int, kind: str, **fields: object) -> None:
        """Queue one line."""
        try:
            self._queue.put_nowait({"t_ns": t_ns, "kind": kind, **fields})
        except queue.Full:
            self.dropped += 1

    def close(self, t_ns: int, **summary: object) -> None:
        """Write the queued lines and the `end` line, then close the file."""
        try:
            self._queue.put({"t_ns": t_ns, "kind": "end", **summary, "trace_dropped": self.dropped}, timeout=_CLOSE_S)
            self._queue.put(None, timeout=_CLOSE_S)
        except queue.Full:
            self.error = OSError(errno.ETIMEDOUT, f"no write for {_CLOSE_S:g} s")
            return
        self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            self.error = OSError(errno.ETIMEDOUT, f"no write for {_CLOSE_S:g} s")
            return
        try:
            self._file.close()
        except OSError as error:
            self.error = error

    def _write(self) -> None:
        while (line := self._queue.get()) is not None:
            try:
                self._file.write(json.dumps(line) + "\n")
                if self._queue.empty():
                    self._file.flush()
            except OSError as error:  # such as a full disk: keep draining; the run continues and reports it
                self.error = error
