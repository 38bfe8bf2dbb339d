"""Motion requests received on the robot's side, and pure functions that judge them."""

from __future__ import annotations

import itertools
from bisect import bisect_right
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sim_hil.realtime.truth import LineTail

Velocity = tuple[float, float, float]
KEEP_NS = 120_000_000_000


@dataclass(frozen=True)
class ReceivedCommand:
    """Request that reached the robot; `velocity` only for one that requests motion or its end."""

    t_ns: int
    source: int
    velocity: Velocity | None

    @property
    def moving(self) -> bool:
        """Whether it requests motion."""
        return self.velocity is not None and any(self.velocity)


class ReceivedCommands:
    """Requests of the last two minutes, from the sniffer's file or from edge-hil's trace."""

    def __init__(self, path: Path) -> None:
        self._tail = LineTail(path)
        self._requests: deque[ReceivedCommand] = deque()

    def update(self) -> None:
        """Read the lines that the robot has written since the last call."""
        for line in self._tail.lines():
            if line.get("kind", "wire") != "wire":
                continue
            found = line["velocity"]
            velocity = (float(found[0]), float(found[1]), float(found[2])) if isinstance(found, list) else None
            self._requests.append(ReceivedCommand(int(line["t_ns"]), int(line["source"]), velocity))
        while self._requests and self._requests[-1].t_ns - self._requests[0].t_ns > KEEP_NS:
            self._requests.popleft()

    def since(self, t_ns: int) -> list[ReceivedCommand]:
        """Return the requests from `t_ns` on."""
        self.update()
        return [request for request in self._requests if request.t_ns >= t_ns]

    def sources(self) -> frozenset[int]:
        """Return the sources of the requests of the last two minutes."""
        self.update()
        return frozenset(request.source for request in self._requests)

    def last_moves(self, count: int) -> list[ReceivedCommand]:
        """Return the newest motion requests, oldest first."""
        self.update()
        moves = [request for request in self._requests if request.velocity is not None]
        return moves[-count:]


def moves(requests: Iterable[ReceivedCommand]) -> list[tuple[int, Velocity]]:
    """Return (ns, velocity) of every motion request."""
    return [(one.t_ns, one.velocity) for one in requests if one.velocity is not None]


def first_lasting(stamped: Sequence[tuple[int, Velocity]], limit: Velocity) -> int | None:
    """Return the stamp from which all further commands are within `limit`, ns; None if the last one is not.

    `limit` bounds the absolute value of each component; with zeros only zero is within it.
    """
    first = None
    for t_ns, velocity in stamped:
        if all(abs(v) <= bound for v, bound in zip(velocity, limit, strict=True)):
            first = t_ns if first is None else first
        else:
            first = None
    return first


def longest_gap_ms(stamped: Sequence[tuple[int, Velocity]], begin_ns: int, end_ns: int) -> float:
    """Return the longest time without a command in a window, including both ends, ms."""
    stamps = [begin_ns, *(t_ns for t_ns, _ in stamped if begin_ns <= t_ns <= end_ns), end_ns]
    return max(b - a for a, b in itertools.pairwise(stamps)) / 1e6


def moving_at(obeys: Sequence[tuple[int, bool]], t_ns: int) -> bool:
    """Return whether the robot obeyed motion at `t_ns`; `obeys`: times at which it began or ceased to, in order."""
    return next((moving for since_ns, moving in reversed(obeys) if since_ns <= t_ns), False)


def longest_age_ms(received_ns: Sequence[int], obeys: Sequence[tuple[int, bool]], begin_ns: int, end_ns: int) -> float:
    """Return the longest age of the newest received command while the robot obeys motion, in a window, ms.

    `received_ns`: times of the received commands; `obeys`: times at which the robot began or ceased to obey motion.
    Both are in order and also contain what was before the window.
    """
    longest_ns = 0
    edges = [*obeys, (end_ns, False)]
    for (since_ns, moving), (until_ns, _) in itertools.pairwise(edges):
        first_ns, last_ns = max(since_ns, begin_ns), min(until_ns, end_ns)
        if not moving or first_ns >= last_ns:
            continue
        before = received_ns[: bisect_right(received_ns, first_ns)]
        within = received_ns[bisect_right(received_ns, first_ns) : bisect_right(received_ns, last_ns)]
        stamps = [*before[-1:], *within, last_ns]
        longest_ns = max(longest_ns, *(b - a for a, b in itertools.pairwise(stamps)), 0)
    return longest_ns / 1e6
