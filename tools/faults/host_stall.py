"""Measures how long a shared machine stalls, which limits the accuracy of a bound on other processes."""

from __future__ import annotations

import threading
import time
from collections import deque

_SLEEP_S = 0.001
_STALL_NS = 5_000_000  # a 1 ms sleep that takes longer: the machine did not run this thread in time
_KEEP = 10_000


class HostStall:
    """Context manager that measures the delays of repeated 1 ms sleeps.

    A bound in milliseconds on other processes is meaningful only if the machine schedules processes in time.
    """

    def __init__(self) -> None:
        self._stalls: deque[tuple[int, int]] = deque(maxlen=_KEEP)  # (when the sleep should have ended, when it did)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="host-stall", daemon=True)

    def __enter__(self) -> HostStall:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._thread.join()

    def add(self, due_ns: int, woken_ns: int) -> None:
        """Record a sleep that ended at `woken_ns` instead of `due_ns`."""
        self._stalls.append((due_ns, woken_ns))

    def between_ns(self, begin_ns: int, end_ns: int) -> int:
        """Return the sum of the stalls inside a window, ns; 0 on an idle machine."""
        return sum(max(min(late, end_ns) - max(due, begin_ns), 0) for due, late in list(self._stalls))

    def _watch(self) -> None:
        while not self._ending.is_set():
            due_ns = time.monotonic_ns() + int(_SLEEP_S * 1e9)
            time.sleep(_SLEEP_S)
            woken_ns = time.monotonic_ns()
            if woken_ns - due_ns > _STALL_NS:
                self.add(due_ns, woken_ns)
