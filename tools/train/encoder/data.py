"""The encoder's training images on disk: shards of one scene each, with labels and a key of their configuration.

A shard is `NAME.safetensors` and `NAME.json`, written after it, with key and hash. A shard without JSON file or with
another key is rendered again. `fill` renders missing shards in worker processes.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from edge.core.cli import write_whole
from export.core.typed import plain
from firmware_bridge.system.input_file import read_json
from sim_hil.benchmark.suite.episode import ROBOTS
from sim_hil.benchmark.workers.worker_pool import WorkerEvent, WorkerJob, Workers
from tools.train.config.checks import TrainError
from tools.train.config.collect import CORRIDOR, OUTDOORS
from tools.train.config.encoder import OUTDOORS_LEAST, FramesConfig
from tools.train.drives.drive import file_sha256
from tools.train.encoder.labels import CLASSES, COLOUR_WORDS, OPENINGS, PIXELS, label_shapes
from tools.train.samples.augment import Picture, decoded

if TYPE_CHECKING:  # workers that draw pictures start without torch, whose import takes as long as a tour
    from tools.train.run.job import StageProgress

FORMAT: Final = 2
WORKER: Final = "tools.train.encoder.worker"
FIRST_LAYOUT: Final = 10_000_000_000
"""First seed of the layouts, above all seeds of drives (`tools.train.drives.scenarios`)."""
_OF_A_SEED, _HELD_FROM = 1_000_000, 500_000  # layouts per stage seed, and the first held-out one
_TAG: Final = 0xE0C0
_POLL_S: Final = 0.5
_CORRIDOR_MOST: Final = 12  # most people in the corridor
_LEAST_HELD: Final = 32  # fewest images of a held-out scene, because a scene takes seconds to build
_EMPTY_SHARE: Final = 0.12  # share of indoor scenes without people


@dataclass(frozen=True)
class Shard:
    """Configuration of one scene's images; `side`: visual tokens along one side of an image."""

    name: str
    kind: str
    layout_seed: int
    robot: str
    people: int
    frames: int
    seed: int
    side: int
    held: bool
    moment: int
    moment_s: float
    sharp_share: float
    jpeg_quality_min: int
    jpeg_quality_max: int

    @property
    def key(self) -> str:
        """Hash of everything that determines the content, except the rendering code."""
        made = {
            "format": FORMAT,
            "shard": plain(self),
            "classes": CLASSES,
            "colours": COLOUR_WORDS,
            "openings": OPENINGS,
            "pixels": PIXELS,
        }
        return hashlib.sha256(json.dumps(made, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class Made:
    """Index entry of a rendered shard."""

    name: str
    key: str
    sha256: str
    bytes: int


def plan(config: FramesConfig, seed: int, side: int) -> list[Shard]:
    """Return all shards of a stage: training shards, then held-out ones. Depends on the arguments alone."""
    return _planned(config, seed, side, held=False) + _planned(config, seed, side, held=True)


def _planned(config: FramesConfig, seed: int, side: int, *, held: bool) -> list[Shard]:
    kinds = [kind for kind in config.kinds if not (held and kind == CORRIDOR)]
    left = config.held if held else config.count
    # Held-out images come from many layouts, which estimates the error on new layouts better.
    per_scene = config.per_scene
    if held and left:
        per_scene = min(per_scene, max(_LEAST_HELD, -(-left // (4 * len(set(kinds))))))
    shards: list[Shard] = []
    while left > 0:
        number = len(shards)
        rng = np.random.default_rng((seed, _TAG, int(held), number))
        kind = kinds[(number + number // len(kinds)) % len(kinds)]
        layout_seed = FIRST_LAYOUT + seed % 1_000 * _OF_A_SEED + (_HELD_FROM if held else 0) + number
        frames = min(per_scene, left)
        # Robots alternate within each kind, so that each has the same number of scenes.
        robot = ROBOTS[sum(shard.kind == kind for shard in shards) % len(ROBOTS)]
        people = _people(config, kind, rng)
        name = f"{'held' if held else 'train'}-{number:04d}-{kind}-{robot}"
        shards.append(
            Shard(
                name, kind, layout_seed, robot, people, frames, int(rng.integers(2**31)), side, held,
                config.moment, config.moment_s, config.sharp_share, config.jpeg_quality_min, config.jpeg_quality_max,
            )
        )  # fmt: skip
        left -= frames
    return shards


def _people(config: FramesConfig, kind: str, rng: np.random.Generator) -> int:
    if kind in OUTDOORS:
        return int(rng.integers(OUTDOORS_LEAST, config.people_outdoors + 1))
    most = min(config.people_indoors, _CORRIDOR_MOST) if kind == CORRIDOR else config.people_indoors
    return 0 if rng.uniform() < _EMPTY_SHARE else int(rng.integers(0, most + 1))


def made(folder: Path, shard: Shard) -> Made | None:
    """Return a shard's entry; None unless it is complete and has the same configuration."""
    try:
        content = Made(**read_json(folder / f"{shard.name}.json"))
        whole = path_of(folder, shard.name).stat().st_size == content.bytes
    except (OSError, ValueError, TypeError):
        return None
    return content if whole and content.key == shard.key else None


def path_of(folder: Path, name: str) -> Path:
    """Return the path of a shard's file."""
    return folder / f"{name}.safetensors"


def fill(
    folder: Path, shards: Sequence[Shard], jobs: int, progress: StageProgress, should_stop: Callable[[], bool]
) -> None:
    """Render missing shards. Raises TrainError, OSError, KeyboardInterrupt if `should_stop`."""
    logs = folder / "logs"
    logs.mkdir(parents=True, exist_ok=True)
    for partial in folder.glob("*.partial"):
        partial.unlink()
    missing = [shard for shard in shards if made(folder, shard) is None]
    total = sum(shard.frames for shard in shards)
    before = total - sum(shard.frames for shard in missing)
    taken: dict[str, int] = {}
    progress.update(before, total)
    # The slowest first, so that no core idles at the end.
    missing.sort(key=lambda shard: (shard.people * shard.frames, shard.name), reverse=True)
    waiting = deque(
        WorkerJob(shard.name, {"folder": str(folder), "shard": plain(shard)}, logs / f"{shard.name}.log")
        for shard in missing
    )
    with Workers([sys.executable, "-m", WORKER], jobs) as workers:
        for events in workers.run(waiting, should_stop):
            for event in events:
                _note(event, taken)
            progress.update(before + sum(taken.values()), total)
    with suppress(OSError):  # logs of processes that failed stay
        logs.rmdir()


def _note(event: WorkerEvent, taken: dict[str, int]) -> None:
    if event.message is not None:
        taken[event.key] = int(event.message["frames"])
    elif event.failure:
        raise TrainError(f"pictures of {event.key}: their process {event.failure}; go on with --resume")


def frames_sha256(folder: Path, shards: Sequence[Shard]) -> str:
    """Hash all shards; it does not depend on the order of rendering. Raises TrainError for a missing shard."""
    lines = []
    for shard in shards:
        there = made(folder, shard)
        if there is None:
            raise TrainError(f"{path_of(folder, shard.name)}: missing, or of another configuration")
        lines.append(f"{there.name} {there.sha256}\n")
    return hashlib.sha256("".join(lines).encode()).hexdigest()


class FrameSet:
    """Images of some shards as one sequence; labels are in memory, images are read on access."""

    def __init__(self, folder: Path, shards: Sequence[Shard]) -> None:
        """Open all shards. Raises TrainError for a missing one."""
        self._files: list[Any] = []
        self._ends: list[NDArray[np.int64]] = []
        parts: dict[str, list[NDArray[np.generic]]] = {}
        for shard in shards:
            path = path_of(folder, shard.name)
            try:
                file = safe_open(path, framework="numpy")
                labels = {name: file.get_tensor(name) for name in label_shapes(shard.side)}
                ends = file.get_tensor("jpeg_end")
            except (OSError, SafetensorError) as error:
                raise TrainError(f"{path}: not readable ({error}); delete it and continue with --resume") from error
            for name, (kind, shape) in label_shapes(shard.side).items():
                if labels[name].shape != (shard.frames, *shape) or labels[name].dtype != kind:
                    raise TrainError(f"{path}: {name}: expected {kind} {(shard.frames, *shape)}; delete it")
                parts.setdefault(name, []).append(labels[name])
            self._files.append(file.get_slice("jpeg"))
            self._ends.append(ends)
        self.labels = {name: np.concatenate(arrays) for name, arrays in parts.items()}
        self._starts = np.cumsum([0, *(len(ends) for ends in self._ends)])

    def __len__(self) -> int:
        return int(self._starts[-1])

    def picture(self, index: int) -> Picture:
        """Decode image number `index` as uint8 RGB [px, px, 3]."""
        if not 0 <= index < len(self):
            raise IndexError(f"pictures: expected a number of 0 to {len(self) - 1}, found {index}")
        shard = int(np.searchsorted(self._starts, index, side="right")) - 1
        k, ends = index - int(self._starts[shard]), self._ends[shard]
        start = int(ends[k - 1]) if k else 0
        return decoded(np.asarray(self._files[shard][start : int(ends[k])], np.uint8))


def finish(folder: Path, shard: Shard) -> Made:
    """Write the entry of a completely written shard and return it. Raises OSError."""
    path = path_of(folder, shard.name)
    done = Made(shard.name, shard.key, file_sha256(path), path.stat().st_size)
    write_whole(folder / f"{shard.name}.json", json.dumps(asdict(done), sort_keys=True) + "\n")
    return done
