"""Reads small input files that a user names: regular files of a limited size and nesting, never a device or a FIFO.

A FIFO without a writer would hang a command for good, `/dev/zero` would fill its memory, deep nesting would end it by a
RecursionError. All of these are an OSError or a ValueError here, with one line.
"""

from __future__ import annotations

import errno
import json
import os
import stat
import sys
from pathlib import Path
from typing import Any, BinaryIO, Final

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MAX_BYTES: Final = 64_000_000
"""Default limit of a file's size, bytes: above every TOML or JSON file of this project."""
MAX_INTEGER: Final = 2**63 - 1
"""Largest integer of a JSON file, and its negative: every stamp in ns fits. `float` of a far longer one raises an
OverflowError, which no reader expects. Readers of TOML check each number by its key."""
_MAX_KEY_PARTS: Final = 1000  # tomllib takes time that grows with their square
_TOO_DEEP: Final = "nested too deeply"


def read_bytes(path: Path, limit: int = MAX_BYTES) -> bytes:
    """Read a regular file of at most `limit` bytes. Raises OSError with a reason in `strerror`."""
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        try:
            # A file may grow after its size was read.
            data = b"" if size > limit else file.read(limit + 1)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(path)) from None
    if max(size, len(data)) > limit:
        raise OSError(errno.EFBIG, f"is larger than {limit} bytes", str(path))
    return data


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading. Raises OSError for another kind of file, also where opening it would wait."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, "is a directory, expected a file", str(path))
    raise OSError(errno.EINVAL, "is not a regular file", str(path))


def read_text(path: Path, limit: int = MAX_BYTES) -> str:
    """Read a UTF-8 file as `read_bytes` does. Raises OSError, or ValueError for other bytes."""
    return read_bytes(path, limit).decode("utf-8")


def read_toml(path: Path, limit: int = MAX_BYTES) -> dict[str, Any]:
    """Read a TOML file. Raises OSError or ValueError."""
    return parse_toml(read_text(path, limit))


def read_json(path: Path, limit: int = MAX_BYTES) -> Any:
    """Read a JSON file. Raises OSError or ValueError."""
    return parse_json(read_text(path, limit))


def parse_toml(text: str) -> dict[str, Any]:
    """Parse TOML. Raises ValueError, also for nesting that is too deep."""
    if any(line.partition("=")[0].count(".") > _MAX_KEY_PARTS for line in text.splitlines()):
        raise ValueError(f"{_TOO_DEEP}: a key of more than {_MAX_KEY_PARTS} parts")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None


def parse_json(text: str | bytes) -> Any:
    """Parse JSON. Raises ValueError, also for nesting that is too deep and integers that are too large."""
    try:
        content = json.loads(text)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    check_integers(content)
    return content


def check_integers(content: object) -> None:
    """Raise ValueError for an integer beyond MAX_INTEGER anywhere in parsed JSON; without recursion."""
    waiting = [content]
    while waiting:
        value = waiting.pop()
        if isinstance(value, dict):
            waiting += value.values()
        elif isinstance(value, list):
            waiting += value
        elif isinstance(value, int) and not -MAX_INTEGER <= value <= MAX_INTEGER:
            raise ValueError(f"an integer of {value.bit_length()} bits, expected at most {MAX_INTEGER}")
