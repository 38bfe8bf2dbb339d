"""Readings of a process's memory, and the growth that they show."""

from __future__ import annotations

import ctypes
import gc
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np

from sim_hil.soak.trends import Trend, trend

MIB: Final = 1 << 20
LIMIT_MIB_PER_H: Final = 0.954
"""Largest growth of a process, MiB/h: 1 MB/h (fault matrix, row 61)."""


_MALLINFO2: Final = (
    *("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost"),
)


class _Mallinfo2(ctypes.Structure):
    """`struct mallinfo2` of <malloc.h>: sums over all arenas, bytes."""

    _fields_ = tuple((name, ctypes.c_size_t) for name in _MALLINFO2)


@cache
def _mallinfo2() -> Callable[[], _Mallinfo2] | None:
    """Return the C library's function; None without it. Looked up once: each look-up leaves garbage."""
    function = getattr(ctypes.CDLL(None), "mallinfo2", None)
    if function is not None:
        function.restype = _Mallinfo2
    return function


def heap_bytes() -> tuple[int, int]:
    """Return the bytes in use and the free bytes of the C library's heap; (0, 0) without `mallinfo2`."""
    function = _mallinfo2()
    if function is None:
        return 0, 0
    found = function()
    return found.uordblks + found.hblkhd, found.fordblks


def read_sizes(pid: int | str = "self") -> dict[str, int]:
    """Return RSS, PSS, private dirty and anonymous memory of a process, bytes. Raises OSError once it has ended."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii").splitlines()
    fields = {words[0][:-1]: 1024 * int(words[1]) for words in map(str.split, lines) if len(words) == 3}
    names = {"rss": "Rss", "pss": "Pss", "private_dirty": "Private_Dirty", "anonymous": "Anonymous"}
    return {name: fields[field] for name, field in names.items()}


def read_own(*, objects: bool = True) -> dict[str, int]:
    """Return the sizes of this process, its heap, Python's memory blocks and the objects that gc tracks."""
    used, free = heap_bytes()
    found = {"t_ns": time.monotonic_ns(), **read_sizes(), "heap_used": used, "heap_free": free}
    found["blocks"] = sys.getallocatedblocks()
    return {**found, "objects": len(gc.get_objects())} if objects else found


@dataclass(frozen=True)
class Growth:
    """Growth of one part per operation, over the later half of its operations."""

    part: str
    operations: int
    heap_bytes: float
    """Bytes in use of the C library's heap."""
    blocks: float
    """Memory blocks of Python."""
    rss_bytes: float
    per_h: int
    """Operations an hour in a real run."""

    @property
    def heap_mib_per_h(self) -> float:
        """Growth of the heap in a real run, MiB/h."""
        return self.heap_bytes * self.per_h / MIB

    @property
    def rss_mib_per_h(self) -> float:
        """Growth of the resident memory in a real run, MiB/h."""
        return self.rss_bytes * self.per_h / MIB


def growth(part: str, per_h: int, done: Sequence[int], readings: Sequence[dict[str, int]]) -> Growth:
    """Return the growth of a part by readings after so many operations, by a straight line through the later half."""
    half = len(done) // 2
    at = np.array(done[half:], float)

    def slope(name: str) -> float:
        return float(np.polyfit(at - at[0], np.array([one[name] for one in readings[half:]], float), 1)[0])

    return Growth(part, done[-1], slope("heap_used"), slope("blocks"), slope("rss"), per_h)


def later_half(readings: Sequence[dict[str, int]], name: str) -> Trend | None:
    """Return the trend of one reading over the second half of a run, MiB/h; None for fewer than 10 readings."""
    half = readings[len(readings) // 2 :]
    at_s = np.array([(one["t_ns"] - readings[0]["t_ns"]) / 1e9 for one in half])
    return trend(at_s, np.array([one[name] / MIB for one in half]))
