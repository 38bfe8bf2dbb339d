"""Preparation of batches in another thread while the network computes."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from types import TracebackType
from typing import Generic, TypeVar

Made = TypeVar("Made")

DEPTH = 2
"""Batches prepared in advance; more would only take memory, because a step computes longer than its batch takes."""


class Ahead(Generic[Made]):
    """Runs `make(step)` in advance for consecutive steps; its errors are raised by `at`."""

    def __init__(self, make: Callable[[int], Made]) -> None:
        self._make = make
        self._pool = ThreadPoolExecutor(1, "prefetch")
        self._coming: dict[int, Future[Made]] = {}

    def at(self, step: int, total: int) -> Made:
        """Return the result of step `step` of `total` and start the next ones."""
        for number in range(step, min(step + 1 + DEPTH, total)):
            if number not in self._coming:
                self._coming[number] = self._pool.submit(self._make, number)
        return self._coming.pop(step).result()

    def rest(self) -> None:
        """Wait until no call of `make` is running, because its inputs are not thread-safe."""
        wait(self._coming.values())

    def __enter__(self) -> Ahead[Made]:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)
