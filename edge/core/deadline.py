"""Waits for functions that may hang, under one common deadline."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


class Deadline:
    """Instant `seconds` after its creation."""

    def __init__(self, seconds: float, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._clock = clock
        self._end_ns = clock() + round(seconds * 1e9)

    def left_s(self, at_most_s: float | None = None) -> float:
        """Return the remaining time, s, never negative."""
        left_s = max(0.0, (self._end_ns - self._clock()) / 1e9)
        return left_s if at_most_s is None else min(left_s, at_most_s)

    def run(self, name: str, body: Callable[[], object]) -> bool:
        """Run `body` for at most the remaining time; return whether it ended. Raises what `body` raises."""
        return run_in_thread(name, body, self.left_s())


def run_in_thread(name: str, body: Callable[[], object], timeout_s: float | None = None) -> bool:
    """Run `body` in a thread and wait for it; return whether it has ended. Raises what `body` raises."""
    errors: list[BaseException] = []

    def target() -> None:
        try:
            body()
        except BaseException as error:  # noqa: BLE001 - raised again in the caller's thread
            errors.append(error)

    # A daemon thread: one that hangs must not keep the process alive.
    thread = threading.Thread(target=target, name=name, daemon=timeout_s is not None)
    thread.start()
    thread.join(timeout_s)
    if errors:
        raise errors[0]
    return not thread.is_alive()
