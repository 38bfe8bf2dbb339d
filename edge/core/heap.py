"""Keeps a process's memory from growing over hours: the C library's heap, and garbage of Python in cycles."""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Callable
from typing import Final

LARGE_BYTES: Final = 64 * 1024
"""Size from which a block is mapped on its own and returned when it is freed, bytes.

Below are Python's objects, records and most JPEGs; above are keys and values, pictures and the flight log's chunks,
whose sizes change from one to the next.
"""
TRIM_BYTES: Final = 256 * 1024
"""Free memory at the end of a heap above which it is returned, bytes."""
_M_TRIM_THRESHOLD: Final = -1  # <malloc.h>
_M_MMAP_THRESHOLD: Final = -3


def _mallopt(option: int, value: int) -> bool:
    """Return whether the C library took the option; a library without it takes none."""
    function = getattr(ctypes.CDLL(None), "mallopt", None)
    return function is not None and bool(function(option, value))


def keep_large_blocks_apart(mallopt: Callable[[int, int], bool] = _mallopt) -> bool:
    """Map large blocks on their own for the rest of this process; return whether the C library does so.

    By default glibc raises this size, up to 32 MiB, whenever a mapped block is freed. Blocks of changing sizes then
    share one heap a thread, which grows over hours although the blocks in use do not: measured 19 MiB/h. Call it
    before threads start.
    """
    return mallopt(_M_MMAP_THRESHOLD, LARGE_BYTES) and mallopt(_M_TRIM_THRESHOLD, TRIM_BYTES)


def freeze_garbage() -> None:
    """Collect garbage once, then exclude all present objects from later collections, which become short and frequent.

    Python collects old garbage when the objects that are new to it are a quarter of what its last collection visited.
    The second collection here visits nothing; without it, the next one waits for a quarter of all modules' objects:
    in the live view an hour of closed connections.
    """
    gc.collect()
    gc.freeze()
    gc.collect()
