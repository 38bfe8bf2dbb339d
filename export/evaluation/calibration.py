"""Calibration data: named, hashed recordings of a robot that walks among people; never random.

A name is a shipped set of `calibration_sets/`, `folder:PATH` (the user's images, ordered by name) or `video:PATH`.
A user's pictures lack poses and velocities: these are assumed, and `Clip.assumed` names the assumptions.
"""

from __future__ import annotations

import hashlib
import itertools
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from edge.core.geometry import SE2
from edge.reasoning.prompt import InstructionError, check_instruction
from export.core.typed import FieldError, build
from export.evaluation.calibration_names import SETS, name_refusal
from firmware_bridge.system.input_file import open_regular, parse_toml, read_bytes

Picture = npt.NDArray[np.uint8]

CLIP_S = 20.0
"""Shortest clip, s: 9 s of frames before an anchor, 10 s of growing delay after it, 1 s to choose the anchor in."""
MAX_GAP_S = 1.5
MAX_CLIPS = 3
"""Largest number of clips from a user's folder or video: more take minutes at paper size and change no decision."""
MAX_SIDE_PX = 960
ASSUMED_SPEED_MPS = 0.5
ASSUMED_INSTRUCTION = "walk straight ahead"
IMAGE_SUFFIXES = (".bmp", ".jpeg", ".jpg", ".png", ".webp")


class CalibrationError(ValueError):
    """Calibration set that is unknown, unreadable or too short."""


@dataclass(frozen=True)
class Frame:
    """Picture, uint8 RGB [h, w, 3], with the robot's pose and velocity (vx m/s, vy m/s, ωz rad/s)."""

    stamp_ns: int
    image: Picture
    T_odom_base: SE2
    velocity: tuple[float, float, float]


@dataclass(frozen=True)
class Clip:
    """At least 20 s of frames about 1 s apart, oldest first, with the instruction of the walk."""

    name: str
    instruction: str
    frames: tuple[Frame, ...]
    assumed: str = ""
    """Assumptions in place of recorded values, as text; empty if all values were recorded."""

    def __post_init__(self) -> None:
        stamps = [frame.stamp_ns / 1e9 for frame in self.frames]
        gaps = [b - a for a, b in itertools.pairwise(stamps)]
        length_s = stamps[-1] - stamps[0] if stamps else 0.0
        if length_s < CLIP_S - 1e-6:
            raise CalibrationError(f"clip {self.name}: {length_s:.1f} s long, at least {CLIP_S:.0f} s are needed")
        if min(gaps) <= 0 or max(gaps) > MAX_GAP_S:
            raise CalibrationError(
                f"clip {self.name}: frames are {min(gaps):.2f} to {max(gaps):.2f} s apart, expected about 1 s"
            )
        try:
            check_instruction(self.instruction)
        except InstructionError as error:
            raise CalibrationError(f"clip {self.name}: {error}") from error


@dataclass(frozen=True)
class CalibrationSet:
    """Clips with the SHA-256 of all their files."""

    name: str
    """Name of a shipped set, or kind and base name of the user's (`folder:corridor`); never a path."""
    sha256: str
    clips: tuple[Clip, ...]

    def to_dict(self) -> dict[str, object]:
        """Return the manifest's entry: name, hash, counts and assumptions."""
        assumed = sorted({clip.assumed for clip in self.clips if clip.assumed})
        return {
            "name": self.name,
            "sha256": self.sha256,
            "clips": len(self.clips),
            "frames": sum(len(clip.frames) for clip in self.clips),
            "assumed": "; ".join(assumed),
        }


@dataclass(frozen=True)
class _FrameRow:
    file: str
    stamp_s: float
    pose: tuple[float, float, float]
    velocity: tuple[float, float, float]


@dataclass(frozen=True)
class _ClipRow:
    name: str
    instruction: str
    frames: tuple[_FrameRow, ...]


@dataclass(frozen=True)
class _SetFile:
    """set.toml of a calibration set."""

    schema: int
    name: str
    description: str
    clips: tuple[_ClipRow, ...]


def load_calibration(name: str) -> CalibrationSet:
    """Load a set by name, `folder:PATH` or `video:PATH`. Raises CalibrationError with a one-line message."""
    if (refusal := name_refusal(name)) is not None:
        raise CalibrationError(refusal)
    kind, colon, path = name.partition(":")
    if not colon:
        return read_set(SETS / name)
    load = _load_folder if kind == "folder" else _load_video
    return load(f"{kind}:{Path(os.path.realpath(path)).name}", Path(path))


def read_set(directory: Path) -> CalibrationSet:
    """Read a set from its directory, which holds set.toml and its pictures only. Raises CalibrationError."""
    where = f"calibration set {directory.name}"
    try:
        contents = {path.name: path.read_bytes() for path in sorted(directory.iterdir())}
        listing = build(_SetFile, parse_toml(contents["set.toml"].decode("utf-8")), where)
    except FieldError as error:
        raise CalibrationError(str(error)) from error
    except (OSError, KeyError, ValueError) as error:
        raise CalibrationError(f"{where}: set.toml cannot be read ({error})") from error
    if listing.schema != 1 or listing.name != directory.name or not listing.clips:
        raise CalibrationError(f"{where}: expected schema 1, the directory's name and a list of clips")
    clips = []
    for clip in listing.clips:
        frames = []
        for row in clip.frames:
            if row.file not in contents:
                raise CalibrationError(f"{where}: {row.file} is missing")
            image = _decode(contents[row.file], f"{where}: {row.file}")
            frames.append(Frame(round(row.stamp_s * 1e9), image, SE2(*row.pose), row.velocity))
        clips.append(Clip(clip.name, clip.instruction, tuple(frames)))
    other = sorted(set(contents) - {row.file for clip in listing.clips for row in clip.frames} - {"set.toml"})
    if other:
        raise CalibrationError(f"{where}: holds files that set.toml does not list: {', '.join(other[:3])}")
    return CalibrationSet(directory.name, _hash(contents), tuple(clips))


def _hash(contents: dict[str, bytes]) -> str:
    """Hash of files in the order of their names."""
    digest = hashlib.sha256()
    for name, data in sorted(contents.items()):
        digest.update(f"{name}\0{len(data)}\0".encode())
        digest.update(data)
    return digest.hexdigest()


def _decode(data: bytes, where: str) -> Picture:
    try:
        bgr = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    except cv2.error:  # a size beyond OpenCV's limit, or more memory than there is
        bgr = None
    if bgr is None:
        raise CalibrationError(f"{where} is not a readable image")
    return _rgb(bgr)


def _rgb(bgr: npt.NDArray[Any]) -> Picture:
    """Convert to RGB of at most MAX_SIDE_PX a side: full camera pictures of a minute would take gigabytes."""
    scale = MAX_SIDE_PX / max(bgr.shape[:2])
    if scale < 1:
        size = (max(1, round(bgr.shape[1] * scale)), max(1, round(bgr.shape[0] * scale)))
        bgr = cv2.resize(bgr, size, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _windows(count: int, where: str) -> list[range]:
    """Return up to MAX_CLIPS ranges of 20 s, spread over `count` pictures 1 s apart."""
    length = round(CLIP_S) + 1
    if count < length:
        raise CalibrationError(f"{where}: {count} pictures 1 s apart, at least {length} are needed")
    clips = min(MAX_CLIPS, count // length)
    starts = [round(i * (count - length) / max(1, clips - 1)) for i in range(clips)]
    return [range(start, start + length) for start in starts]


def _assumed_clip(name: str, images: list[Picture], stamps: str) -> Clip:
    frames = tuple(
        Frame(i * 1_000_000_000, image, SE2(i * ASSUMED_SPEED_MPS, 0.0, 0.0), (ASSUMED_SPEED_MPS, 0.0, 0.0))
        for i, image in enumerate(images)
    )
    assumed = f"a straight walk at {ASSUMED_SPEED_MPS:g} m/s{stamps}, instruction {ASSUMED_INSTRUCTION!r}"
    return Clip(name, ASSUMED_INSTRUCTION, frames, assumed)


def _load_folder(name: str, folder: Path) -> CalibrationSet:
    where = f"calibration folder {folder}"
    try:
        paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file())
        digest, images = hashlib.sha256(), {}
        used = [i for window in _windows(len(paths), where) for i in window]
        for index, path in enumerate(paths):
            data = read_bytes(path)  # a sparse file of terabytes costs its writer nothing
            digest.update(f"{path.name}\0{len(data)}\0".encode())
            digest.update(data)
            if index in used:
                images[index] = _decode(data, f"{where}: {path.name}")
    except OSError as error:
        raise CalibrationError(f"{where} cannot be read ({error.strerror})") from error
    clips = [
        _assumed_clip(f"images-{window.start}", [images[i] for i in window], " with 1 s between images")
        for window in _windows(len(paths), where)
    ]
    return CalibrationSet(name, digest.hexdigest(), tuple(clips))


def _load_video(name: str, path: Path) -> CalibrationSet:
    where = f"calibration video {path}"
    digest = hashlib.sha256()
    try:
        with open_regular(path) as file:  # a FIFO would wait and /dev/zero never end
            while block := file.read(1 << 20):
                digest.update(block)
    except OSError as error:
        raise CalibrationError(f"{where} cannot be read ({error.strerror})") from error
    images = _video_frames(path, where)
    clips = [_assumed_clip(f"video-{w.start}s", [images[i] for i in w], "") for w in _windows(len(images), where)]
    return CalibrationSet(name, digest.hexdigest(), tuple(clips))


def _video_frames(path: Path, where: str) -> list[Picture]:
    """Read one picture per second of the video's first ten minutes."""
    capture = cv2.VideoCapture(str(path))
    try:
        fps = capture.get(cv2.CAP_PROP_FPS) if capture.isOpened() else 0.0
        if not 0.5 <= fps <= 1000.0:
            raise CalibrationError(f"{where} is not a readable video")
        images: list[Picture] = []
        index = 0
        while len(images) < 600 and capture.grab():
            # Grab every picture in sequence: the frame that seeking reaches depends on the codec.
            if index >= len(images) * fps:
                ok, bgr = capture.retrieve()
                if not ok:
                    break
                images.append(_rgb(bgr))
            index += 1
    finally:
        capture.release()
    return images
