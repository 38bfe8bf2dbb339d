"""One progress line: redrawn on a terminal, otherwise written a few times a minute. Always on stderr."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import TextIO

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape
from rich.status import Status

_PLAIN_PERIOD_S = 15.0
_REDRAW_PERIOD_S = 0.25


class Progress:
    """Shows `describe()` while a step runs; call `tick` often. Used as a context manager around one step."""

    def __init__(self, describe: Callable[[float], str], stream: TextIO | None = None) -> None:
        self._describe = describe
        self._stream = stream if stream is not None else sys.stderr
        self._status: Status | None = None
        self._started_ns = time.monotonic_ns()
        self._shown_s = 0.0

    def __enter__(self) -> Progress:
        if self._stream.isatty():
            self._status = Console(file=self._stream).status(escape(self._describe(0.0)))
            self._status.start()
        else:
            self._write(0.0)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._status is not None:
            self._status.stop()

    def tick(self) -> None:
        """Show the line again if it is time to."""
        elapsed_s = (time.monotonic_ns() - self._started_ns) / 1e9
        if self._status is not None and elapsed_s - self._shown_s >= _REDRAW_PERIOD_S:
            self._shown_s = elapsed_s
            self._status.update(escape(self._describe(elapsed_s)))
        elif self._status is None and elapsed_s - self._shown_s >= _PLAIN_PERIOD_S:
            self._shown_s = elapsed_s
            self._write(elapsed_s)

    def _write(self, elapsed_s: float) -> None:
        self._stream.write(self._describe(elapsed_s) + "\n")
        self._stream.flush()


class TraceTail:
    """Follows edge-hil's trace while it is written: Move requests received and metres walked so far."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0
        self._last_xy: NDArray[np.float64] | None = None
        self._last_ns = 0
        self.moves = 0
        self.walked_m = 0.0

    def update(self) -> None:
        """Read what was added since; an unfinished last line is left for the next time."""
        try:
            with self._path.open("rb") as stream:
                stream.seek(self._offset)
                added = stream.read()
        except OSError:
            return
        whole = added[: added.rfind(b"\n") + 1]
        self._offset += len(whole)
        for line in whole.splitlines():
            self._take(line)

    def _take(self, line: bytes) -> None:
        try:
            record = json.loads(line)
            if record["kind"] == "wire" and record["name"] == "Move":
                self.moves += 1
            elif record["kind"] == "pose" and record["t_ns"] - self._last_ns >= 1_000_000_000:
                # One-second steps, so that a body swaying in place does not add up to a walk.
                xy = np.array([record["x"], record["y"]], float)
                if self._last_xy is not None:
                    self.walked_m += float(np.linalg.norm(xy - self._last_xy))
                self._last_xy, self._last_ns = xy, record["t_ns"]
        except (ValueError, KeyError, TypeError):
            return  # only a progress line: the report reads the same file strictly
