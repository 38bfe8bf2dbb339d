"""Measures how long a shared machine stalls, which limits the accuracy of a bound on other processes.

    python -m sim_hil.realtime.host_stall stalls.jsonl     # until SIGINT or SIGTERM

With a real-time priority above all that it watches over, hardly anything but the machine delays this process: a sleep
that ends late is then a stall, such as one of a virtual machine whose processor time is limited. It takes 4 % of a
core for two processors.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.core.cli import EXIT_CHECK_FAILED, EXIT_DONE
from firmware_bridge.core.config import BRIDGE_PRIORITY
from sim_hil.realtime.truth import read_lines

_SLEEP_S = 0.001
_PROCESS_SLEEP_S = 0.002  # costs half as much
_STALL_NS = 5_000_000  # a sleep that ends later than this: the machine did not run this thread in time
_KEEP = 10_000
STALL_PRIORITY: Final = BRIDGE_PRIORITY + 10
"""Real-time priority of the process, above everything that drives a robot."""
REAL_TIME: Final = "real_time"
"""Key of the line with which each processor's watch begins: whether it has a priority above the bridge's."""

Stalls = NDArray[np.int64]
"""[n, 2]: when a sleep should have ended, and when it did, ns; in order and apart from each other."""


def watch_sleeps(ended: Callable[[], bool], add: Callable[[int, int], None], sleep_s: float = _SLEEP_S) -> None:
    """Sleep again and again until `ended()`; give each late sleep to `add(due_ns, woken_ns)`."""
    while not ended():
        due_ns = time.monotonic_ns() + round(sleep_s * 1e9)
        time.sleep(sleep_s)
        woken_ns = time.monotonic_ns()
        if woken_ns - due_ns > _STALL_NS:
            add(due_ns, woken_ns)


class HostStall:
    """Context manager that measures the delays of repeated 1 ms sleeps on each processor.

    A bound in milliseconds on other processes is meaningful only if the machine schedules processes in time. A sleep
    that may end on any processor misses the stalls of a single one, which hold a process that runs there.
    """

    def __init__(self) -> None:
        self._stalls: deque[tuple[int, int]] = deque(maxlen=_KEEP)  # (when the sleep should have ended, when it did)
        self._ending = threading.Event()
        self._threads = [
            threading.Thread(target=self._watch, args=(cpu,), name=f"host-stall-{cpu}", daemon=True)
            for cpu in sorted(os.sched_getaffinity(0))
        ]

    def __enter__(self) -> HostStall:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        for thread in self._threads:
            thread.join()

    def _watch(self, cpu: int) -> None:
        _stay_on(cpu)
        watch_sleeps(self._ending.is_set, self.add)

    def add(self, due_ns: int, woken_ns: int) -> None:
        """Record a sleep that ended at `woken_ns` instead of `due_ns`."""
        self._stalls.append((due_ns, woken_ns))

    def between_ns(self, begin_ns: int, end_ns: int) -> int:
        """Return how long any processor stalled inside a window, ns; 0 on an idle machine."""
        return sum(max(min(late, end_ns) - max(due, begin_ns), 0) for due, late in _apart(list(self._stalls)))


def _stay_on(cpu: int) -> None:
    with suppress(OSError):  # the processor is no longer there: watch on another one
        os.sched_setaffinity(0, {cpu})


def _apart(stalls: Iterable[tuple[int, int]]) -> list[list[int]]:
    """Return stalls in order, those that overlap as one."""
    merged: list[list[int]] = []
    for due_ns, woken_ns in sorted(stalls):
        if merged and due_ns <= merged[-1][1]:
            merged[-1][1] = max(merged[-1][1], woken_ns)
        else:
            merged.append([due_ns, woken_ns])
    return merged


def read_stalls(path: Path) -> Stalls | None:
    """Read the file of the process; None where a watch lacked its priority or there is no file. Raises OSError.

    Stalls of several processors that overlap are one.
    """
    lines = list(read_lines(path)) if path.exists() else []
    begins = [line[REAL_TIME] for line in lines if REAL_TIME in line]
    if not begins or not all(begins):
        return None
    stalls = _apart((line["due_ns"], line["woken_ns"]) for line in lines if "due_ns" in line)
    return np.array(stalls, np.int64).reshape(-1, 2)


def stalled_ns(stalls: Stalls, begin_ns: NDArray[np.int64], end_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return how long the machine stalled within each of n windows, ns [n]."""
    spans = stalls[:, 1] - stalls[:, 0]
    before = np.concatenate(([0], np.cumsum(spans)))  # stalled until each stall's begin

    def until(at_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        index = np.searchsorted(stalls[:, 0], at_ns, side="right")
        if not len(stalls):
            return np.zeros_like(at_ns)
        newest = np.maximum(index - 1, 0)
        inside = np.clip(at_ns - stalls[newest, 0], 0, spans[newest])
        return np.where(index > 0, before[newest] + inside, 0)

    return until(end_ns) - until(begin_ns)


def main(argv: Sequence[str] | None = None) -> int:
    """Write the stalls of every processor to a JSON-lines file until SIGINT or SIGTERM; 1 if the file takes no more."""
    (path,) = sys.argv[1:] if argv is None else argv
    ending = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ending.set())
    failed: list[OSError] = []
    with Path(path).open("w", encoding="ascii", buffering=1) as file:

        def write(line: Mapping[str, object]) -> None:
            try:
                file.write(json.dumps(line) + "\n")
            except OSError as error:  # a full disk
                failed.append(error)
                ending.set()

        def watch(cpu: int) -> None:
            _stay_on(cpu)
            real_time = os.sched_getscheduler(0) in (os.SCHED_FIFO, os.SCHED_RR)
            above = real_time and os.sched_getparam(0).sched_priority > BRIDGE_PRIORITY
            write({"cpu": cpu, REAL_TIME: above})

            def add(due_ns: int, woken_ns: int) -> None:
                write({"cpu": cpu, "due_ns": due_ns, "woken_ns": woken_ns})

            watch_sleeps(ending.is_set, add, _PROCESS_SLEEP_S)

        threads = [threading.Thread(target=watch, args=(cpu,)) for cpu in sorted(os.sched_getaffinity(0))]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    return EXIT_CHECK_FAILED if failed else EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
