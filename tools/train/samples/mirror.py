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

from edge.core.geometry import SE2
from edge.state.reasoning_text import Plan, ReasoningText, Turn, Waypoints
from tools.train.config.collect import TRACE_EVERY
from tools.train.drives.drive import Dataset, Drive
from tools.train.samples.anchors import Anchor
from tools.train.samples.language_batch import FrameRows, FrameTokens, Halves

FOLDER: Final = "tokens-mirrored"
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
    """The anchor of the mirrored drive; what is counted, and when, is the same."""
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
    """One picture a second of a drive, as it is or mirrored: what a cache of tokens asks a drive for."""

    drive: Drive
    mirrored: bool

    def __len__(self) -> int:
        return -(-len(self.drive) // TRACE_EVERY)

    def frame(self, k: int) -> NDArray[np.uint8]:
        """Picture of second k, uint8 RGB [128, 128, 3]. Raises DriveError, IndexError."""
        picture = self.drive.frame(k * TRACE_EVERY)
        return np.ascontiguousarray(picture[:, ::-1]) if self.mirrored else picture


@dataclass(frozen=True)
class SecondsDataset(Dataset):
    """A data set of whose drives one picture a second is looked at, for a cache of visual tokens of its own."""

    mirrored: bool = False

    @staticmethod
    def of(  # type: ignore[override]  # makes one; the parent's picks drives
        dataset: Dataset, *, mirrored: bool = False
    ) -> SecondsDataset:
        """The seconds of a data set, or of its mirror image."""
        entries = tuple(replace(each, frames=-(-each.frames // TRACE_EVERY)) for each in dataset.entries)
        return SecondsDataset(dataset.folder, entries, mirrored)

    def load(self, drive_id: str, *, pictures: bool = True) -> Seconds:  # type: ignore[override]  # all that a token cache asks of a drive
        """One drive's. Raises DriveError."""
        return Seconds(super().load(drive_id, pictures=pictures), self.mirrored)


@dataclass(frozen=True)
class Views:
    """Visual tokens of drives: `plain` of every frame, `mirror` of one frame a second of the mirrored drives.

    `seconds`, where there is one: one frame a second of what has no more (`Anchor.by_seconds`).
    """

    plain: FrameTokens
    mirror: FrameTokens | None = None
    seconds: FrameTokens | None = None

    def of(self, anchor: Anchor, *, in_mirror: bool = False) -> tuple[Halves, ...]:
        """Tokens [N, D] of an anchor's frames; in the mirror those of whole seconds, as anchors at seconds have."""
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
    """Tokens of two data sets: `others`, and `tours` for drives of these ids."""

    others: FrameTokens
    tours: FrameTokens
    ids: frozenset[str]

    def frames(self, drive_id: str) -> FrameRows:
        """As its part has them."""
        return (self.tours if drive_id in self.ids else self.others).frames(drive_id)
