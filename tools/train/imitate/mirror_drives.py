"""Mirrored drives, which double the number of places to learn driving in.

Their visual tokens are those that fine-tuning computed from mirrored images, one per second. Mirrored drives are
therefore learned at whole seconds alone; this suffices because neighbouring frames hardly differ.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tools.train.config.collect import TRACE_EVERY
from tools.train.drives.drive import Dataset, Drive
from tools.train.imitate.data import States
from tools.train.samples.drive_frames import DriveFrames
from tools.train.samples.kv_cache import CachedState
from tools.train.samples.language_batch import FrameRows, FrameTokens, Halves
from tools.train.samples.mirror import mirrored_reasoning, mirrored_text
from tools.train.scenes.trace_sentences import aspects_json, aspects_of_json

MIRROR: Final = "mirror-of-"
"""Prefix of a mirrored drive's id."""
STATES: Final = "kv-mirrored"
"""Folder of the mirrored drives' semantic states, in the data set."""


def mirrored_drive(drive: Drive) -> Drive:
    """Mirror a drive; the result has no images."""
    about = drive.about
    x_m, y_m = about.goal_xy
    return replace(
        drive,
        about=replace(
            about,
            goal_xy=(x_m, 0.0 - y_m),
            wordings=tuple(mirrored_text(wording) for wording in about.wordings),
            traces=tuple(_mirrored_trace(trace) for trace in about.traces),
        ),
        jpeg=np.zeros(0, np.uint8),
        pose=_flipped(drive.pose, 1, 2),
        pose_odom=_flipped(drive.pose_odom, 1, 2),
        state=_flipped(drive.state, 1, 2),
        future=_flipped(drive.future, 1, 2),
        plan_xy=_flipped(drive.plan_xy, 1),
    )


def _flipped(array: NDArray[Any], *axes: int) -> NDArray[Any]:
    """Negate some entries of the last axis; zeros stay positive."""
    array = array.copy()
    for axis in axes:
        array[..., axis] = 0.0 - array[..., axis]
    return array


def _mirrored_trace(trace: Mapping[str, object]) -> dict[str, Any]:
    return {**trace, **aspects_json(mirrored_reasoning(aspects_of_json(trace)))}


class MirroredDrives(Dataset):
    """A data set whose drives are mirrored; the ids are unchanged."""

    @staticmethod
    def of(dataset: Dataset) -> MirroredDrives:  # type: ignore[override]  # makes one; the parent's picks drives
        """Return the mirrored data set."""
        return MirroredDrives(dataset.folder, dataset.entries)

    def load(self, drive_id: str, *, pictures: bool = False) -> Drive:
        """Load one drive, always without images. Raises TrainError."""
        return mirrored_drive(super().load(drive_id, pictures=False))


def mirrored_frames(drive: DriveFrames) -> DriveFrames:
    """Mark a drive's frames as mirrored by its id and restrict them to whole seconds."""
    weight = np.where(np.arange(len(drive)) % TRACE_EVERY == 0, drive.weight, 0.0)
    return replace(drive, id=MIRROR + drive.id, weight=weight)


class Seconds:
    """Tokens at whole seconds, indexed by frame. Raises IndexError for other frames."""

    def __init__(self, rows: FrameRows) -> None:
        self._rows = rows

    def __getitem__(self, k: int) -> Halves:
        if k % TRACE_EVERY:
            raise IndexError(f"frame {k}: mirrored drives have tokens at whole seconds alone")
        return self._rows[k // TRACE_EVERY]


class MirrorTokens:
    """Tokens of mirrored drives with the interface of `FrameTokens`."""

    def __init__(self, seconds: FrameTokens) -> None:
        self._seconds = seconds

    def frames(self, drive_id: str) -> Seconds:
        """Return the tokens of a drive, indexed by frame."""
        return Seconds(self._seconds.frames(drive_id))


class BothTokens:
    """Tokens of drives and, under ids with the prefix MIRROR, of mirrored drives."""

    def __init__(self, plain: FrameTokens, mirror: MirrorTokens) -> None:
        self._plain, self._mirror = plain, mirror

    def frames(self, drive_id: str) -> FrameRows:
        """Return the tokens of a drive, indexed by frame."""
        of_mirror = drive_id.startswith(MIRROR)
        return self._mirror.frames(drive_id.removeprefix(MIRROR)) if of_mirror else self._plain.frames(drive_id)


class BothStates:
    """Semantic states of drives and, under ids with the prefix MIRROR, of mirrored drives."""

    def __init__(self, plain: States, mirror: States) -> None:
        self._plain, self._mirror = plain, mirror
        self.draws = plain.draws

    def anchors(self, drive_id: str) -> tuple[int, ...]:
        """Return the frames that have a state."""
        return self._of(drive_id).anchors(drive_id.removeprefix(MIRROR))

    def at(self, drive_id: str, k: int, draw: int = 0) -> CachedState:
        """Return state number `draw` of the generation whose newest frame is k."""
        return self._of(drive_id).at(drive_id.removeprefix(MIRROR), k, draw)

    def _of(self, drive_id: str) -> States:
        return self._mirror if drive_id.startswith(MIRROR) else self._plain


@dataclass(frozen=True)
class Mirror:
    """Tokens and states of mirrored drives, by the ids of the original drives."""

    tokens: MirrorTokens
    states: States


def balanced(plain: list[DriveFrames], mirror: list[DriveFrames], share: float) -> list[DriveFrames]:
    """Return all drives, with the mirrored ones weighted to be drawn with probability `share`."""
    own, others = (sum(float(drive.weight.sum()) for drive in drives) for drives in (plain, mirror))
    if not share or not own or not others:
        return plain
    factor = share / (1 - share) * own / others
    return plain + [replace(drive, weight=factor * drive.weight) for drive in mirror]
