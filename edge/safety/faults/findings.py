"""Findings of the monitors, and the queue that brings other threads' findings to the control thread."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from edge.safety.faults.table import FAULTS


@dataclass(frozen=True)
class Finding:
    """A fault of the table, found in one step. A monitor reports it again in every step while it lasts."""

    name: str
    detail: str = ""
    """Found and expected values, for the operator."""
    speed_scale: float | None = None
    """Share of the speed limit where it depends on the severity; None: the table's."""

    def __post_init__(self) -> None:
        if self.name not in FAULTS:
            raise ValueError(f"{self.name!r} is not a fault of the table (edge/safety/faults/table.py)")
        if self.speed_scale is not None and not 0 <= self.speed_scale <= 1:
            raise ValueError(f"finding {self.name}: expected a speed scale in 0..1, found {self.speed_scale}")


class FindingQueue:
    """Findings of other threads (odometry, power), kept until the control thread takes them.

    No thread waits: appending to and taking from a deque are atomic in CPython. A full queue drops its oldest entry.
    """

    def __init__(self, capacity: int = 256) -> None:
        self._queue: deque[Finding] = deque(maxlen=capacity)

    def put(self, findings: tuple[Finding, ...]) -> None:
        """Add the findings of one step of a monitor; any thread."""
        self._queue.extend(findings)

    def __len__(self) -> int:
        return len(self._queue)

    def take(self) -> tuple[Finding, ...]:
        """Return all findings since the last call, oldest first; control thread only."""
        taken: list[Finding] = []
        # At most one queue length: a thread that adds without end must not delay the control thread.
        for _ in range(len(self._queue)):
            taken.append(self._queue.popleft())
        return tuple(taken)
