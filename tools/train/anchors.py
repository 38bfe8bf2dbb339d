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
from dataclasses import dataclass
from typing import Final

import numpy as np
from tokenizers import Tokenizer

from edge.geometry import SE2
from edge.path_memory import PathMemory, Way
from edge.prompt import PromptBuilder, PromptIds, Segment
from edge.reasoning_text import MAX_COUNT, Progress, Waypoints, format_waypoints
from edge.ring import TOLERANCE_S, EncodedFrame
from export.model.config import TicVlaConfig
from tools.train.drive import RATE_HZ, TRACE_EVERY, Drive
from tools.train.trace_words import Trace

FRAME_OFFSETS_S: Final = (9.0, 6.0, 3.0)
"""How far before the newest frame the older ones are (paper appendix A), the oldest first."""
WAYPOINTS_START: Final = "waypoints:"
"""An assistant's turn that begins so has no reasoning: the model is asked for the points alone."""
_NS: Final = 1_000_000_000


@dataclass(frozen=True)
class DrawConfig:
    """What is drawn for each sample."""

    waypoints_only: float = 0.2
    """Share of answers that are waypoints without reasoning."""
    before_min_s: float = 0.3
    before_max_s: float = 6.0
    """The last generation's newest frame is so long ago: what a generation takes."""
    before_wrong: float = 0.1
    """Share of wrong words about the progress so far: a model that trusted them blindly could never mend a mistake."""

    def __post_init__(self) -> None:
        if not (0 <= self.waypoints_only <= 1 and 0 <= self.before_wrong < 1):
            raise ValueError("expected waypoints_only from 0 to 1 and before_wrong from 0 to below 1")
        if not 0 < self.before_min_s <= self.before_max_s <= 60:
            raise ValueError("expected 0 < before_min_s <= before_max_s <= 60")


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
    reasoning: str
    """The whole answer: five aspects and the waypoint line."""
    progress: Progress
    earlier: tuple[Progress, ...]
    """The progress at every second from the drive's start up to k, which is the last."""

    def before(self, ago_s: float) -> Progress | None:
        """What a generation with its newest frame `ago_s` ago rightly said; None before the drive began."""
        at = int(np.floor((self.k - ago_s * RATE_HZ) / TRACE_EVERY))
        return self.earlier[at] if at >= 0 else None


@dataclass(frozen=True)
class Drawn:
    """One sample of an anchor."""

    wording: str
    before: Progress | None
    waypoints_only: bool = False


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
    for trace in drive.traces:
        k = int(trace["k"])
        if k >= len(drive):
            break
        while seen <= k:
            memory.put(seen * _NS // RATE_HZ, drive.T_odom_base(seen))
            seen += 1
        earlier.append(Progress(**trace["progress"]))
        if k % every:
            continue
        points: Waypoints = tuple((float(x), float(y)) for x, y in drive.plan_xy[k])
        found.append(
            Anchor(
                drive_id=drive.id,
                k=k,
                frames=frames_at(k),
                way=memory.way(drive.T_odom_base(k)),
                wordings=drive.wordings,
                points=points,
                reasoning=Trace.from_json(trace).text(points),
                progress=earlier[-1],
                earlier=tuple(earlier),
            )
        )
    return found


def draw(anchor: Anchor, config: DrawConfig, rng: np.random.Generator) -> Drawn:
    """A sample of an anchor; the same numbers are taken from `rng` whatever comes out."""
    wording, ago_s, wrong, which, only = rng.uniform(size=5)
    before = anchor.before(config.before_min_s + ago_s * (config.before_max_s - config.before_min_s))
    if wrong < config.before_wrong and before is not None:
        others = confused(before)
        before = others[int(which * len(others))]
    return Drawn(
        wording=anchor.wordings[int(wording * len(anchor.wordings))],
        before=before,
        waypoints_only=bool(only < config.waypoints_only),
    )


def confused(progress: Progress) -> list[Progress | None]:
    """What a mistaken generation could have said instead: nothing, one turn or one opening more or less."""
    step, steps, passed = progress.step, progress.steps, progress.passed
    others: list[Progress | None] = [None]
    others += [Progress(other, steps, 0) for other in (step - 1, step + 1) if 1 <= other <= steps + 1]
    if not progress.is_last_leg:
        others += [Progress(step, steps, other) for other in (passed - 1, passed + 1) if 0 <= other <= MAX_COUNT]
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
        tail = self._builder.tail(anchor.way, drawn.before)
        return (*head, *tail.ids, *(self._start if drawn.waypoints_only else ()))

    def answer(self, text: str) -> tuple[int, ...]:
        """A text and the token that ends it."""
        return (*self._encode(text), self._end)

    def of(self, anchor: Anchor, drawn: Drawn) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """(prompt, answer) ids; raises ValueError when both do not fit the model's context."""
        said = told_points(anchor)[len(WAYPOINTS_START) :] if drawn.waypoints_only else anchor.reasoning
        prompt, answer = self.prompt(anchor, drawn), self.answer(said)
        if len(prompt) + len(answer) > self._most:
            raise ValueError(
                f"drive {anchor.drive_id}, frame {anchor.k}: prompt of {len(prompt)} and answer of {len(answer)} "
                f"tokens, the model reads {self._most}"
            )
        return prompt, answer

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
