"""What the sniffer has heard so far, and what it means: pure judgements over stamped Moves."""

from __future__ import annotations

import itertools
import json
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from firmware_bridge.unitree.messages import ids

Velocity = tuple[float, float, float]
KEEP_NS = 120_000_000_000


@dataclass(frozen=True)
class ReceivedCommand:
    """One request of the sport service; `velocity` of a Move."""

    t_ns: int
    source: int
    api_id: int
    velocity: Velocity | None

    @property
    def moving(self) -> bool:
        """A Move that is not zero."""
        return self.velocity is not None and any(self.velocity)


class Tail:
    """Reads a growing file of JSON lines, each once; an unfinished last line waits for its end."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0

    def lines(self) -> list[dict[str, Any]]:
        """What has been added since the last call; nothing while there is no file."""
        try:
            with self._path.open("rb") as file:
                file.seek(self._offset)
                data = file.read()
        except FileNotFoundError:
            return []
        whole = data[: data.rfind(b"\n") + 1]
        self._offset += len(whole)
        return [json.loads(line) for line in whole.splitlines()]


class Hearing:
    """The sniffer's last two minutes."""

    def __init__(self, path: Path) -> None:
        self._tail = Tail(path)
        self._heard: deque[ReceivedCommand] = deque()

    def update(self) -> None:
        """Read what has been added."""
        for line in self._tail.lines():
            found = line["velocity"]
            velocity = (float(found[0]), float(found[1]), float(found[2])) if isinstance(found, list) else None
            self._heard.append(ReceivedCommand(int(line["t_ns"]), int(line["source"]), int(line["api_id"]), velocity))
        while self._heard and self._heard[-1].t_ns - self._heard[0].t_ns > KEEP_NS:
            self._heard.popleft()

    def since(self, t_ns: int, *, but: frozenset[int] = frozenset()) -> list[ReceivedCommand]:
        """Requests from `t_ns` on, without those of the sources in `but`."""
        self.update()
        return [heard for heard in self._heard if heard.t_ns >= t_ns and heard.source not in but]

    def sources(self) -> frozenset[int]:
        """Return the sources of the requests of the last two minutes."""
        self.update()
        return frozenset(heard.source for heard in self._heard)

    def last_moves(self, count: int) -> list[ReceivedCommand]:
        """The newest Moves, oldest first."""
        self.update()
        moves = [heard for heard in self._heard if heard.velocity is not None]
        return moves[-count:]


def moves(heard: Iterable[ReceivedCommand]) -> list[tuple[int, Velocity]]:
    """(ns, velocity) of every Move."""
    return [(one.t_ns, one.velocity) for one in heard if one.api_id == ids.MOVE and one.velocity is not None]


def first_lasting(stamped: Sequence[tuple[int, Velocity]], limit: Velocity) -> int | None:
    """When the first command came of those at the end that are all within `limit`; None when the last is not.

    `limit` bounds the size of each component; all zero: only zero is within it.
    """
    first = None
    for t_ns, velocity in stamped:
        if all(abs(v) <= bound for v, bound in zip(velocity, limit, strict=True)):
            first = t_ns if first is None else first
        else:
            first = None
    return first


def longest_gap_ms(stamped: Sequence[tuple[int, Velocity]], begin_ns: int, end_ns: int) -> float:
    """Longest time in a window without a command, both ends included."""
    stamps = [begin_ns, *(t_ns for t_ns, _ in stamped if begin_ns <= t_ns <= end_ns), end_ns]
    return max(b - a for a, b in itertools.pairwise(stamps)) / 1e6
