"""Drives as a mirror shows them: another place, in which all that is said holds with left and right exchanged.

Twice as many places to learn to speak of, for the price of encoding one frame a second once more. The benchmark's and
training's wordings have `left` and `right` as sides only, but for "all right".
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.reasoning_text import Waypoints, format_waypoints
from tools.train.anchors import Anchor
from tools.train.drive import TRACE_EVERY, Dataset, Drive
from tools.train.language_batch import FrameTokens, Halves

FOLDER: Final = "tokens-mirrored"
_SIDE: Final = re.compile(r"(?<!\ball )\b(?:left|right)\b", re.IGNORECASE)
_OTHER: Final = {"left": "right", "right": "left", "Left": "Right", "Right": "Left"}


def mirrored_text(text: str) -> str:
    """The words that say the same of the mirrored place."""
    return _SIDE.sub(lambda found: _OTHER.get(found.group(), found.group()), text)


def mirrored(anchor: Anchor) -> Anchor:
    """The anchor of the mirrored drive; what is counted, and when, is the same."""
    points = _across(anchor.points)
    lines, _ = anchor.reasoning.rsplit("\n", 1)
    return replace(
        anchor,
        way=tuple((x_m, 0.0 - y_m) for x_m, y_m in anchor.way),
        wordings=tuple(mirrored_text(wording) for wording in anchor.wordings),
        points=points,
        around=tuple(None if near is None else _across(near) for near in anchor.around),
        reasoning=f"{mirrored_text(lines)}\n{format_waypoints(points)}",
    )


def _across(points: Waypoints) -> Waypoints:
    return tuple((x_m, 0.0 - y_m) for x_m, y_m in points)


@dataclass(frozen=True)
class MirroredDrive:
    """One picture a second of a drive, mirrored: what a cache of tokens asks a drive for."""

    drive: Drive

    def __len__(self) -> int:
        return -(-len(self.drive) // TRACE_EVERY)

    def frame(self, k: int) -> NDArray[np.uint8]:
        """Picture of second k, uint8 RGB [128, 128, 3]. Raises DriveError, IndexError."""
        return np.ascontiguousarray(self.drive.frame(k * TRACE_EVERY)[:, ::-1])


class MirroredDataset(Dataset):
    """A data set whose drives are mirrored, for a cache of visual tokens of its own."""

    @staticmethod
    def of(dataset: Dataset) -> MirroredDataset:
        """The mirror of a data set."""
        entries = tuple(replace(each, frames=-(-each.frames // TRACE_EVERY)) for each in dataset.entries)
        return MirroredDataset(dataset.folder, entries)

    def load(self, drive_id: str, *, pictures: bool = True) -> MirroredDrive:  # type: ignore[override]
        """One drive, mirrored. Raises DriveError."""
        return MirroredDrive(super().load(drive_id, pictures=pictures))


@dataclass(frozen=True)
class Views:
    """Visual tokens of frames as they are, and of one frame a second of the mirrored drives."""

    plain: FrameTokens
    mirror: FrameTokens | None = None

    def of(self, anchor: Anchor, *, in_mirror: bool = False) -> tuple[Halves, ...]:
        """Tokens [N, D] of an anchor's frames; in the mirror those of whole seconds, as anchors at seconds have."""
        if not in_mirror:
            every = self.plain.frames(anchor.drive_id)
            return tuple(every[k] for k in anchor.frames)
        if self.mirror is None or any(k % TRACE_EVERY for k in anchor.frames):
            raise ValueError(f"drive {anchor.drive_id}, frame {anchor.k}: there are no tokens of its mirror image")
        seconds = self.mirror.frames(anchor.drive_id)
        return tuple(seconds[k // TRACE_EVERY] for k in anchor.frames)
