"""The emergency-stop latch on disk: a stop must hold although the bridge is killed and started again.

The file exists while the latch holds and contains its reason. A thread writes it, because a slow disk must not delay
the bridge. A file that cannot be read counts as a latch.
"""

from __future__ import annotations

import contextlib
import os
import queue
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final

_MAX_BYTES: Final = 400


def read_latch(path: Path) -> str:
    """Reason of the latch that an earlier bridge has left at `path`, empty without one."""
    try:
        with path.open("rb") as file:
            reason = " ".join(file.read(_MAX_BYTES).decode("utf-8", "replace").split())
    except FileNotFoundError:
        return ""
    except OSError as error:
        return f"emergency stop of an earlier bridge, reason unreadable ({error.strerror})"
    return reason or "emergency stop of an earlier bridge"


class LatchFile:
    """Keeps one file equal to the latch; `keep` never waits."""

    def __init__(self, path: Path, say: Callable[[str], None]) -> None:
        """`say` takes one line for the operator when the file cannot be written."""
        self._path = path
        self._say = say
        self._kept = read_latch(path)
        self._changes: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write_changes, name="latch-file", daemon=True)
        self._thread.start()

    def keep(self, reason: str) -> None:
        """Make the file say `reason`, or remove it when that is empty."""
        if reason != self._kept:
            self._kept = reason
            self._changes.put(reason)

    def close(self, timeout_s: float) -> None:
        """Give the disk up to `timeout_s` to take the last change."""
        self._changes.put(None)
        self._thread.join(timeout_s)

    def _write_changes(self) -> None:
        for reason in iter(self._changes.get, None):
            try:
                self._write(reason)
            except OSError as error:
                effect = "an emergency stop will not survive a restart of the bridge"
                self._say(f"latch file {self._path}: cannot be written ({error.strerror}): {effect}")

    def _write(self, reason: str) -> None:
        if reason:
            partial = self._path.with_name(self._path.name + ".partial")
            with partial.open("wb") as file:
                file.write(reason.encode("utf-8", "replace")[:_MAX_BYTES])
                file.flush()
                os.fsync(file.fileno())
            partial.replace(self._path)
        else:
            self._path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # not every file system has folders that can be synced
            folder = os.open(self._path.parent, os.O_RDONLY | os.O_DIRECTORY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
