"""One recorded drive as training sees it: pictures, poses, labels and words, in one file; and a folder of such files.

A drive is `drives/ID.safetensors`: arrays over N frames at 10 Hz, and one JSON text with what is the same for the whole
drive. `dataset.json` lists the drives with the hash of each file (`tools.train.drives.dataset` writes it).
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final
from zlib import crc32

import cv2
import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from edge.core.geometry import SE2
from tools.train.config.collect import TRACE_EVERY

FUTURE_STEPS: Final = 50
PLAN_TIMES_S: Final = (3.0, 6.0, 9.0)
PICTURE_PX: Final = 128
EXPERT, NOISE, POLICY = 0, 1, 2  # who commanded a frame: values of `by`
POLICY_DRIVER: Final = "policy:"
"""What the name of a driver begins with that is a policy (DAgger); its hash follows."""
TOUR_DRIVER: Final = "tour"
"""The driver of what nobody drove: a robot that was carried along, with one picture a second."""
INDEX, DRIVES = "dataset.json", "drives"
FORMAT: Final = 1
VAL_EVERY: Final = 8  # one layout in so many is for validation
_KEY: Final = "drive"  # the file's one metadata key: with two, the writer's order would be left to chance
_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}", re.ASCII)
_ARRAYS: Final[Mapping[str, tuple[str, tuple[int, ...]]]] = {
    "jpeg_end": ("int64", ()),
    "pose": ("float64", (3,)),
    "pose_odom": ("float64", (3,)),
    "state": ("float32", (3,)),
    "future": ("float32", (FUTURE_STEPS, 3)),
    "future_steps": ("int16", ()),
    "plan_xy": ("float32", (len(PLAN_TIMES_S), 2)),
    "by": ("uint8", ()),
}


class DriveError(ValueError):
    """A drive or data set that cannot be used; one line: what, expected, found, what to do."""


@dataclass(frozen=True)
class About:
    """What holds for a whole drive.

    `driver`: expert, expert-noise, tour, policy:<sha of the artifacts' manifest>, or imported. `outcome`: how it ended
    (reached, fell, timeout, cut, imported). `told`: the steps of the told way, as LABELS' scenarios write them.
    `traces`: one a second, {k, situation, objects, motion, progress {step, steps, passed}, plan}.
    """

    id: str
    kind: str
    layout_seed: int
    scene: str
    robot: str
    people: int
    seed: int
    driver: str
    drift: str
    goal_xy: tuple[float, float]
    threshold_m: float
    outcome: str
    collided: bool
    wordings: tuple[str, ...]
    told: tuple[Mapping[str, Any], ...]
    traces: tuple[Mapping[str, Any], ...]

    def __post_init__(self) -> None:
        if not _ID.fullmatch(self.id):
            raise DriveError(f"drive {self.id!r}: an id is made of letters, digits, '-', '_' and '.'")
        at = [trace.get("k") for trace in self.traces]
        if at != [TRACE_EVERY * i for i in range(len(at))]:
            raise DriveError(f"drive {self.id}: expected a trace every {TRACE_EVERY} frames from 0 on, found {at[:4]}")

    @property
    def is_val(self) -> bool:
        """Whether it is for validation: by its layout, never by frame; the demo's corridor is for training."""
        return self.kind != "corridor" and crc32(f"{self.kind}-{self.layout_seed}".encode()) % VAL_EVERY == 0


@dataclass(frozen=True)
class Drive:
    """N frames at 10 Hz.

    `jpeg` uint8 [bytes], frame k ends before `jpeg_end[k]` (of a tour whole seconds alone have pictures); `pose`
    [N, 3] true T_world_base and `pose_odom` [N, 3] T_odom_base, m and rad; `state` [N, 3] vx m/s, vy m/s, wz rad/s by
    odometry; `future` [N, 50, 3] what the expert does, x m, y m, theta rad at 0.1 to 5.0 s in the robot's frame at k,
    of which the first `future_steps[k]` are known and the rest repeat the last one; `plan_xy` [N, 3, 2] where it means
    to be in 3, 6 and 9 s, m in the robot's frame; `by` [N] who commanded: EXPERT, NOISE or POLICY. `pose` and what is
    made of it is truth: no policy may see it.
    """

    about: About
    jpeg: NDArray[np.uint8]
    jpeg_end: NDArray[np.int64]
    pose: NDArray[np.float64]
    pose_odom: NDArray[np.float64]
    state: NDArray[np.float32]
    future: NDArray[np.float32]
    future_steps: NDArray[np.int16]
    plan_xy: NDArray[np.float32]
    by: NDArray[np.uint8]

    def __post_init__(self) -> None:
        what, count = f"drive {self.about.id}", len(self.jpeg_end)
        if count == 0:
            raise DriveError(f"{what}: expected frames, found none")
        for name, (kind, shape) in _ARRAYS.items():
            array = getattr(self, name)
            if array.shape != (count, *shape) or array.dtype != kind:
                raise DriveError(
                    f"{what}: {name}: expected {kind} {(count, *shape)}, found {array.dtype} {array.shape}"
                )
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                raise DriveError(f"{what}: {name} holds a number that is not finite")
        if self.jpeg.ndim != 1 or self.jpeg.dtype != np.uint8:
            raise DriveError(f"{what}: jpeg: expected uint8 [bytes], found {self.jpeg.dtype} {self.jpeg.shape}")
        lengths = np.diff(self.jpeg_end, prepend=0)
        if self.about.driver == TOUR_DRIVER:
            lengths = np.where(np.arange(count) % TRACE_EVERY, lengths + 1, lengths)
        if np.any(lengths <= 0) or (len(self.jpeg) and self.jpeg_end[-1] != len(self.jpeg)):
            raise DriveError(f"{what}: jpeg_end: expected growing ends up to {len(self.jpeg)}")
        if np.any((self.future_steps < 0) | (self.future_steps > FUTURE_STEPS)):
            raise DriveError(f"{what}: future_steps: expected 0 to {FUTURE_STEPS}")

    def __len__(self) -> int:
        return len(self.jpeg_end)

    @property
    def id(self) -> str:
        """Its name in the data set."""
        return self.about.id

    @property
    def wordings(self) -> tuple[str, ...]:
        """Instructions that say the same."""
        return self.about.wordings

    @property
    def traces(self) -> tuple[Mapping[str, Any], ...]:
        """One a second from frame 0 on; empty where nobody wrote any."""
        return self.about.traces

    def frame(self, k: int) -> NDArray[np.uint8]:
        """Picture k, uint8 RGB [128, 128, 3]. Raises DriveError without pictures or when one cannot be decoded."""
        if not len(self.jpeg):
            raise DriveError(f"drive {self.id}: was loaded without its pictures")
        k = self._index(k)
        start = int(self.jpeg_end[k - 1]) if k else 0
        if start == self.jpeg_end[k]:
            raise DriveError(f"drive {self.id}: there is no picture of frame {k}")
        picture = cv2.imdecode(self.jpeg[start : int(self.jpeg_end[k])], cv2.IMREAD_COLOR)
        if picture is None or picture.shape != (PICTURE_PX, PICTURE_PX, 3):
            raise DriveError(f"drive {self.id}: picture {k} is not a JPEG of {PICTURE_PX}x{PICTURE_PX}")
        return np.asarray(picture[..., ::-1].copy(), np.uint8)

    def T_world_base(self, k: int) -> SE2:  # noqa: N802  # a pose's name
        """True pose at frame k."""
        return SE2(*(float(v) for v in self.pose[self._index(k)]))

    def T_odom_base(self, k: int) -> SE2:  # noqa: N802  # a pose's name
        """Pose at frame k as odometry reported it."""
        return SE2(*(float(v) for v in self.pose_odom[self._index(k)]))

    def trace_at(self, k: int) -> Mapping[str, Any] | None:
        """The newest trace that was written at frame k or before; None where there is none."""
        index = self._index(k) // TRACE_EVERY
        return self.traces[index] if index < len(self.traces) else None

    def _index(self, k: int) -> int:
        if not 0 <= k < len(self):
            raise IndexError(f"drive {self.id}: expected a frame of 0 to {len(self) - 1}, found {k}")
        return int(k)

    def save(self, path: Path) -> None:
        """Write the file as a whole (under another name, then renamed). Raises OSError."""
        arrays = {name: np.ascontiguousarray(getattr(self, name)) for name in ("jpeg", *_ARRAYS)}
        partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
        text = json.dumps({"format": FORMAT, **asdict(self.about)}, sort_keys=True, separators=(",", ":"))
        save_file(arrays, partial, metadata={_KEY: text})
        partial.replace(path)

    @staticmethod
    def load(path: Path, *, pictures: bool = True) -> Drive:
        """A file that `save` has written, without its pictures if they are not needed. Raises DriveError."""
        try:
            with safe_open(path, framework="numpy") as file:
                about = _about(path, (file.metadata() or {}).get(_KEY, ""))
                arrays = {name: file.get_tensor(name) for name in _ARRAYS}
                jpeg = file.get_tensor("jpeg") if pictures else np.zeros(0, np.uint8)
        except (OSError, SafetensorError) as error:
            raise DriveError(f"{path}: not a readable drive ({error})") from error
        return Drive(about=about, jpeg=jpeg, **arrays)


def _about(path: Path, text: str) -> About:
    try:
        content = json.loads(text)
        if content.pop("format") != FORMAT:
            raise DriveError(f"{path}: expected a drive of format {FORMAT}; collect it again")
        if set(content) != {each.name for each in fields(About)}:
            raise DriveError(f"{path}: unknown or missing keys in its header, found {sorted(content)}")
        x, y = content["goal_xy"]
        tuples = {key: tuple(content[key]) for key in ("wordings", "told", "traces")}
        return About(**{**content, **tuples, "goal_xy": (float(x), float(y))})
    except DriveError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DriveError(f"{path}: its header is not of a drive") from error


@dataclass(frozen=True)
class Entry:
    """A drive as the index lists it: enough to choose by without opening the file."""

    id: str
    sha256: str
    bytes: int
    frames: int
    kind: str
    layout_seed: int
    robot: str
    driver: str
    outcome: str
    collided: bool
    val: bool

    @staticmethod
    def of(drive: Drive, path: Path) -> Entry:
        """Of a drive that has been saved there."""
        about = drive.about
        return Entry(
            about.id, file_sha256(path), path.stat().st_size, len(drive), about.kind, about.layout_seed, about.robot,
            about.driver, about.outcome, about.collided, about.is_val,
        )  # fmt: skip


@dataclass(frozen=True)
class Dataset:
    """The drives of a folder, sorted by id."""

    folder: Path
    entries: tuple[Entry, ...]

    @staticmethod
    def open(folder: Path, *, verify: bool = False) -> Dataset:
        """By its index; `verify` hashes every file. Raises DriveError."""
        path = folder / INDEX
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            if content["format"] != FORMAT:
                raise DriveError(f"{path}: expected format {FORMAT}; collect again")
            entries = tuple(Entry(**entry) for entry in content["drives"])
        except DriveError:
            raise
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DriveError(f"{path}: not the index of a data set ({error!r}); make one with collect") from error
        dataset = Dataset(folder, tuple(sorted(entries, key=lambda entry: entry.id)))
        if verify:
            for entry in dataset.entries:
                if not intact(dataset.path(entry.id), entry):
                    raise DriveError(f"{dataset.path(entry.id)}: not the file that the index lists; collect again")
        return dataset

    def __len__(self) -> int:
        return len(self.entries)

    @property
    def ids(self) -> tuple[str, ...]:
        """Of all drives, sorted."""
        return tuple(entry.id for entry in self.entries)

    @property
    def train(self) -> tuple[str, ...]:
        """Ids of the drives to learn from."""
        return tuple(entry.id for entry in self.entries if not entry.val)

    @property
    def val(self) -> tuple[str, ...]:
        """Ids of the drives in layouts that are never learned from."""
        return tuple(entry.id for entry in self.entries if entry.val)

    def of(self, *prefixes: str) -> Dataset:
        """The drives whose ids begin with one of these. Raises DriveError where there is none."""
        entries = tuple(entry for entry in self.entries if entry.id.startswith(prefixes))
        if not entries:
            raise DriveError(f"{self.folder}: no drives whose names begin with {' or '.join(prefixes)}; collect again")
        return Dataset(self.folder, entries)

    @property
    def sha256(self) -> str:
        """Of all drives: the same files give the same, in whatever order they were made."""
        lines = "".join(f"{entry.id} {entry.sha256}\n" for entry in self.entries)
        return hashlib.sha256(lines.encode()).hexdigest()

    def path(self, drive_id: str) -> Path:
        """Where a drive lies."""
        return self.folder / DRIVES / f"{drive_id}.safetensors"

    def load(self, drive_id: str, *, pictures: bool = True) -> Drive:
        """One drive. Raises DriveError."""
        return Drive.load(self.path(drive_id), pictures=pictures)

    def drives(self, ids: Sequence[str] | None = None, *, pictures: bool = True) -> Iterator[Drive]:
        """One after the other, all by default; no more than one is in memory."""
        for drive_id in self.ids if ids is None else ids:
            yield self.load(drive_id, pictures=pictures)


def file_sha256(path: Path) -> str:
    """Of a file's bytes. Raises OSError."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def intact(path: Path, entry: Entry) -> bool:
    """Whether the file is there and is the one that was listed."""
    return path.is_file() and path.stat().st_size == entry.bytes and file_sha256(path) == entry.sha256
