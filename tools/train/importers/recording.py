"""A real robot's recording, independent of its file format: image stamps, poses, and texts."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.core.jpeg import MAX_BYTES, jpeg_refusal
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

    `words`: texts by number of the 20 s episode.
    """

    name: str
    stamps_s: NDArray[np.float64]
    pictures: tuple[Path, ...]
    poses: NDArray[np.float64]
    words: Mapping[int, Texts]

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
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise TrainError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        if isinstance(error, TrainError):
            raise
        raise TrainError(f"{path}: not JSON ({error})") from error


def read_words(folder: Path) -> dict[int, Texts]:
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
