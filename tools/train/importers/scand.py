"""Reader of SCAND (Karnan et al. 2022): bags extracted to one folder per recording.

RECORDING/image/STAMP.jpg     front camera, STAMP in whole nanoseconds; .jpeg and .png are read as well
RECORDING/odometry.csv        columns stamp_ns, x_m, y_m, theta_rad (in any order, others are left alone)
RECORDING/texts.json          optional, see `tools.train.importers.recording`
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Final

import numpy as np

from tools.train.config.checks import TrainError
from tools.train.importers.recording import Recording, read_words

KIND: Final = "scand"
PICTURES, POSES = "image", "odometry.csv"
_COLUMNS: Final = ("stamp_ns", "x_m", "y_m", "theta_rad")
_SUFFIXES: Final = (".jpg", ".jpeg", ".png")


def is_recording(folder: Path) -> bool:
    """Return whether a folder has the files of a SCAND recording."""
    return (folder / PICTURES).is_dir() and (folder / POSES).is_file()


def read(folder: Path) -> Recording:
    """Read one recording. Raises TrainError."""
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
        words=read_words(folder),
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
        if isinstance(error, TrainError):
            raise
        raise TrainError(f"{path}: a row is not of numbers ({error})") from error
    return sorted(rows)
