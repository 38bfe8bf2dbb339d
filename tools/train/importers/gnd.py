"""Reader of GND (Liang et al. 2025): bags extracted to one folder per recording, poses in its lidar map.

RECORDING/recording.json      {"frames": [{"stamp_s", "file"}], "poses": [{"stamp_s", "position_m", "quaternion_xyzw"}]}
RECORDING/…                   the pictures that it names, JPEG or PNG, by paths below the recording's folder
RECORDING/texts.json          optional, see `tools.train.importers.recording`

Poses are three-dimensional; only the position on the ground and the heading of the x axis are used.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import atan2
from pathlib import Path, PurePosixPath
from typing import Any, Final

import numpy as np

from tools.train.config.checks import TrainError
from tools.train.importers.recording import Recording, read_json, read_words

KIND: Final = "gnd"
TABLE: Final = "recording.json"
_UNIT: Final = 0.01  # tolerance of a quaternion's squared length


def is_recording(folder: Path) -> bool:
    """Return whether a folder has the files of a GND recording."""
    return (folder / TABLE).is_file()


def read(folder: Path) -> Recording:
    """Read one recording. Raises TrainError."""
    path = folder / TABLE
    content = read_json(path)
    try:
        if set(content) != {"frames", "poses"}:
            raise TrainError(f"{path}: expected the keys frames and poses, found {sorted(content)}")
        frames = sorted((_number(each["stamp_s"]), _below(folder, each["file"])) for each in content["frames"])
        poses = sorted(_pose(path, each) for each in content["poses"])
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, TrainError):
            raise
        raise TrainError(f"{path}: a frame or pose lacks or misshapes a key ({error!r})") from error
    if not frames or not poses:
        raise TrainError(f"{path}: expected frames and poses")
    first_s = min(frames[0][0], poses[0][0])
    return Recording(
        name=folder.name,
        stamps_s=np.array([stamp_s - first_s for stamp_s, _ in frames]),
        pictures=tuple(picture for _, picture in frames),
        poses=np.array([(stamp_s - first_s, *pose) for stamp_s, *pose in poses], np.float64),
        words=read_words(folder),
    )


def _number(value: object) -> float:
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
    x, y, _ = (_number(value) for value in table["position_m"])
    qx, qy, qz, qw = (_number(value) for value in table["quaternion_xyzw"])
    if abs(qx * qx + qy * qy + qz * qz + qw * qw - 1.0) > _UNIT:
        raise TrainError(f"{path}: expected quaternions of length 1, found {[qx, qy, qz, qw]}")
    heading = atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
    return (_number(table["stamp_s"]), x, y, heading)
