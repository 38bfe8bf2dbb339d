"""Mirrored drives: other places, with left and right exchanged in images, motion and texts.

They double the number of places at the cost of encoding one more frame per second; the action expert learns from them
at whole seconds alone. In all wordings `left` and `right` are sides, except in "all right".
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.core.geometry import SE2
from edge.state.reasoning_text import Plan, ReasoningText, Turn, Waypoints
from sim_hil.benchmark.policies.expert_motion import ABOUT_RAD
from tools.train.config.collect import TRACE_EVERY
from tools.train.drives.drive import Dataset, Drive
from tools.train.drives.trace_sentences import aspects_json, aspects_of_json
from tools.train.samples.anchors import Anchor
from tools.train.samples.drive_frames import DriveFrames
from tools.train.samples.language_batch import FrameRows, FrameTokens, Halves

FOLDER: Final = "tokens-mirrored"
STATES: Final = "kv-mirrored"
"""Folder of the mirrored drives' semantic states, in the data set."""
_SIDE: Final = re.compile(r"(?<!\ball )\b(?:left|right)\b", re.IGNORECASE)
_OTHER: Final = {"left": "right", "right": "left", "Left": "Right", "Right": "Left"}


def mirrored_text(text: str) -> str:
    """Exchange left and right in an instruction."""
    return _SIDE.sub(lambda found: _OTHER.get(found.group(), found.group()), text)


def mirrored_reasoning(text: ReasoningText) -> ReasoningText:
    """Exchange left and right in the five aspects of a reasoning text."""
    objects, people = text.objects or (), text.people or ()
    return replace(
        text,
        objects=tuple(replace(each, side=_OTHER.get(each.side, each.side)) for each in objects),
        people=tuple(
            replace(each, side=_OTHER.get(each.side, each.side), motion=mirrored_text(each.motion)) for each in people
        ),
        plan=None if text.plan is None else _mirrored_plan(text.plan),
    )


def _mirrored_plan(plan: Plan) -> Plan:
    action = plan.action
    if not isinstance(action, Turn):
        return plan
    return replace(plan, action=replace(action, side=_OTHER.get(action.side, action.side)))


def mirrored(anchor: Anchor) -> Anchor:
    """Mirror an anchor; its progress is unchanged."""
    points = _across(anchor.points)
    return replace(
        anchor,
        way=tuple((x_m, 0.0 - y_m) for x_m, y_m in anchor.way),
        wordings=tuple(mirrored_text(wording) for wording in anchor.wordings),
        points=points,
        around=tuple(None if near is None else _across(near) for near in anchor.around),
        moved=tuple(None if T is None else SE2(T.x_m, 0.0 - T.y_m, 0.0 - T.theta_rad) for T in anchor.moved),
        reasoning=replace(mirrored_reasoning(anchor.reasoning), waypoints=points),
    )


def _across(points: Waypoints) -> Waypoints:
    return tuple((x_m, 0.0 - y_m) for x_m, y_m in points)


@dataclass(frozen=True)
class Seconds:
    """Images of a drive at whole seconds, optionally mirrored, with the interface that a token cache needs."""

    drive: Drive
    mirrored: bool

    def __len__(self) -> int:
        return -(-len(self.drive) // TRACE_EVERY)

    def frame(self, k: int) -> NDArray[np.uint8]:
        """Decode the image of second k as uint8 RGB [128, 128, 3]. Raises TrainError, IndexError."""
        picture = self.drive.frame(k * TRACE_EVERY)
        return np.ascontiguousarray(picture[:, ::-1]) if self.mirrored else picture


@dataclass(frozen=True)
class SecondsDataset(Dataset):
    """A data set with one image per second of each drive, for a separate token cache."""

    mirrored: bool = False

    @staticmethod
    def of(  # type: ignore[override]  # makes one; the parent's picks drives
        dataset: Dataset, *, mirrored: bool = False
    ) -> SecondsDataset:
        """Return the seconds of a data set, optionally mirrored."""
        entries = tuple(replace(each, frames=-(-each.frames // TRACE_EVERY)) for each in dataset.entries)
        return SecondsDataset(dataset.folder, entries, mirrored)

    def load(self, drive_id: str, *, pictures: bool = True) -> Seconds:  # type: ignore[override]  # all that a token cache asks of a drive
        """Load one drive. Raises TrainError."""
        return Seconds(super().load(drive_id, pictures=pictures), self.mirrored)


@dataclass(frozen=True)
class Views:
    """Visual tokens of drives: `plain` of every frame, `mirror` of one frame per second of the mirrored drives.

    `seconds`: one frame per second of drives that have no more (`Anchor.by_seconds`).
    """

    plain: FrameTokens
    mirror: FrameTokens | None = None
    seconds: FrameTokens | None = None

    def of(self, anchor: Anchor, *, in_mirror: bool = False) -> tuple[Halves, ...]:
        """Return the tokens [N, D] of an anchor's frames. Raises ValueError if there are none."""
        if not in_mirror and not anchor.by_seconds:
            every = self.plain.frames(anchor.drive_id)
            return tuple(every[k] for k in anchor.frames)
        source, what = (self.mirror, "of its mirror image") if in_mirror else (self.seconds, "of its seconds")
        if source is None or any(k % TRACE_EVERY for k in anchor.frames):
            raise ValueError(f"drive {anchor.drive_id}, frame {anchor.k}: there are no tokens {what}")
        seconds = source.frames(anchor.drive_id)
        return tuple(seconds[k // TRACE_EVERY] for k in anchor.frames)


@dataclass(frozen=True)
class Joined:
    """Tokens of two data sets: `tours` for drives with these ids, `others` for the rest."""

    others: FrameTokens
    tours: FrameTokens
    ids: frozenset[str]

    def frames(self, drive_id: str) -> FrameRows:
        """Return the tokens of a drive, indexed by frame."""
        return (self.tours if drive_id in self.ids else self.others).frames(drive_id)


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
            traces=tuple(
                {**trace, **aspects_json(mirrored_reasoning(aspects_of_json(trace)))} for trace in about.traces
            ),
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
    """Mark a drive's frames as mirrored and restrict them to whole seconds, at which mirrored images have tokens.

    Frames that turn about are left out: the expert turns about to the left, their mirror images to the right.
    """
    about = drive.target[:, :, 2].min(axis=1) < -ABOUT_RAD
    weight = np.where((np.arange(len(drive)) % TRACE_EVERY == 0) & ~about, drive.weight, 0.0)
    return replace(drive, in_mirror=True, weight=weight)


class _SecondRows:
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

    def frames(self, drive_id: str) -> _SecondRows:
        """Return the tokens of a drive, indexed by frame."""
        return _SecondRows(self._seconds.frames(drive_id))


def balanced(plain: list[DriveFrames], mirror: list[DriveFrames], share: float) -> list[DriveFrames]:
    """Return all drives, with the mirrored ones weighted to be drawn with probability `share`."""
    own, others = (sum(float(drive.weight.sum()) for drive in drives) for drives in (plain, mirror))
    if not share or not own or not others:
        return plain
    factor = share / (1 - share) * own / others
    return plain + [replace(drive, weight=factor * drive.weight) for drive in mirror]
