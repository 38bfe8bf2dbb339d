"""Memory that is freed goes back to the system, and garbage does not wait for hours."""

from __future__ import annotations

import subprocess
import sys

import pytest

from edge.core.heap import LARGE_BYTES, keep_large_blocks_apart

# Anonymous memory that stays after 20 blocks of 1 MiB were freed which lie between small ones, KiB.
_FREED = """
import ctypes, sys
from pathlib import Path
from edge.core.heap import keep_large_blocks_apart

if sys.argv[1] == "apart":
    assert keep_large_blocks_apart()
c = ctypes.CDLL(None)
c.malloc.restype, c.malloc.argtypes, c.free.argtypes = ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]

def taken(size):
    block = c.malloc(size)
    ctypes.memset(block, 1, size)
    return block

def anonymous():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("RssAnon"))

c.free(taken(16 << 20))  # by default, blocks of up to 16 MiB stay in the heap from now on
before = anonymous()
blocks = [(taken(1 << 20), taken(1000)) for _ in range(20)]
for block, _ in blocks:
    c.free(block)
print(anonymous() - before)
"""

# Full collections while 200,000 objects that refer to themselves come and go beside a program's modules.
_COLLECTED = """
import gc, sys
from edge.core.heap import freeze_garbage

class Connection:
    def __init__(self):
        self.own = self

modules = [[] for _ in range(500_000)]
if sys.argv[1] == "freeze":
    freeze_garbage()
else:
    gc.collect()
    gc.freeze()
before = gc.get_stats()[2]["collections"]
for _ in range(200_000):
    Connection()
print(gc.get_stats()[2]["collections"] - before)
"""


def kept_kib(how: str) -> int:
    """Return the memory that a process keeps after it has freed 20 MiB in large blocks, KiB."""
    run = subprocess.run([sys.executable, "-c", _FREED, how], capture_output=True, text=True, check=True)
    return int(run.stdout)


def test_freed_large_blocks_go_back_to_the_system() -> None:
    assert kept_kib("apart") < 2048
    assert kept_kib("default") > 10_240, "this C library returns them by itself: the test above shows nothing"


@pytest.mark.parametrize("takes", [True, False])
def test_a_c_library_without_the_option_changes_nothing(takes: bool) -> None:
    asked: list[tuple[int, int]] = []

    def mallopt(option: int, value: int) -> bool:
        asked.append((option, value))
        return takes

    assert keep_large_blocks_apart(mallopt) is takes
    assert asked[0][1] == LARGE_BYTES and len(asked) == (2 if takes else 1)


def collections(how: str) -> int:
    """Return the number of full collections of a process that froze its objects and makes garbage since."""
    run = subprocess.run([sys.executable, "-c", _COLLECTED, how], capture_output=True, text=True, check=True)
    return int(run.stdout)


def test_garbage_of_a_frozen_process_is_collected_soon() -> None:
    assert collections("freeze") > 0
    assert collections("by hand") == 0, "this Python collects soon by itself: the test above shows nothing"
