"""An instant of a recorded drive as a prompt and its answer: what the runner would have asked there, and the truth.

The ids come from the runner's own prompt builder. What differs between two epochs is drawn: which wording of the
instruction, how long ago the last generation's newest frame was, whether what it said of the progress was right, and
whether reasoning is asked for or waypoints alone (paper section 3.3: "we mix waypoint-only and
scene-reasoning-augmented targets during training for flexible prompting").

Waypoints alone are asked for by beginning the answer: the assistant's turn starts with WAYPOINTS_START and the model
goes on. The prompt that asks for reasoning stays as it is.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import cos, sin
from typing import Final

import numpy as np
import numpy.typing as npt
from tokenizers import Tokenizer

from edge.core.geometry import SE2
from edge.reasoning.decoding_rules import DecodingContext, TextConstraint
from edge.reasoning.path_memory import FARTHEST_M, MAX_POINTS, PathMemory, Way
from edge.reasoning.prompt import PromptBuilder, PromptIds, Segment
from edge.state.reasoning_text import (
    MAX_COUNT,
    Progress,
    ReasoningText,
    TurnBack,
    Waypoints,
    format_text,
    format_waypoints,
)
from edge.state.ring import TOLERANCE_S, EncodedFrame
from export.model.config import TicVlaConfig
from tools.train.config.collect import RATE_HZ, TRACE_EVERY
from tools.train.config.sft import AROUND, DrawConfig
from tools.train.drives.drive import Drive
from tools.train.scenes.trace_sentences import aspects_of_json

FRAME_OFFSETS_S: Final = (9.0, 6.0, 3.0)
"""How far before the newest frame the older ones are (paper appendix A), the oldest first."""
WAYPOINTS_START: Final = "waypoints:"
"""An assistant's turn that begins so has no reasoning: the model is asked for the points alone."""
_NS: Final = 1_000_000_000
_NEAR: Final = 3  # traces, before and after
_AHEAD_SHARE: Final = 0.5  # of wrong words
_STALE_S: Final = 20.0


@dataclass(frozen=True)
class Anchor:
    """Frame k of a drive, with all that a generation about it could be given and should say."""

    drive_id: str
    k: int
    frames: tuple[int, ...]
    """Frames that the model sees, oldest first; the last one is k."""
    way: Way
    """Past motion since the instruction, as odometry told it."""
    wordings: tuple[str, ...]
    points: Waypoints
    """Where the expert means to be in 3, 6 and 9 s; (x m, y m) in the robot's frame at k."""
    reasoning: ReasoningText
    """The whole answer: five aspects and the waypoints."""
    progress: Progress
    earlier: tuple[Progress, ...]
    """The progress at every second from the drive's start up to k, which is the last."""
    decides: bool = False
    """The progress changes within 3 s, or the robot has to turn back: repeating what was said before does not help."""
    around: tuple[Waypoints | None, ...] = ()
    """`points` of the frames from AROUND before it to AROUND after it; None where the drive has none."""
    moved: tuple[SE2 | None, ...] = ()
    """The robot's pose at k in its frame at each of those, as odometry told it."""
    waited: bool = False
    """The robot has stood here since the instruction, for a generation or more."""
    by_seconds: bool = False
    """Only whole seconds of its drive have pictures."""

    def before(self, ago_s: float) -> Progress | None:
        """What a generation with its newest frame `ago_s` ago rightly said; None before the drive began."""
        if self.waited:
            return self.progress
        at = int(np.floor((self.k - ago_s * RATE_HZ) / TRACE_EVERY))
        return self.earlier[at] if at >= 0 else None


@dataclass(frozen=True)
class Drawn:
    """One sample of an anchor."""

    wording: str
    before: Progress | None
    waypoints_only: bool = False
    way: Way | None = None
    """What odometry tells of the way; None: as it was recorded."""


def frames_at(k: int, offsets_s: Sequence[float] = FRAME_OFFSETS_S) -> tuple[int, ...]:
    """Frames of a generation whose newest is k, as the runner chooses them from its ring; oldest first."""
    chosen: list[int] = []
    for offset_s in offsets_s:
        wanted = k - offset_s * RATE_HZ
        nearest = max(0, round(wanted))
        if abs(nearest - wanted) <= TOLERANCE_S * RATE_HZ and nearest < k and nearest not in chosen:
            chosen.append(nearest)
    return (*chosen, k)


def anchors_of(drive: Drive, every: int = TRACE_EVERY) -> list[Anchor]:
    """The anchors of a drive, one every `every` frames (a multiple of a second); none where nobody wrote traces."""
    if every < 1 or every % TRACE_EVERY:
        raise ValueError(f"anchors: expected a multiple of {TRACE_EVERY} frames, found {every}")
    memory, seen = PathMemory(), 0
    found: list[Anchor] = []
    earlier: list[Progress] = []
    said = [Progress(**trace["progress"]) for trace in drive.traces]
    last = len(said) - 1
    for number, trace in enumerate(drive.traces):
        k = int(trace["k"])
        if k >= len(drive):
            break
        while seen <= k:
            memory.put(seen * _NS // RATE_HZ, drive.T_odom_base(seen))
            seen += 1
        earlier.append(said[number])
        if k % every:
            continue
        near = [i if 0 <= i < len(drive) else None for i in range(k - AROUND, k + AROUND + 1)]
        T_odom_base = drive.T_odom_base(k)
        points, reasoning = _points(drive, k), aspects_of_json(trace)
        turns_back = reasoning.plan is not None and isinstance(reasoning.plan.action, TurnBack)
        found.append(
            Anchor(
                drive_id=drive.id,
                k=k,
                frames=frames_at(k),
                way=memory.way(T_odom_base),
                wordings=drive.wordings,
                points=points,
                reasoning=replace(reasoning, waypoints=points),
                progress=earlier[-1],
                earlier=tuple(earlier),
                around=tuple(None if i is None else _points(drive, i) for i in near),
                moved=tuple(None if i is None else _from(drive.T_odom_base(i), T_odom_base) for i in near),
                decides=turns_back or said[max(0, number - _NEAR)] != said[min(number + _NEAR, last)],
            )
        )
    return found


def _from(T_odom_there: SE2, T_odom_here: SE2) -> SE2:
    """`T_there_here` without its last digits, which an angle's wrapping leaves other ones of in the mirror."""
    return SE2(*(round(value, 9) for value in (T_odom_there.inverse() @ T_odom_here).as_tuple()))


def _points(drive: Drive, k: int) -> Waypoints:
    return tuple((float(x), float(y)) for x, y in drive.plan_xy[k])


def waiting(anchor: Anchor, generations: int) -> Anchor:
    """A drive's first anchor some generations later, nothing having moved: a robot that waits for its first words."""
    if anchor.k or generations < 1:
        raise ValueError(
            f"waiting: expected the first anchor and 1 generation or more, found {anchor.k}, {generations}"
        )
    return replace(anchor, frames=(0,) * min(generations, 1 + len(FRAME_OFFSETS_S)), waited=True)


def draw(anchor: Anchor, config: DrawConfig, rng: np.random.Generator) -> Drawn:
    """A sample of an anchor; the same numbers are taken from `rng` whatever comes out."""
    wording, ago, late, wrong, ahead, which, old, only = rng.uniform(size=8)
    noise = rng.standard_normal((2 + MAX_POINTS, 2))
    lowest, highest = config.before_min_s, config.before_max_s
    if late < config.before_late:
        lowest, highest = highest, config.before_latest_s
    ago_s = lowest + ago * (highest - lowest)
    before = anchor.before(ago_s)
    if wrong < config.before_wrong and before is not None:
        # Too far is the mistake that a drive never shows: its own words are late at times, never ahead.
        others: Sequence[Progress | None] = too_far(before) if ahead < _AHEAD_SHARE else ()
        stale = anchor.before(ago_s + old * _STALE_S)
        others = others or [*confused(before), *([stale] if stale not in (None, before) else [])]
        before = others[int(which * len(others))]
    return Drawn(
        wording=anchor.wordings[int(wording * len(anchor.wordings))],
        before=before,
        waypoints_only=bool(only < config.waypoints_only),
        way=_told_way(anchor.way, config, noise),
    )


def _told_way(way: Way, config: DrawConfig, noise: npt.NDArray[np.float64]) -> Way:
    """The way by another odometry: turned and scaled about the robot, each point a little elsewhere."""
    turn, scale = float(noise[0, 0]) * config.way_turn_rad, 1.0 + float(noise[0, 1]) * config.way_scale
    c, s = scale * cos(turn), scale * sin(turn)
    moved = np.array(way).reshape(-1, 2) @ np.array(((c, s), (-s, c))) + noise[2 : 2 + len(way)] * config.way_point_m
    # A robot that has not moved knows it.
    stood = len(way) < 2 and not np.any(way)
    return way if stood else tuple((_tenth(x), _tenth(y)) for x, y in moved.tolist())


def _tenth(value_m: float) -> float:
    return min(max(round(value_m, 1), -FARTHEST_M), FARTHEST_M) + 0.0


def too_far(progress: Progress) -> list[Progress]:
    """What a generation could have said that was ahead of the truth: a turn or an opening more."""
    step, steps, passed = progress.step, progress.steps, progress.passed
    others = [Progress(step + 1, steps, 0)] if step <= steps else []
    if not progress.is_last_leg and passed < MAX_COUNT:
        others.append(Progress(step, steps, passed + 1))
    return others


def confused(progress: Progress) -> list[Progress | None]:
    """What a mistaken generation could have said instead: nothing, a turn or an opening more or less, other turns."""
    step, steps, passed = progress.step, progress.steps, progress.passed
    others: list[Progress | None] = [None, *too_far(progress)]
    if step > 1:
        others.append(Progress(step - 1, steps, 0))
    if not progress.is_last_leg and passed > 0:
        others.append(Progress(step, steps, passed - 1))
    for told in (steps - 1, steps + 1):
        if 0 <= told <= MAX_COUNT:
            at = min(step, told + 1)
            others.append(Progress(at, told, passed if at == step <= told else 0))
    return others


def told_points(anchor: Anchor) -> str:
    """The waypoint line alone."""
    return format_waypoints(anchor.points)


class Prompts:
    """Ids of prompts, through `PromptBuilder` itself; parts that come again are kept."""

    def __init__(self, tokenizer: Tokenizer, config: TicVlaConfig) -> None:
        language = config.language
        ids = PromptIds(
            language.im_start_id, language.im_end_id, language.img_start_id, language.img_end_id,
            language.img_context_id,
        )  # fmt: skip
        self._tokenizer = tokenizer
        self._builder = PromptBuilder(tokenizer, ids, config.frame_tokens)
        self._end = language.im_end_id
        self._most = language.max_context
        self._kept: dict[tuple[int, str], tuple[int, ...]] = {}
        # Ids depend on how many frames there are, not on what is in them.
        self._frame = EncodedFrame(0, SE2(0.0, 0.0, 0.0), np.zeros((1, 1, 1), np.float32))
        self._start = self._encode(WAYPOINTS_START)

    def prompt(self, anchor: Anchor, drawn: Drawn) -> tuple[int, ...]:
        """All that is fed before the answer. Raises InstructionError for a wording that cannot be given."""
        count = len(anchor.frames)
        head = [i for number in range(1, count + 1) for i in self._frame_ids(number, drawn.wording)]
        tail = self._builder.tail(anchor.way if drawn.way is None else drawn.way, drawn.before)
        return (*head, *tail.ids, *(self._start if drawn.waypoints_only else ()))

    def answer(self, text: str) -> tuple[int, ...]:
        """A text and the token that ends it."""
        return (*self._encode(text), self._end)

    def of(self, anchor: Anchor, drawn: Drawn) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """(prompt, answer) ids; raises ValueError when both do not fit the model's context."""
        said = told_points(anchor)[len(WAYPOINTS_START) :] if drawn.waypoints_only else format_text(anchor.reasoning)
        prompt, answer = self.prompt(anchor, drawn), self.answer(said)
        if len(prompt) + len(answer) > self._most:
            raise ValueError(
                f"drive {anchor.drive_id}, frame {anchor.k}: prompt of {len(prompt)} and answer of {len(answer)} "
                f"tokens, the model reads {self._most}"
            )
        return prompt, answer

    def constraint(self, context: DecodingContext) -> TextConstraint:
        """Return what the runner constrains an answer with."""
        return TextConstraint(context, self._encode)

    def text(self, ids: Iterable[int]) -> str:
        """The text of answer tokens, as the runner reads it."""
        return str(self._tokenizer.decode(list(ids), skip_special_tokens=True))

    def _encode(self, text: str) -> tuple[int, ...]:
        return tuple(self._tokenizer.encode(text, add_special_tokens=False).ids)

    def _frame_ids(self, number: int, wording: str) -> tuple[int, ...]:
        key = (number, wording if number == 1 else "")
        if key not in self._kept:
            segment: Segment = self._builder.frame(number, self._frame, wording)
            self._kept[key] = segment.ids
        return self._kept[key]
