"""The emergency-stop latch on disk: a stop outlives a killed and restarted bridge.

The file exists while the stop is latched and contains its reason. Existence alone is the latch: an empty, damaged,
unreadable or irregular file counts too, so neither a full disk nor a kill between two system calls loses it. A thread
writes the file, because a slow disk must not delay the bridge.
"""

from __future__ import annotations

import contextlib
import errno
import os
import queue
import stat
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final

_MAX_BYTES: Final = 400
_WRITE_FLAGS: Final = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NONBLOCK | os.O_CLOEXEC
_PATIENCE_NS: Final = 200_000_000
"""Longest time that the disk may delay the confirmation of a stop."""
_EARLIER: Final = "emergency stop of an earlier bridge"


def read_latch(path: Path) -> str:
    """Return the reason of an earlier bridge's latch at `path`, empty without one. Never waits."""
    try:
        _check_regular(path)
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            text = os.read(descriptor, _MAX_BYTES).decode("utf-8", "replace")
        finally:
            os.close(descriptor)
    except FileNotFoundError:
        return ""
    except OSError as error:
        return f"{_EARLIER}, reason unreadable ({error.strerror})"
    reason = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return reason or _EARLIER


def _check_regular(path: Path) -> None:
    """Raise OSError unless the path is free or a regular file; a device or FIFO is never read, written or removed."""
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError(errno.EINVAL, "not a regular file")


class LatchFile:
    """Keeps one file equal to the latch; `keep` never waits."""

    def __init__(self, path: Path, report: Callable[[str], None]) -> None:
        """`report` takes one line for the operator when the file cannot be written."""
        self._path = path
        self._report = report
        self._kept = read_latch(path)
        self._change = self._done = 0  # numbers of the newest requested change and of the newest completed one
        self._changed_ns = 0
        self.failed = False
        """Whether the last change failed."""
        self._changes: queue.SimpleQueue[tuple[int, str] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write_changes, name="latch-file", daemon=True)
        self._thread.start()

    def keep(self, reason: str, now_ns: int) -> bool:
        """Request a file with `reason`, or no file for an empty one.

        Returns whether a stop may be confirmed to the operator: the file is as requested, has failed, or takes too
        long.
        """
        if reason != self._kept:
            self._kept, self._changed_ns, self._change = reason, now_ns, self._change + 1
            self._changes.put((self._change, reason))
        return self._done == self._change or now_ns - self._changed_ns > _PATIENCE_NS

    @property
    def is_late(self) -> bool:
        """Whether the disk has not taken the last change yet."""
        return self._done != self._change

    def close(self, timeout_s: float) -> None:
        """Wait up to `timeout_s` for the last change, then end."""
        self._changes.put(None)
        self._thread.join(timeout_s)

    def _write_changes(self) -> None:
        for number, reason in iter(self._changes.get, None):
            try:
                self._write(reason)
                self.failed, self._done = False, number
                if self._changes.empty():  # a newer change must not wait for the disk
                    with contextlib.suppress(OSError):  # not every file system can be synced
                        self._sync(reason)
            except OSError as error:
                self.failed, self._done = True, number  # completed as far as possible
                failed = ("cannot be written", "may not survive") if reason else ("cannot be removed", "will survive")
                text = f"{failed[0]} ({error.strerror}): an emergency stop {failed[1]} a restart of the bridge"
                self._report(f"latch file {self._path}: {text}")

    def _write(self, reason: str) -> None:
        with contextlib.suppress(FileNotFoundError):
            _check_regular(self._path)
        if reason:
            # Write in place instead of renaming a synced file: the latch must exist before the wait for the disk.
            descriptor = os.open(self._path, _WRITE_FLAGS, 0o600)
            try:
                os.write(descriptor, reason.encode("utf-8", "replace")[:_MAX_BYTES])
            finally:
                os.close(descriptor)
        else:
            self._path.unlink(missing_ok=True)

    def _sync(self, reason: str) -> None:
        """Sync to survive a power cut; a killed process needs no sync."""
        for path in (self._path, self._path.parent) if reason else (self._path.parent,):
            descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
