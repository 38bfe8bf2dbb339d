"""Writes output files that a user names: replaces regular files whole, writes to devices and FIFOs in place.

`--json /dev/null` as root must not rename a file over the device node. The runner and the tools use this module too.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import stat
import time
from pathlib import Path
from typing import Final

READER_S: Final = 5.0
"""Longest time without progress on a FIFO or a device, s: a reader that hangs must not block a command."""
_LINKS: Final = 40  # Linux follows at most this many links


def regular_target(path: Path) -> Path | None:
    """Return the regular file or new name behind a path and its links; None for a device, a FIFO or a descriptor.

    Raises OSError for a directory, a socket, a loop of links and a name in a directory that does not exist.
    """
    try:
        mode = path.stat().st_mode  # the caller handles ELOOP and EACCES
    except FileNotFoundError:
        target = Path(os.path.realpath(path))
        if path.is_symlink() and not target.parent.is_dir():
            raise
        return target
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, "is a directory, expected a file", str(path))
    if stat.S_ISSOCK(mode):
        raise OSError(errno.ENXIO, "is a socket, expected a file", str(path))
    if not stat.S_ISREG(mode) or _is_descriptor(path):
        return None
    return Path(os.path.realpath(path))


def check_output(path: Path) -> None:
    """Raise OSError with one line for a path that cannot be written; call it before any work."""
    if not path.name:
        raise OSError(f"{str(path)!r} is not the name of a file")
    target = regular_target(path)
    if target is None:
        if not os.access(path, os.W_OK):
            raise OSError(f"{path} cannot be written to: permission denied")
        return
    parent = next(folder for folder in target.parents if folder.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise OSError(f"{parent} is not a directory that can be written to")


def write_output(path: Path, data: bytes) -> None:
    """Write a file, replaced in one rename where it is regular or new; raises OSError and leaves nothing half-written.

    A symbolic link stays a link: the file that it leads to is replaced. A device or a FIFO is opened and written to.
    """
    target = regular_target(path)
    if target is None:
        _write_through(path, data)
        return
    partial = partial_of(target)
    try:
        # Exclusive: never follow another user's link.
        descriptor = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(descriptor)
        replace_regular(partial, target)
    finally:
        partial.unlink(missing_ok=True)


def partial_of(target: Path) -> Path:
    """Return this process's temporary name beside a file; remove a leftover of that name."""
    partial = target.with_name(f"{target.name}.{os.getpid()}.partial")
    partial.unlink(missing_ok=True)
    return partial


def replace_regular(partial: Path, target: Path) -> None:
    """Rename onto a regular file or a new name, with the previous file's permissions; raises OSError."""
    with contextlib.suppress(FileNotFoundError):
        mode = target.lstat().st_mode
        if not stat.S_ISREG(mode):  # it has changed since the check
            raise OSError(errno.EEXIST, "is no longer a regular file", str(target))
        partial.chmod(stat.S_IMODE(mode))
    partial.replace(target)


def open_through(path: Path) -> int:
    """Open a device or a FIFO for writing, never creating a file; the descriptor does not block. Raises OSError."""
    try:
        return os.open(path, os.O_WRONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    except OSError as error:
        if error.errno == errno.ENXIO and path.is_fifo():
            raise OSError(errno.ENXIO, "is a FIFO that no process reads; start its reader first", str(path)) from None
        raise


def write_descriptor(descriptor: int, data: bytes) -> None:
    """Write all bytes without a buffer, which would delay errors; raises OSError."""
    rest = memoryview(data)
    poller = select.poll()
    poller.register(descriptor, select.POLLOUT)
    until_s = time.monotonic() + READER_S
    while rest:
        with contextlib.suppress(BlockingIOError):
            rest = rest[os.write(descriptor, rest) :]
            until_s = time.monotonic() + READER_S
            continue
        left_s = until_s - time.monotonic()
        if left_s <= 0:
            raise OSError(errno.ETIMEDOUT, f"took nothing for {READER_S:g} s")
        poller.poll(left_s * 1000)


def _write_through(path: Path, data: bytes) -> None:
    descriptor = open_through(path)
    try:
        if stat.S_ISREG(os.fstat(descriptor).st_mode):  # standard output redirected to a file: append
            os.lseek(descriptor, 0, os.SEEK_END)
        write_descriptor(descriptor, data)
    finally:
        os.close(descriptor)


def _is_descriptor(path: Path) -> bool:
    """Return whether a path leads through /proc, as /dev/stdout does: then the open file counts, not its name."""
    for _ in range(_LINKS):
        if os.path.realpath(path.parent).startswith("/proc/"):
            return True
        if not path.is_symlink():
            return False
        path = path.parent / path.readlink()
    return False
