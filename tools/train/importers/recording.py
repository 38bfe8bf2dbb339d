"""Recordings of real robots: image stamps, poses and texts, independent of the file format, and readers of two formats.

SCAND (Karnan et al. 2022), bags extracted to one folder per recording:
RECORDING/image/STAMP.jpg     front camera, STAMP in whole nanoseconds; .jpeg and .png are read as well
RECORDING/odometry.csv        columns stamp_ns, x_m, y_m, theta_rad (in any order, others are ignored)

GND (Liang et al. 2025), poses in its lidar map; only the position on the ground and the heading of the x axis are used:
RECORDING/recording.json      {"frames": [{"stamp_s", "file"}], "poses": [{"stamp_s", "position_m", "quaternion_xyzw"}]}
RECORDING/…                   the pictures that it names, JPEG or PNG, by paths below the recording's folder

Both: RECORDING/texts.json, optional (`read_texts`).
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import atan2
from pathlib import Path, PurePosixPath
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.core.jpeg import MAX_BYTES, jpeg_refusal
from firmware_bridge.system import input_file
from tools.train.config.checks import TrainError
from tools.train.drives.trace_sentences import aspects_of_json

TEXTS: Final = "texts.json"
MAX_TABLE_BYTES: Final = 200_000_000
_TRACE_KEYS: Final = frozenset(("situation", "objects", "motion", "progress", "plan"))
_JPEG = (".jpg", ".jpeg")


@dataclass(frozen=True)
class Texts:
    """Texts of one episode of 20 s: instructions with the same meaning, and one trace per second."""

    wordings: tuple[str, ...] = ()
    traces: tuple[Mapping[str, Any], ...] = ()


@dataclass(frozen=True)
class Recording:
    """A recording in order of time: `stamps_s` [p] and `pictures` [p]; `poses` [n, 4] (stamp s, x m, y m, theta rad).

    `texts`: texts by number of the 20 s episode.
    """

    name: str
    stamps_s: NDArray[np.float64]
    pictures: tuple[Path, ...]
    poses: NDArray[np.float64]
    texts: Mapping[int, Texts]

    def __post_init__(self) -> None:
        what = f"recording {self.name}"
        if self.stamps_s.shape != (len(self.pictures),) or self.poses.ndim != 2 or self.poses.shape[1] != 4:
            raise TrainError(f"{what}: expected a stamp a picture and poses [n, 4]")
        if len(self.pictures) < 2 or len(self.poses) < 2:
            raise TrainError(f"{what}: expected two pictures and two poses or more")
        if not (np.isfinite(self.stamps_s).all() and np.isfinite(self.poses).all()):
            raise TrainError(f"{what}: a stamp or pose is not finite")
        if np.any(np.diff(self.stamps_s) <= 0) or np.any(np.diff(self.poses[:, 0]) <= 0):
            raise TrainError(f"{what}: expected increasing stamps of pictures and of poses")


def read_picture(path: Path) -> NDArray[np.uint8]:
    """Read a JPEG or PNG as uint8 RGB [height, width, 3]. Raises TrainError."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise TrainError(f"{path}: expected at most {MAX_BYTES} bytes")
        data = path.read_bytes()
    except OSError as error:
        raise TrainError(f"{path}: cannot be read ({error.strerror})") from error
    if path.suffix.lower() in _JPEG and (why := jpeg_refusal(data)) is not None:
        raise TrainError(f"{path}: {why}")
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise TrainError(f"{path}: expected a JPEG or PNG image")
    return np.asarray(picture[..., ::-1], np.uint8)


def read_json(path: Path) -> Any:
    """Read a JSON file. Raises TrainError."""
    try:
        if path.stat().st_size > MAX_TABLE_BYTES:
            raise TrainError(f"{path}: more than {MAX_TABLE_BYTES} bytes")
        return input_file.read_json(path)
    except OSError as error:
        raise TrainError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise TrainError(f"{path}: not JSON ({error})") from error


def read_texts(folder: Path) -> dict[int, Texts]:
    """`texts.json` of a recording, if it has one: `{"0": {"wordings": [texts], "traces": [20 tables]}, …}` by episode.

    `traces` may be left out; a trace is {situation, objects, motion, progress {step, steps, passed}, plan}, each in the
    phrases of `edge/state/reasoning_text.py`.
    """
    path = folder / TEXTS
    if not path.exists():
        return {}
    content = read_json(path)
    if not isinstance(content, Mapping):
        raise TrainError(f"{path}: expected a table by number of the episode")
    return {_number(path, key): _words(f"{path}: {key}", value) for key, value in content.items()}


def _number(path: Path, key: str) -> int:
    if not (key.isascii() and key.isdigit()):
        raise TrainError(f"{path}: expected the number of an episode, found {key!r}")
    return int(key)


def _words(where: str, value: object) -> Texts:
    if not isinstance(value, Mapping) or not {"wordings"} <= set(value) <= {"wordings", "traces"}:
        raise TrainError(f"{where}: expected wordings and traces")
    wordings, traces = value["wordings"], value.get("traces", [])
    if not isinstance(wordings, list) or not all(isinstance(text, str) and text.strip() for text in wordings):
        raise TrainError(f"{where}: expected wordings to be a list of texts")
    if not isinstance(traces, list) or not all(isinstance(t, Mapping) and set(t) == _TRACE_KEYS for t in traces):
        raise TrainError(f"{where}: expected each trace to have {', '.join(sorted(_TRACE_KEYS))}")
    for trace in traces:
        try:
            aspects_of_json(trace)
        except (ValueError, KeyError, TypeError) as error:
            raise TrainError(f"{where}: {error}") from error
    return Texts(tuple(wordings), tuple(dict(trace) for trace in traces))


# SCAND

PICTURES, POSES = "image", "odometry.csv"
_COLUMNS: Final = ("stamp_ns", "x_m", "y_m", "theta_rad")
_SUFFIXES: Final = (".jpg", ".jpeg", ".png")


def read_scand(folder: Path) -> Recording:
    """Read one recording of SCAND. Raises TrainError."""
    pictures = sorted((_stamp(path), path) for path in (folder / PICTURES).iterdir() if path.suffix in _SUFFIXES)
    rows = _rows(folder / POSES)
    if not pictures or not rows:
        raise TrainError(f"{folder}: expected pictures in {PICTURES}/ and rows in {POSES}")
    # Subtract whole nanoseconds first: floats cannot represent them exactly.
    first_ns = min(pictures[0][0], rows[0][0])
    return Recording(
        name=folder.name,
        stamps_s=np.array([(stamp_ns - first_ns) / 1e9 for stamp_ns, _ in pictures]),
        pictures=tuple(path for _, path in pictures),
        poses=np.array([((stamp_ns - first_ns) / 1e9, *pose) for stamp_ns, *pose in rows], np.float64),
        texts=read_texts(folder),
    )


def _stamp(path: Path) -> int:
    if not (path.stem.isascii() and path.stem.isdigit()):
        raise TrainError(f"{path}: expected a name in whole nanoseconds, such as 1636492800123456789.jpg")
    return int(path.stem)


def _rows(path: Path) -> list[tuple[int, float, float, float]]:
    try:
        with path.open(encoding="utf-8", newline="") as file:
            table = csv.DictReader(file)
            if missing := [name for name in _COLUMNS if name not in (table.fieldnames or ())]:
                raise TrainError(f"{path}: column {missing[0]} is missing; expected {', '.join(_COLUMNS)}")
            rows = [
                (int(row["stamp_ns"]), float(row["x_m"]), float(row["y_m"]), float(row["theta_rad"])) for row in table
            ]
    except OSError as error:
        raise TrainError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, TypeError, csv.Error) as error:
        raise TrainError(f"{path}: a row is not of numbers ({error})") from error
    return sorted(rows)


# GND

TABLE: Final = "recording.json"
_UNIT: Final = 0.01  # tolerance of a quaternion's squared length


def read_gnd(folder: Path) -> Recording:
    """Read one recording of GND. Raises TrainError."""
    path = folder / TABLE
    content = read_json(path)
    try:
        if set(content) != {"frames", "poses"}:
            raise TrainError(f"{path}: expected the keys frames and poses, found {sorted(content)}")
        frames = sorted((_float(each["stamp_s"]), _below(folder, each["file"])) for each in content["frames"])
        poses = sorted(_pose(path, each) for each in content["poses"])
    except (KeyError, TypeError, ValueError) as error:
        raise TrainError(f"{path}: a frame or pose lacks or misshapes a key ({error!r})") from error
    if not frames or not poses:
        raise TrainError(f"{path}: expected frames and poses")
    first_s = min(frames[0][0], poses[0][0])
    return Recording(
        name=folder.name,
        stamps_s=np.array([stamp_s - first_s for stamp_s, _ in frames]),
        pictures=tuple(picture for _, picture in frames),
        poses=np.array([(stamp_s - first_s, *pose) for stamp_s, *pose in poses], np.float64),
        texts=read_texts(folder),
    )


def _float(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"expected a number, found {value!r}")
    return float(value)


def _below(folder: Path, name: str) -> Path:
    """Return the path of a file inside the recording's folder. Raises TrainError for one outside."""
    plain = PurePosixPath(name)
    if plain.is_absolute() or ".." in plain.parts:
        raise TrainError(f"{folder / TABLE}: {name!r} is not a path below the recording")
    return folder / plain


def _pose(path: Path, table: Mapping[str, Any]) -> tuple[float, float, float, float]:
    x, y, _ = (_float(value) for value in table["position_m"])
    qx, qy, qz, qw = (_float(value) for value in table["quaternion_xyzw"])
    if abs(qx * qx + qy * qy + qz * qz + qw * qw - 1.0) > _UNIT:
        raise TrainError(f"{path}: expected quaternions of length 1, found {[qx, qy, qz, qw]}")
    heading = atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
    return (_float(table["stamp_s"]), x, y, heading)


@dataclass(frozen=True)
class Layout:
    """Format of a recording's folder: the files that it has, and their reader."""

    files: tuple[str, ...]
    read: Callable[[Path], Recording]

    def fits(self, folder: Path) -> bool:
        """Return whether a folder has the files of this format."""
        return all((folder / name).exists() for name in self.files)


LAYOUTS: Final[Mapping[str, Layout]] = {
    "scand": Layout((PICTURES, POSES), read_scand),
    "gnd": Layout((TABLE,), read_gnd),
}
