"""Recorded drives (images, poses, labels and texts in one file each) and data sets, which are folders of drives.

A drive is `drives/ID.safetensors`: arrays over N frames at 10 Hz, and a JSON header with the properties of the whole
drive. `dataset.json` lists the drives with the hash of each file (written by `tools.train.drives.dataset`).
"""

from __future__ import annotations

import hashlib
import json
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
from export.core.tensor_file import replacing
from firmware_bridge.system.input_file import read_json
from tools.train.config.checks import TrainError
from tools.train.config.collect import TRACE_EVERY

FUTURE_STEPS: Final = 50
"""Labelled future poses of a frame, 0.1 s apart."""
PLAN_TIMES_S: Final = (3.0, 6.0, 9.0)
"""Times of the expert's waypoints, s."""
PICTURE_PX: Final = 128
"""Width and height of a recorded image, px."""
EXPERT, NOISE, POLICY = 0, 1, 2
"""Source of a frame's command: values of `Drive.by`."""
POLICY_DRIVER: Final = "policy:"
"""Prefix of the driver's name in a policy's drive (DAgger); the policy's hash follows."""
TOUR_DRIVER: Final = "tour"
"""Driver's name in a tour: no physics, one image per second."""
INDEX, DRIVES = "dataset.json", "drives"
FORMAT: Final = 1
VAL_EVERY: Final = 8  # one layout in this many is held out for validation
_KEY: Final = "drive"  # the file's only metadata key: the order of several keys would not be reproducible
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


@dataclass(frozen=True)
class About:
    """Properties of a whole drive.

    `driver`: expert, expert-noise, tour, policy:<hash of the artifacts' manifest>, or imported. `outcome`: reached,
    fell, timeout, cut or imported. `told`: steps of the described route (`Scenario.steps_json`). `traces`: one per
    second, {k, situation, objects, motion, progress {step, steps, passed}, plan}.
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
            raise TrainError(f"drive {self.id!r}: expected an id of letters, digits, '-', '_' and '.'")
        at = [trace.get("k") for trace in self.traces]
        if at != [TRACE_EVERY * i for i in range(len(at))]:
            raise TrainError(f"drive {self.id}: expected a trace every {TRACE_EVERY} frames from 0 on, found {at[:4]}")

    @property
    def is_val(self) -> bool:
        """Whether the drive is for validation, which depends on its layout; the demo's corridor is for training."""
        return self.kind != "corridor" and crc32(f"{self.kind}-{self.layout_seed}".encode()) % VAL_EVERY == 0


@dataclass(frozen=True)
class Drive:
    """A drive of N frames at 10 Hz.

    - `jpeg` uint8 [bytes]: image k ends before `jpeg_end[k]`; a tour has images at whole seconds alone.
    - `pose` [N, 3]: true T_world_base; `pose_odom` [N, 3]: T_odom_base; m and rad.
    - `state` [N, 3]: vx m/s, vy m/s, wz rad/s from odometry.
    - `future` [N, 50, 3]: the expert's poses (x m, y m, theta rad) at 0.1 to 5.0 s in the robot frame at k; the first
      `future_steps[k]` are known, the rest repeat the last known one.
    - `plan_xy` [N, 3, 2]: the expert's planned positions in 3, 6 and 9 s, m in the robot frame.
    - `by` [N]: source of the command: EXPERT, NOISE or POLICY.

    `pose`, `future` and `plan_xy` are ground truth: no policy may use them as input.
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
            raise TrainError(f"{what}: expected frames, found none")
        for name, (kind, shape) in _ARRAYS.items():
            array = getattr(self, name)
            if array.shape != (count, *shape) or array.dtype != kind:
                raise TrainError(
                    f"{what}: {name}: expected {kind} {(count, *shape)}, found {array.dtype} {array.shape}"
                )
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                raise TrainError(f"{what}: {name} holds a number that is not finite")
        if self.jpeg.ndim != 1 or self.jpeg.dtype != np.uint8:
            raise TrainError(f"{what}: jpeg: expected uint8 [bytes], found {self.jpeg.dtype} {self.jpeg.shape}")
        lengths = np.diff(self.jpeg_end, prepend=0)
        if self.about.driver == TOUR_DRIVER:
            lengths = np.where(np.arange(count) % TRACE_EVERY, lengths + 1, lengths)
        if np.any(lengths <= 0) or (len(self.jpeg) and self.jpeg_end[-1] != len(self.jpeg)):
            raise TrainError(f"{what}: jpeg_end: expected increasing values up to {len(self.jpeg)}")
        if np.any((self.future_steps < 0) | (self.future_steps > FUTURE_STEPS)):
            raise TrainError(f"{what}: future_steps: expected 0 to {FUTURE_STEPS}")

    def __len__(self) -> int:
        return len(self.jpeg_end)

    @property
    def id(self) -> str:
        """The drive's id in the data set."""
        return self.about.id

    @property
    def wordings(self) -> tuple[str, ...]:
        """Instructions with the same meaning."""
        return self.about.wordings

    @property
    def traces(self) -> tuple[Mapping[str, Any], ...]:
        """Traces at every second from frame 0 on; empty if the drive has none."""
        return self.about.traces

    def frame(self, k: int) -> NDArray[np.uint8]:
        """Decode image k as uint8 RGB [128, 128, 3]. Raises TrainError without images or if decoding fails."""
        if not len(self.jpeg):
            raise TrainError(f"drive {self.id}: was loaded without its images")
        k = self._index(k)
        start = int(self.jpeg_end[k - 1]) if k else 0
        if start == self.jpeg_end[k]:
            raise TrainError(f"drive {self.id}: frame {k} has no image")
        picture = cv2.imdecode(self.jpeg[start : int(self.jpeg_end[k])], cv2.IMREAD_COLOR)
        if picture is None or picture.shape != (PICTURE_PX, PICTURE_PX, 3):
            raise TrainError(f"drive {self.id}: image {k} is not a JPEG of {PICTURE_PX}x{PICTURE_PX}")
        return np.asarray(picture[..., ::-1].copy(), np.uint8)

    def T_world_base(self, k: int) -> SE2:  # noqa: N802  # a pose's name
        """Return the true pose at frame k."""
        return SE2(*(float(v) for v in self.pose[self._index(k)]))

    def T_odom_base(self, k: int) -> SE2:  # noqa: N802  # a pose's name
        """Return the odometry's pose at frame k."""
        return SE2(*(float(v) for v in self.pose_odom[self._index(k)]))

    def trace_at(self, k: int) -> Mapping[str, Any] | None:
        """Return the newest trace at or before frame k; None if there is none."""
        index = self._index(k) // TRACE_EVERY
        return self.traces[index] if index < len(self.traces) else None

    def _index(self, k: int) -> int:
        if not 0 <= k < len(self):
            raise IndexError(f"drive {self.id}: expected a frame of 0 to {len(self) - 1}, found {k}")
        return int(k)

    def save(self, path: Path) -> None:
        """Write the file atomically. Raises OSError."""
        arrays = {name: np.ascontiguousarray(getattr(self, name)) for name in ("jpeg", *_ARRAYS)}
        text = json.dumps({"format": FORMAT, **asdict(self.about)}, sort_keys=True, separators=(",", ":"))
        with replacing(path) as partial:
            save_file(arrays, partial, metadata={_KEY: text})

    @staticmethod
    def load(path: Path, *, pictures: bool = True) -> Drive:
        """Read a file that `save` wrote; `pictures` False leaves the images out. Raises TrainError."""
        try:
            with safe_open(path, framework="numpy") as file:
                about = _about(path, (file.metadata() or {}).get(_KEY, ""))
                arrays = {name: file.get_tensor(name) for name in _ARRAYS}
                jpeg = file.get_tensor("jpeg") if pictures else np.zeros(0, np.uint8)
        except (OSError, SafetensorError) as error:
            raise TrainError(f"{path}: not a readable drive ({error})") from error
        return Drive(about=about, jpeg=jpeg, **arrays)


def _about(path: Path, text: str) -> About:
    try:
        content = json.loads(text)
        if content.pop("format") != FORMAT:
            raise TrainError(f"{path}: expected a drive of format {FORMAT}; record it again")
        if set(content) != {each.name for each in fields(About)}:
            raise TrainError(f"{path}: unknown or missing keys in its header, found {sorted(content)}")
        x, y = content["goal_xy"]
        tuples = {key: tuple(content[key]) for key in ("wordings", "told", "traces")}
        return About(**{**content, **tuples, "goal_xy": (float(x), float(y))})
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise TrainError(f"{path}: the header is not a drive's") from error


@dataclass(frozen=True)
class Entry:
    """Index entry of a drive: its hash and properties, readable without the file."""

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
        """Build the entry of a drive that was saved at `path`."""
        about = drive.about
        return Entry(
            about.id, file_sha256(path), path.stat().st_size, len(drive), about.kind, about.layout_seed, about.robot,
            about.driver, about.outcome, about.collided, about.is_val,
        )  # fmt: skip


@dataclass(frozen=True)
class Dataset:
    """Drives of a folder, sorted by id."""

    folder: Path
    entries: tuple[Entry, ...]

    @staticmethod
    def open(folder: Path, *, verify: bool = False) -> Dataset:
        """Read the index of a folder; `verify` also checks the hash of every file. Raises TrainError."""
        path = folder / INDEX
        try:
            content = read_json(path)
            if content["format"] != FORMAT:
                raise TrainError(f"{path}: expected format {FORMAT}; collect again")
            entries = tuple(Entry(**entry) for entry in content["drives"])
        except TrainError:
            raise
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise TrainError(f"{path}: not the index of a data set ({error!r}); record one with collect") from error
        dataset = Dataset(folder, tuple(sorted(entries, key=lambda entry: entry.id)))
        if verify:
            for entry in dataset.entries:
                if not intact(dataset.path(entry.id), entry):
                    raise TrainError(f"{dataset.path(entry.id)}: differs from the indexed file; collect again")
        return dataset

    def __len__(self) -> int:
        return len(self.entries)

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids of all drives, sorted."""
        return tuple(entry.id for entry in self.entries)

    @property
    def train(self) -> tuple[str, ...]:
        """Ids of the training drives."""
        return tuple(entry.id for entry in self.entries if not entry.val)

    @property
    def val(self) -> tuple[str, ...]:
        """Ids of the validation drives, whose layouts have no training drive."""
        return tuple(entry.id for entry in self.entries if entry.val)

    def of(self, *prefixes: str) -> Dataset:
        """Return the drives whose ids begin with one of `prefixes`. Raises TrainError if there are none."""
        entries = tuple(entry for entry in self.entries if entry.id.startswith(prefixes))
        if not entries:
            raise TrainError(
                f"{self.folder}: no drives with ids that begin with {' or '.join(prefixes)}; collect again"
            )
        return Dataset(self.folder, entries)

    @property
    def sha256(self) -> str:
        """Hash of all drives; it does not depend on the order of recording."""
        lines = "".join(f"{entry.id} {entry.sha256}\n" for entry in self.entries)
        return hashlib.sha256(lines.encode()).hexdigest()

    def path(self, drive_id: str) -> Path:
        """Return the path of a drive's file."""
        return self.folder / DRIVES / f"{drive_id}.safetensors"

    def load(self, drive_id: str, *, pictures: bool = True) -> Drive:
        """Load one drive. Raises TrainError."""
        return Drive.load(self.path(drive_id), pictures=pictures)

    def drives(self, ids: Sequence[str] | None = None, *, pictures: bool = True) -> Iterator[Drive]:
        """Yield drives one after the other, by default all; only one is in memory."""
        for drive_id in self.ids if ids is None else ids:
            yield self.load(drive_id, pictures=pictures)


def file_sha256(path: Path) -> str:
    """Hash a file's content. Raises OSError."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def intact(path: Path, entry: Entry) -> bool:
    """Return whether a file exists with the size and hash of its entry."""
    return path.is_file() and path.stat().st_size == entry.bytes and file_sha256(path) == entry.sha256
