"""Ground truth of a run: the poses in edge-hil's trace, read while it is written."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from firmware_bridge.system.input_file import parse_json


@dataclass(frozen=True)
class TruePose:
    """One line of ground truth: m, rad, world frame; `touching`: labels of the touched objects."""

    t_ns: int
    x_m: float
    y_m: float
    theta_rad: float
    touching: tuple[str, ...]


class LineTail:
    """Reads each line of a growing file of JSON lines once; an unfinished last line is read later."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0

    def lines(self) -> list[dict[str, Any]]:
        """Return the lines added since the last call; none while there is no file."""
        try:
            with self._path.open("rb") as stream:
                stream.seek(self._offset)
                added = stream.read()
        except FileNotFoundError:
            return []
        whole = added[: added.rfind(b"\n") + 1]
        self._offset += len(whole)
        return list(parsed(whole))


class TruthTail(LineTail):
    """Reads the poses that were added to a trace."""

    newest: TruePose | None = None

    def update(self) -> list[TruePose]:
        """Return the poses since the last call, in order."""
        poses = [
            TruePose(int(line["t_ns"]), line["x"], line["y"], line["theta"], tuple(line["touching"]))
            for line in self.lines()
            if line.get("kind") == "pose"
        ]
        if poses:
            self.newest = poses[-1]
        return poses


def parsed(text: bytes) -> Iterator[dict[str, Any]]:
    """Yield the objects of a JSON-lines text; lines that are incomplete or no object are left out."""
    for line in text.splitlines():
        try:
            content = parse_json(line)
        except ValueError:
            continue
        if isinstance(content, dict):
            yield content


def read_lines(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the objects of a JSON-lines file; an incomplete last line is left out. Raises OSError."""
    with path.open("rb") as stream:
        for line in stream:
            yield from parsed(line)
