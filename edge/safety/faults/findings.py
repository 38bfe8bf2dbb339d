"""Findings: what a monitor has seen now; and the queue by which other threads hand theirs to the control thread."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from edge.safety.faults.table import FAULTS


@dataclass(frozen=True)
class Finding:
    """A fault of the table, seen in one step. It is given again in every step as long as it is there."""

    name: str
    detail: str = ""
    """Numbers for the operator: what was found and what was expected."""
    speed_scale: float | None = None
    """A limit that depends on how bad it is; None: the table's."""

    def __post_init__(self) -> None:
        if self.name not in FAULTS:
            raise ValueError(f"{self.name!r} is not a fault of the table (edge/safety/faults/table.py)")
        if self.speed_scale is not None and not 0 <= self.speed_scale <= 1:
            raise ValueError(f"finding {self.name}: expected a speed scale in 0..1, found {self.speed_scale}")


class FindingQueue:
    """Findings of other threads (odometry, power), kept until the control thread takes them.

    No thread waits: appending to and taking from a deque are atomic in CPython. A full queue forgets its oldest entry.
    """

    def __init__(self, capacity: int = 256) -> None:
        self._queue: deque[Finding] = deque(maxlen=capacity)

    def put(self, findings: tuple[Finding, ...]) -> None:
        """Add the findings of one step of a monitor; any thread."""
        self._queue.extend(findings)

    def __len__(self) -> int:
        return len(self._queue)

    def take(self) -> tuple[Finding, ...]:
        """Everything since the last call, oldest first; control thread only."""
        taken: list[Finding] = []
        # No more than fit in the queue: a thread that adds without end must not hold the control thread up.
        for _ in range(len(self._queue)):
            taken.append(self._queue.popleft())
        return tuple(taken)
