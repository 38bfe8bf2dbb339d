"""Conversion of a recording to drives: resampled at 10 Hz and cut into episodes of 20 s (paper appendix B)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final
from zlib import crc32

import cv2
import numpy as np
from numpy.typing import NDArray

from tools.train.config.checks import TrainError
from tools.train.config.collect import RATE_HZ, TRACE_EVERY
from tools.train.drives.drive import EXPERT, FUTURE_STEPS, PICTURE_PX, PLAN_TIMES_S, About, Drive
from tools.train.drives.futures import driven_future, relative
from tools.train.importers.recording import Recording, Texts, read_picture

Array = NDArray[np.float64]

EPISODE_S: Final = 20.0
"""Length of an imported episode, s (paper appendix B)."""
FRAMES: Final = round(EPISODE_S * RATE_HZ)
PICTURE_GAP_S: Final = 0.25  # largest age of an image at an instant; older ones are a gap of the recording
POSE_GAP_S: Final = 0.25  # largest time between two poses; more is a gap of the recording
QUALITY: Final = 90
THRESHOLD_M: Final = 1.5
_STEP_S: Final = 1 / RATE_HZ
_ROUNDING: Final = 1e-4  # tolerance of an instant: stamps since 1970 as float seconds are exact to 0.25 µs


@dataclass(frozen=True)
class Piece:
    """Part of a recording without gaps, at 10 Hz: index of the newest image [n], pose [n, 3] and body velocity over the
    previous 0.1 s [n, 3] of each instant."""

    picture: NDArray[np.int64]
    pose: Array
    state: Array


def pieces(recording: Recording) -> list[Piece]:
    """Resample a recording at 10 Hz and cut it at its gaps. No instant uses a later image."""
    stamps, stamps_of_poses = recording.stamps_s, recording.poses[:, 0]
    start, end = max(stamps[0], stamps_of_poses[0] + _STEP_S), min(stamps[-1], stamps_of_poses[-1])
    times = start + np.arange(max(0, int(np.floor((end - start) * RATE_HZ + _ROUNDING)) + 1)) / RATE_HZ
    picture = np.searchsorted(stamps, times + _ROUNDING / RATE_HZ, side="right") - 1
    whole = times - stamps[picture] <= PICTURE_GAP_S
    for moments in (times, times - _STEP_S):
        after = np.clip(np.searchsorted(stamps_of_poses, moments), 1, len(stamps_of_poses) - 1)
        whole &= stamps_of_poses[after] - stamps_of_poses[after - 1] <= POSE_GAP_S
    pose, before = _poses_at(recording.poses, times), _poses_at(recording.poses, times - _STEP_S)
    state = np.array([relative(a, b)[0] for a, b in zip(before, pose, strict=True)]).reshape(-1, 3) * RATE_HZ
    edges = np.flatnonzero(np.diff(np.concatenate(((False,), whole, (False,))).astype(np.int8)))
    return [
        Piece(picture[a:b], pose[a:b], state[a:b])
        for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
    ]


def _poses_at(poses: Array, times: Array) -> Array:
    """Interpolate the poses [p, 4] of a recording at instants [n], s: [n, 3]; headings take the shorter direction."""
    heading = np.unwrap(poses[:, 3])
    found = [np.interp(times, poses[:, 0], column) for column in (poses[:, 1], poses[:, 2], heading)]
    return np.stack((found[0], found[1], (found[2] + np.pi) % (2 * np.pi) - np.pi), axis=1)


def drives(recording: Recording, kind: str, robot: str) -> Iterator[Drive]:
    """Yield episodes of 20 s, one after the other; shorter remainders are left out.

    Raises TrainError for an unreadable image and for texts of an episode that does not exist.
    """
    parts = [(piece, k) for piece in pieces(recording) for k in range(0, len(piece.pose) - FRAMES + 1, FRAMES)]
    if unknown := sorted(set(recording.texts) - set(range(len(parts)))):
        raise TrainError(
            f"recording {recording.name}: texts for episode {unknown[0]}; expected a number below {len(parts)}"
        )
    for number, (piece, start) in enumerate(parts):
        texts = recording.texts.get(number, Texts())
        if texts.traces and len(texts.traces) != FRAMES // TRACE_EVERY:
            raise TrainError(
                f"recording {recording.name}: episode {number}: expected {FRAMES // TRACE_EVERY} traces, one a second, "
                f"found {len(texts.traces)}"
            )
        yield _drive(recording, kind, robot, number, piece, start, texts)


def _drive(
    recording: Recording, kind: str, robot: str, number: int, piece: Piece, start: int, texts: Texts
) -> Drive:  # fmt: skip
    span = slice(start, start + FRAMES)
    last = len(piece.pose) - 1
    future = np.zeros((FRAMES, FUTURE_STEPS, 3), np.float32)
    steps = np.zeros(FRAMES, np.int16)
    plan = np.zeros((FRAMES, len(PLAN_TIMES_S), 2), np.float32)
    ahead = np.array([round(time_s * RATE_HZ) for time_s in PLAN_TIMES_S])
    for k in range(FRAMES):
        here = start + k
        known = driven_future(piece.pose, here, last)
        steps[k] = len(known)
        future[k, : len(known)] = known
        future[k, len(known) :] = known[-1] if len(known) else 0.0
        plan[k] = relative(piece.pose[here], piece.pose[np.minimum(here + ahead, last)])[:, :2]
    jpegs = [_jpeg(recording, int(index)) for index in piece.picture[span]]
    goal = piece.pose[start + FRAMES - 1]
    about = About(
        id=f"{kind}-{recording.name}-{number:04d}",
        kind=kind,
        layout_seed=crc32(recording.name.encode()),
        scene=recording.name,
        robot=robot,
        people=0,
        seed=0,
        driver="imported",
        drift="none",
        goal_xy=(float(goal[0]), float(goal[1])),
        threshold_m=THRESHOLD_M,
        outcome="imported",
        collided=False,
        wordings=texts.wordings,
        told=(),
        traces=tuple({"k": TRACE_EVERY * i, **trace} for i, trace in enumerate(texts.traces)),
    )
    return Drive(
        about=about,
        jpeg=np.concatenate(jpegs),
        jpeg_end=np.cumsum([len(jpeg) for jpeg in jpegs]).astype(np.int64),
        pose=piece.pose[span].copy(),
        pose_odom=piece.pose[span].copy(),
        state=piece.state[span].astype(np.float32),
        future=future,
        future_steps=steps,
        plan_xy=plan,
        by=np.full(FRAMES, EXPERT, np.uint8),
    )


def _jpeg(recording: Recording, index: int) -> NDArray[np.uint8]:
    """Resize an image to 128 x 128 without cropping, as on the robot, and encode it as JPEG."""
    picture = read_picture(recording.pictures[index])
    small = cv2.resize(picture, (PICTURE_PX, PICTURE_PX), interpolation=cv2.INTER_AREA)
    done, jpeg = cv2.imencode(".jpg", small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not done:
        raise TrainError(f"{recording.pictures[index]}: could not be compressed")
    return np.asarray(jpeg, np.uint8).ravel()
