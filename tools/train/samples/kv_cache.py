"""Cache of semantic states: the frozen language model's last-layer K‖V at every anchor (paper, Algorithm 1, line 5).

A folder contains `kv.json` (its key) and, for each drive, `ID.npy` f16 [tokens, kv_dim] with all states in sequence and
`ID.json` with their positions. Both are written atomically, so that an interrupted run continues with the next drive;
for drives that are added later (DAgger), only their states are computed.
"""

from __future__ import annotations

import json
import os
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from edge.core.cli import write_whole
from edge.state.reasoning_text import Waypoints, parse_waypoints
from tools.train.config.checks import TrainError
from tools.train.samples.language_batch import Halves

FORMAT: Final = 1
INDEX: Final = "kv.json"
_MAX_OPEN: Final = 256  # open mapped files; a process may have 1024 file descriptors


@dataclass(frozen=True)
class Made:
    """A computed state before it is written; `kv` f16 [T, kv_dim]."""

    k: int
    draw: int
    kv: Halves
    prompt_tokens: int
    own: bool
    text: str


@dataclass(frozen=True)
class CachedState:
    """State of one generation: K‖V of prompt and text, read-only and mapped from the file."""

    kv: Halves
    """[T, kv_dim]; the first `prompt_tokens` rows belong to the prompt."""
    prompt_tokens: int
    text: str
    own: bool
    """Whether the model decoded the text; else it is the true text."""

    @property
    def waypoints(self) -> Waypoints | None:
        """(x m, y m) at 3, 6, 9 s in the robot frame at the anchor; None if the text has no valid waypoints."""
        return parse_waypoints(self.text)


@dataclass(frozen=True)
class _Place:
    k: int
    draw: int
    start: int
    tokens: int
    prompt_tokens: int
    own: bool
    text: str


class KvCache:
    """Read access to a cache; arrays are mapped from the files, not copied."""

    def __init__(self, folder: Path) -> None:
        """Open a folder that `build_kv_cache` wrote. Raises TrainError."""
        self.folder = folder
        try:
            content = json.loads((folder / INDEX).read_text(encoding="utf-8"))
            if content["format"] != FORMAT:
                raise TrainError(f"{folder}: expected a cache of format {FORMAT}; delete it and build it again")
            self.key: str = content["key"]
            self.kv_dim: int = content["kv_dim"]
            self.draws: int = content["draws"]
            """Number of states of each anchor, with different wordings and previous progress."""
        except (OSError, ValueError, KeyError, TypeError) as error:
            if isinstance(error, TrainError):
                raise
            raise TrainError(f"{folder}: no cache of keys and values ({error!r}); build it first") from error
        self._indices: dict[str, dict[tuple[int, int], _Place]] = {}
        self._maps: OrderedDict[str, Halves] = OrderedDict()

    def has(self, drive_id: str, sha256: str) -> bool:
        """Return whether the cache contains a drive with this hash of its file."""
        try:
            return bool(_read(self.folder, drive_id)["drive_sha256"] == sha256) and _npy(self.folder, drive_id).exists()
        except TrainError:
            return False

    def anchors(self, drive_id: str) -> tuple[int, ...]:
        """Return the frames of a drive that have a state, ascending. Raises TrainError for a missing drive."""
        return tuple(sorted({k for k, _ in self._index(drive_id)}))

    def at(self, drive_id: str, k: int, draw: int = 0) -> CachedState:
        """Return state number `draw` of the generation whose newest frame is k. Raises TrainError if missing."""
        place = self._index(drive_id).get((k, draw))
        if place is None:
            raise TrainError(f"drive {drive_id}: no state of frame {k}, draw {draw}")
        rows = self._map(drive_id)[place.start : place.start + place.tokens]
        return CachedState(rows, place.prompt_tokens, place.text, place.own)

    def _index(self, drive_id: str) -> dict[tuple[int, int], _Place]:
        if drive_id not in self._indices:
            places = [_Place(**place) for place in _read(self.folder, drive_id)["states"]]
            self._indices[drive_id] = {(place.k, place.draw): place for place in places}
        return self._indices[drive_id]

    def _map(self, drive_id: str) -> Halves:
        if drive_id not in self._maps:
            path, wanted = _npy(self.folder, drive_id), sum(each.tokens for each in self._index(drive_id).values())
            try:
                rows: Halves = np.load(path, mmap_mode="r", allow_pickle=False)
            except (OSError, ValueError) as error:
                raise TrainError(f"{path}: not readable ({error}); delete it and build it again") from error
            if rows.dtype != np.float16 or rows.shape != (wanted, self.kv_dim):
                raise TrainError(f"{path}: expected f16 {(wanted, self.kv_dim)}, found {rows.dtype} {rows.shape}")
            self._maps[drive_id] = rows
            if len(self._maps) > _MAX_OPEN:
                self._maps.popitem(last=False)
        self._maps.move_to_end(drive_id)
        return self._maps[drive_id]


def begin(folder: Path, *, key: str, kv_dim: int, draws: int) -> None:
    """Create a cache folder. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    index = {"format": FORMAT, "key": key, "kv_dim": kv_dim, "draws": draws}
    write_whole(folder / INDEX, json.dumps(index) + "\n")


def _npy(folder: Path, drive_id: str) -> Path:
    return folder / f"{drive_id}.npy"


def _read(folder: Path, drive_id: str) -> Mapping[str, Any]:
    path = folder / f"{drive_id}.json"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return {"drive_sha256": content["drive_sha256"], "states": content["states"]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TrainError(f"{path}: no states of this drive ({error!r}); build the cache for it") from error


def write_states(folder: Path, drive_id: str, sha256: str, states: Sequence[Made], kv_dim: int) -> None:
    """Write a drive's states: first the array, then the JSON file that marks it as complete."""
    rows = np.concatenate([state.kv for state in states] or [np.zeros((0, kv_dim), np.float16)])
    partial = folder / f"{drive_id}.{os.getpid()}.partial"
    with partial.open("wb") as file:
        np.save(file, rows, allow_pickle=False)
    partial.replace(_npy(folder, drive_id))
    places: list[dict[str, Any]] = []
    start = 0
    for state in states:
        place = _Place(state.k, state.draw, start, len(state.kv), state.prompt_tokens, state.own, state.text)
        places.append(asdict(place))
        start += len(state.kv)
    write_whole(
        folder / f"{drive_id}.json", json.dumps({"drive_sha256": sha256, "states": places}, separators=(",", ":"))
    )
