"""The operator's terminal: lines from a thread of their own, past Python's own buffer."""

from __future__ import annotations

import os
from typing import Final, TextIO, cast

from firmware_bridge.line_log import LineLog

CAPACITY: Final = 512


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
    """Lines to standard error: a pager that is not read or a pipe that broke holds up nobody and ends nothing."""
    return LineLog(cast(TextIO, Descriptor(descriptor)), prefix, capacity=CAPACITY)
