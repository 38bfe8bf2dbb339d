"""Keeps the C library's heap from growing over hours of blocks whose sizes change."""

from __future__ import annotations

import ctypes
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
