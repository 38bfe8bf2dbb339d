"""Anchors: instants of a recorded drive as the prompt that the runner would build, and the true answer.

Token ids come from the runner's prompt builder. Each epoch draws the wording of the instruction, the time since the
previous generation, whether its progress was right, and whether reasoning text or waypoints alone are requested (paper
section 3.3: "we mix waypoint-only and scene-reasoning-augmented targets during training for flexible prompting").

Waypoints alone are requested by starting the assistant's turn with WAYPOINTS_START.
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
from edge.reasoning.line_constraint import TextForms
from edge.reasoning.path_memory import FARTHEST_M, MAX_POINTS, PastPath, PathMemory
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
from tools.train.drives.trace_sentences import aspects_of_json

FRAME_OFFSETS_S: Final = (9.0, 6.0, 3.0)
"""Ages of the older frames relative to the newest, s (paper appendix A), oldest first."""
WAYPOINTS_START: Final = "waypoints:"
"""Start of an assistant's turn that requests waypoints without reasoning text."""
_NS: Final = 1_000_000_000
_NEAR: Final = 3  # traces before and after an anchor in which a change of progress makes it a deciding one
_AHEAD_SHARE: Final = 0.5  # share of wrong progress that is ahead of the truth
_STALE_S: Final = 20.0  # largest age of stale progress
OFF_ROUTE_M: Final = 2.0
"""Walking distance to the route beyond which the robot has left it, m."""


@dataclass(frozen=True)
class Anchor:
    """Frame k of a drive with all inputs of a generation and the true answer."""

    drive_id: str
    k: int
    frames: tuple[int, ...]
    """Frames in the prompt, oldest first; the last one is k."""
    way: PastPath
    """Past motion since the instruction, from odometry."""
    wordings: tuple[str, ...]
    points: Waypoints
    """The expert's planned positions in 3, 6 and 9 s; (x m, y m) in the robot frame at k."""
    reasoning: ReasoningText
    """The whole answer: five aspects and the waypoints."""
    progress: Progress
    earlier: tuple[Progress, ...]
    """Progress at every second from the drive's start to k."""
    decides: bool = False
    """Whether the progress changes within 3 s or the robot is off its route: the previous answer cannot be repeated."""
    around: tuple[Waypoints | None, ...] = ()
    """`points` of the frames k - AROUND to k + AROUND; None for frames outside the drive."""
    moved: tuple[SE2 | None, ...] = ()
    """Pose at k in the robot frame of each of those frames, from odometry."""
    waited: bool = False
    """Whether the robot has stood here since the instruction, for one generation or more."""
    by_seconds: bool = False
    """Whether the drive has images at whole seconds alone."""
    off_m: float = 0.0
    """Walking distance to the route, m; 0 if it was not recorded."""
    believed: Progress | None = None
    """Progress of the policy's newest text at k; None where no policy drives or it has no text yet."""

    def before(self, ago_s: float) -> Progress | None:
        """Return the true progress of a generation whose newest frame is `ago_s` old; None before the drive began."""
        if self.waited:
            return self.progress
        at = int(np.floor((self.k - ago_s * RATE_HZ) / TRACE_EVERY))
        return self.earlier[at] if at >= 0 else None

    @property
    def off_route(self) -> bool:
        """Whether the robot has left its route."""
        return self.off_m > OFF_ROUTE_M or turns_back(self.reasoning)


@dataclass(frozen=True)
class Drawn:
    """Random choices of one sample of an anchor."""

    wording: str
    before: Progress | None
    waypoints_only: bool = False
    way: PastPath | None = None
    """Past motion with noise; None: as recorded."""


def frames_at(k: int, offsets_s: Sequence[float] = FRAME_OFFSETS_S) -> tuple[int, ...]:
    """Return the frames of a generation whose newest is k, as the runner chooses them; oldest first."""
    chosen: list[int] = []
    for offset_s in offsets_s:
        wanted = k - offset_s * RATE_HZ
        nearest = max(0, round(wanted))
        if abs(nearest - wanted) <= TOLERANCE_S * RATE_HZ and nearest < k and nearest not in chosen:
            chosen.append(nearest)
    return (*chosen, k)


def anchors_of(drive: Drive, every: int = TRACE_EVERY) -> list[Anchor]:
    """Return a drive's anchors, one every `every` frames (a multiple of 1 s); empty for a drive without traces."""
    if every < 1 or every % TRACE_EVERY:
        raise ValueError(f"anchors: expected a multiple of {TRACE_EVERY} frames, found {every}")
    memory, seen = PathMemory(), 0
    found: list[Anchor] = []
    earlier: list[Progress] = []
    labels = [Progress(**trace["progress"]) for trace in drive.traces]
    last = len(labels) - 1
    for number, trace in enumerate(drive.traces):
        k = int(trace["k"])
        if k >= len(drive):
            break
        while seen <= k:
            memory.put(seen * _NS // RATE_HZ, drive.T_odom_base(seen))
            seen += 1
        earlier.append(labels[number])
        if k % every:
            continue
        near = [i if 0 <= i < len(drive) else None for i in range(k - AROUND, k + AROUND + 1)]
        T_odom_base = drive.T_odom_base(k)
        points, reasoning = _points(drive, k), aspects_of_json(trace)
        off_m, believed = float(trace.get("off_m", 0.0)), trace.get("believed")
        changes = labels[max(0, number - _NEAR)] != labels[min(number + _NEAR, last)]
        found.append(
            Anchor(
                drive_id=drive.id,
                k=k,
                frames=frames_at(k),
                way=memory.past_path(T_odom_base),
                wordings=drive.wordings,
                points=points,
                reasoning=replace(reasoning, waypoints=points),
                progress=earlier[-1],
                earlier=tuple(earlier),
                around=tuple(None if i is None else _points(drive, i) for i in near),
                moved=tuple(None if i is None else _from(drive.T_odom_base(i), T_odom_base) for i in near),
                decides=changes or off_m > OFF_ROUTE_M or turns_back(reasoning),
                off_m=off_m,
                believed=None if believed is None else Progress(**believed),
            )
        )
    return found


def _from(T_odom_there: SE2, T_odom_here: SE2) -> SE2:
    """Compute `T_there_here`, rounded, because wrapping of angles changes the last digits in mirrored drives."""
    return SE2(*(round(value, 9) for value in (T_odom_there.inverse() @ T_odom_here).as_tuple()))


def _points(drive: Drive, k: int) -> Waypoints:
    return tuple((float(x), float(y)) for x, y in drive.plan_xy[k])


def waiting(anchor: Anchor, generations: int) -> Anchor:
    """Return a drive's first anchor some generations later, for a robot that waits for its first answer."""
    if anchor.k or generations < 1:
        raise ValueError(
            f"waiting: expected the first anchor and 1 generation or more, found {anchor.k}, {generations}"
        )
    return replace(anchor, frames=(0,) * min(generations, 1 + len(FRAME_OFFSETS_S)), waited=True)


def draw(anchor: Anchor, config: DrawConfig, rng: np.random.Generator) -> Drawn:
    """Draw a sample of an anchor; the number of draws from `rng` is always the same."""
    wording, ago, late, wrong, ahead, which, old, only, own = rng.uniform(size=9)
    noise = rng.standard_normal((2 + MAX_POINTS, 2))
    lowest, highest = config.before_min_s, config.before_max_s
    if late < config.before_late:
        lowest, highest = highest, config.before_latest_s
    ago_s = lowest + ago * (highest - lowest)
    before = anchor.before(ago_s)
    unaware = believed_off_route(before) if before is not None and anchor.off_route else []
    if anchor.believed is not None and own < config.before_own:
        before = anchor.believed
    elif unaware and wrong < config.before_unaware:
        before = unaware[int(which * len(unaware))]
    elif wrong < config.before_wrong and before is not None:
        # Drives do not contain progress that is ahead of the truth, so it is added here.
        others: Sequence[Progress | None] = too_far(before) if ahead < _AHEAD_SHARE else ()
        stale = anchor.before(ago_s + old * _STALE_S)
        others = others or [*confused(before), *([stale] if stale not in (None, before) else [])]
        before = others[int(which * len(others))]
    return Drawn(
        wording=anchor.wordings[int(wording * len(anchor.wordings))],
        before=before,
        waypoints_only=bool(only < config.waypoints_only),
        way=_noisy_way(anchor.way, config, noise),
    )


def _noisy_way(way: PastPath, config: DrawConfig, noise: npt.NDArray[np.float64]) -> PastPath:
    """Add odometry noise to past motion: rotation and scale about the robot, and noise on each point."""
    turn, scale = float(noise[0, 0]) * config.way_turn_rad, 1.0 + float(noise[0, 1]) * config.way_scale
    c, s = scale * cos(turn), scale * sin(turn)
    moved = np.array(way).reshape(-1, 2) @ np.array(((c, s), (-s, c))) + noise[2 : 2 + len(way)] * config.way_point_m
    # Odometry without motion has no noise.
    stood = len(way) < 2 and not np.any(way)
    return way if stood else tuple((_tenth(x), _tenth(y)) for x, y in moved.tolist())


def _tenth(value_m: float) -> float:
    return min(max(round(value_m, 1), -FARTHEST_M), FARTHEST_M) + 0.0


def turns_back(text: ReasoningText) -> bool:
    """Return whether the plan is to turn back: the robot has left its route."""
    return text.plan is not None and isinstance(text.plan.action, TurnBack)


def believed_off_route(progress: Progress) -> list[Progress]:
    """Return what a robot off its route may believe that does not know it, the true progress given.

    In a wrong opening it believes that it made the turn, and may have counted on from there; past the right opening it
    believes that this one is still ahead.
    """
    step, steps, passed = progress.step, progress.steps, progress.passed
    if progress.is_last_leg:
        return []
    turned = [Progress(step + 1, steps, count) for count in range(1 if step == steps else 2)]
    return [*turned, *([Progress(step, steps, passed - 1)] if passed > 0 else [])]


def too_far(progress: Progress) -> list[Progress]:
    """Return wrong progress ahead of the truth: one turn or one opening more."""
    step, steps, passed = progress.step, progress.steps, progress.passed
    others = [Progress(step + 1, steps, 0)] if step <= steps else []
    if not progress.is_last_leg and passed < MAX_COUNT:
        others.append(Progress(step, steps, passed + 1))
    return others


def confused(progress: Progress) -> list[Progress | None]:
    """Return possible wrong progress: none, one turn or opening more or less, or another number of turns."""
    step, steps, passed = progress.step, progress.steps, progress.passed
    others: list[Progress | None] = [None, *too_far(progress)]
    if step > 1:
        others.append(Progress(step - 1, steps, 0))
    if not progress.is_last_leg and passed > 0:
        others.append(Progress(step, steps, passed - 1))
    for other in (steps - 1, steps + 1):
        if 0 <= other <= MAX_COUNT:
            at = min(step, other + 1)
            others.append(Progress(at, other, passed if at == step <= other else 0))
    return others


def waypoint_line(anchor: Anchor) -> str:
    """Format the waypoint line."""
    return format_waypoints(anchor.points)


class Prompts:
    """Builds token ids of prompts with `PromptBuilder`; repeated parts are cached."""

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
        # Token ids depend on the number of frames, not on their content.
        self._frame = EncodedFrame(0, SE2(0.0, 0.0, 0.0), np.zeros((1, 1, 1), np.float32))
        self._start = self._encode(WAYPOINTS_START)
        self._forms: TextForms | None = None

    def prompt(self, anchor: Anchor, drawn: Drawn) -> tuple[int, ...]:
        """Return the ids before the answer. Raises InstructionError for an invalid wording."""
        count = len(anchor.frames)
        head = [i for number in range(1, count + 1) for i in self._frame_ids(number, drawn.wording)]
        tail = self._builder.tail(anchor.way if drawn.way is None else drawn.way, drawn.before)
        return (*head, *tail.ids, *(self._start if drawn.waypoints_only else ()))

    def answer(self, text: str) -> tuple[int, ...]:
        """Return the ids of a text and the end token."""
        return (*self._encode(text), self._end)

    def of(self, anchor: Anchor, drawn: Drawn) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return (prompt, answer) ids. Raises ValueError if they exceed the model's context."""
        text = waypoint_line(anchor)[len(WAYPOINTS_START) :] if drawn.waypoints_only else format_text(anchor.reasoning)
        prompt, answer = self.prompt(anchor, drawn), self.answer(text)
        if len(prompt) + len(answer) > self._most:
            raise ValueError(
                f"drive {anchor.drive_id}, frame {anchor.k}: prompt of {len(prompt)} and answer of {len(answer)} "
                f"tokens exceed the model's context of {self._most}"
            )
        return prompt, answer

    def constraint(self, context: DecodingContext) -> TextConstraint:
        """Return what the runner constrains an answer with."""
        if self._forms is None and context.keeps_form:
            self._forms = TextForms(self._encode)
        return TextConstraint(context, self._encode, self._forms)

    def text(self, ids: Iterable[int]) -> str:
        """Decode answer tokens, as the runner does."""
        return str(self._tokenizer.decode(list(ids), skip_special_tokens=True))

    def _encode(self, text: str) -> tuple[int, ...]:
        return tuple(self._tokenizer.encode(text, add_special_tokens=False).ids)

    def _frame_ids(self, number: int, wording: str) -> tuple[int, ...]:
        key = (number, wording if number == 1 else "")
        if key not in self._kept:
            segment: Segment = self._builder.frame(number, self._frame, wording)
            self._kept[key] = segment.ids
        return self._kept[key]
