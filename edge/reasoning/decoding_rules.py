"""What a text is held to while it is decoded, by what the texts before it said: its progress, and its next turn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from edge.reasoning.progress_rules import EITHER_WAY, FREE, ONWARD, LineGuide, followers
from edge.reasoning.turn_estimate import Look, TurnLeft, look_of, nearer
from edge.state.reasoning_text import PLAN_HEAD, PROGRESS_HEAD, Progress, format_progress, parse_progress

Encode = Callable[[str], Sequence[int]]


@dataclass(frozen=True)
class Known:
    """What is known before a generation."""

    before: Progress | None = None
    """The progress said last."""
    follow: str = FREE
    """What may be said after it (`edge.reasoning.progress_rules`)."""
    turn: TurnLeft | None = None
    """How far the turn that is next after it is by earlier looks."""
    may_be_done: bool = True
    """Whether the robot can have made that turn."""

    def after(self, text: str, guide: TextGuide) -> Known:
        """What is known after a text that was held to this, but for the turn: who was held back may say it next time.

        A text that says no progress leaves the one that was said before.
        """
        before = parse_progress(text) or self.before
        return Known() if before is None else Known(before, EITHER_WAY if guide.wanted == BACK else ONWARD)

    def record(self) -> dict[str, Any]:
        """What the flight log says of it, beside `before`."""
        turn = self.turn
        return {
            "follow": self.follow,
            "turn": None if turn is None else turn.side,
            "turn_left_m": None if turn is None else turn.left_m,
            "turn_may_be_done": self.may_be_done,
        }


NOTHING_KNOWN: Final = Known()
BACK, DONE = "back", "done"


class TextGuide:
    """Holds one text to what is known; to be asked for every token that the model chooses, and for every line."""

    def __init__(self, known: Known, encode: Encode) -> None:
        """`encode`: the model's tokens of a text."""
        self._progress = None if known.before is None else _progress_guide(known.before, known, encode)
        self._known = known
        self._encode = encode
        self._said: Progress | None = None
        self.look: Look | None = None
        """The turn that the model planned by itself."""
        self.planned = ""
        """Its line as the model said it; empty: it was not held."""
        self.plan_said = False
        """Whether a plan was said to its end."""

    @property
    def overruled(self) -> bool:
        """Whether the model would have said another progress."""
        return self._progress is not None and self._progress.overruled

    @property
    def wanted(self) -> str | None:
        """Whether that was to undo a turn, BACK, or to have made one that the robot cannot have made, DONE."""
        return None if self._progress is None else self._progress.wanted

    def choose(self, token: int) -> int:
        """The token to take where the model has chosen `token`."""
        return token if self._progress is None else self._progress.choose(token)

    def line(self, line: str) -> tuple[int, ...] | None:
        """The tokens to take for a line that is complete, its end included; None: those that it has."""
        if line.startswith(PROGRESS_HEAD):
            self._said = parse_progress(line)
        if not line.startswith(PLAN_HEAD):
            return None
        self.look, self.plan_said = look_of(line), True
        turn = self._known.turn
        if turn is None or self._said != self._known.before or (told := nearer(line, turn)) == line:
            return None
        self.planned = line
        return tuple(self._encode(f"{told}\n"))


def _progress_guide(before: Progress, known: Known, encode: Encode) -> LineGuide | None:
    if known.follow == FREE:
        return None
    kinds: dict[str, list[tuple[int, ...]]] = {"": [], DONE: [], BACK: []}
    for progress in followers(before, EITHER_WAY):
        kind = DONE if progress.step > before.step else BACK if progress.step < before.step else ""
        kinds[kind].append(tuple(encode(f"{PROGRESS_HEAD}{format_progress(progress)}\n")))
    allowed = {"": True, DONE: known.may_be_done, BACK: known.follow == EITHER_WAY}
    lines = [line for kind, found in kinds.items() if allowed[kind] for line in found]
    return LineGuide(lines, {kind: found for kind, found in kinds.items() if not allowed[kind]})
