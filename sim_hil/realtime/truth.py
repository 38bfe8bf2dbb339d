"""Ground truth of a run: the poses in edge-hil's trace, read while it is written."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class TruePose:
    """One line of ground truth: m, rad, world frame; `touching`: labels of the touched objects."""

    t_ns: int
    x_m: float
    y_m: float
    theta_rad: float
    touching: tuple[str, ...]


class TruthTail:
    """Reader of a growing trace; an unfinished last line is left for the next call."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0
        self.newest: TruePose | None = None

    def update(self) -> list[TruePose]:
        """Return the poses since the last call, in order."""
        poses = [
            TruePose(int(line["t_ns"]), line["x"], line["y"], line["theta"], tuple(line["touching"]))
            for line in self._lines()
            if line.get("kind") == "pose"
        ]
        if poses:
            self.newest = poses[-1]
        return poses

    def _lines(self) -> Iterator[dict[str, Any]]:
        try:
            with self._path.open("rb") as stream:
                stream.seek(self._offset)
                added = stream.read()
        except FileNotFoundError:
            return
        whole = added[: added.rfind(b"\n") + 1]
        self._offset += len(whole)
        yield from parsed(whole)


def parsed(text: bytes) -> Iterator[dict[str, Any]]:
    """Yield the objects of a JSON-lines text; an incomplete line (only the last can be) is left out."""
    for line in text.splitlines():
        try:
            yield json.loads(line)
        except ValueError:
            continue


def read_lines(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the objects of a JSON-lines file; an incomplete last line is left out. Raises OSError."""
    with path.open("rb") as stream:
        for line in stream:
            yield from parsed(line)
