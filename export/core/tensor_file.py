"""Writes safetensors files whole; the disk's errors are OSErrors, as for any other file."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from safetensors import SafetensorError

_ERRNO = re.compile(r"\(os error (\d+)\)")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a path beside `path` for `save_file`; its file then replaces `path`, with an ordinary file's permissions.

    Raises OSError, also for an error of the disk that safetensors reports. Nothing half-written stays then.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    try:
        partial.touch()
        mode = partial.stat().st_mode
        yield partial
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        partial.chmod(mode)  # safetensors replaces the file by one that its owner alone can read
        partial.replace(path)
    except SafetensorError as error:
        if "I/O error" not in str(error):
            raise
        found = _ERRNO.search(str(error))
        code = errno.EIO if found is None else int(found[1])
        raise OSError(code, os.strerror(code), str(path)) from error
    finally:
        partial.unlink(missing_ok=True)
