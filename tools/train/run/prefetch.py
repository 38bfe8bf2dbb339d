"""Batches made in another thread while the network computes."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from types import TracebackType
from typing import Generic, TypeVar

Made = TypeVar("Made")

DEPTH = 2
"""Steps that are made ahead: more would only take memory, a step computes longer than it is made."""


class Ahead(Generic[Made]):
    """What `make(step)` gives for one step after the other; errors come out where the step is asked for."""

    def __init__(self, make: Callable[[int], Made]) -> None:
        self._make = make
        self._pool = ThreadPoolExecutor(1, "prefetch")
        self._coming: dict[int, Future[Made]] = {}

    def at(self, step: int, total: int) -> Made:
        """Step `step` of `total`, with the next ones begun."""
        for number in range(step, min(step + 1 + DEPTH, total)):
            if number not in self._coming:
                self._coming[number] = self._pool.submit(self._make, number)
        return self._coming.pop(step).result()

    def rest(self) -> None:
        """Wait until nothing is being made: what `make` reads is not for two threads at a time."""
        wait(self._coming.values())

    def __enter__(self) -> Ahead[Made]:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)
