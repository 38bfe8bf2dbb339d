"""What a generation may say of its progress, given what the one before said: a way is walked from its first turn on.

A model that judges every look by itself says at times that a turn which it has made is still to come, or that the way
has another number of turns than it read at first; the words after it, and the plan that listens to them, then follow
that mistake. The grammar of what may follow is known, so decoding is held to it (ours; the paper decodes freely).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final, TypeAlias

from edge.state.reasoning_text import MAX_COUNT, Progress

Line: TypeAlias = tuple[int, ...]
EMPTY: Final[Mapping[str, Sequence[Line]]] = MappingProxyType({})

FREE: Final = "free"
"""Whatever the model says: nothing has been said before, or nothing is known of it."""
ONWARD: Final = "onward"
"""The same, an opening more or less, or the next turn."""
EITHER_WAY: Final = "either way"
"""The turn before too: the model has been held back once, and may mean it."""
FOLLOWS: Final = (FREE, ONWARD, EITHER_WAY)


def followers(before: Progress, follow: str) -> tuple[Progress, ...]:
    """What may be said after `before`, the likeliest first; () for FREE. Raises ValueError for an unknown `follow`."""
    if follow not in FOLLOWS:
        raise ValueError(f"expected one of {', '.join(FOLLOWS)}, found {follow!r}")
    if follow == FREE:
        return ()
    step, steps = before.step, before.steps
    counts = [(step, before.passed)]
    if not before.is_last_leg:
        counts += [(step, before.passed + more) for more in (1, -1, 2)]
        counts += [(step + 1, 0), (step + 1, 1)]
    if follow == EITHER_WAY:
        counts += [(step - 1, passed) for passed in (0, 1, 2, 3)]
    return tuple(
        Progress(step, steps, passed)
        for step, passed in counts
        if step >= 1 and 0 <= passed <= (0 if step > steps else MAX_COUNT)
    )


class LineGuide:
    """Holds one line of a text that is being decoded to some lines of tokens, the first of them preferred.

    The line begins where the model chooses their common first token. Where it chooses a token that none of the lines
    that are left has there, the line becomes the preferred one of them; a text without such a line is left as it is.
    """

    def __init__(self, lines: Sequence[Line], refused: Mapping[str, Sequence[Line]] = EMPTY) -> None:
        """`lines`: of one token or more, none the start of another. Raises ValueError unless all begin alike.

        `refused`: kinds of lines that are not allowed, by name.
        """
        if len({line[:1] for line in lines}) != 1 or not lines[0]:
            raise ValueError("expected lines that begin with the same token")
        self._lines = list(lines)
        self._refused = {name: list(kind) for name, kind in refused.items()}
        self._at = 0
        self.overruled = False
        """Whether the model would have gone on in another way."""
        self.wanted: str | None = None
        """Of which refused kind; None: of none."""

    def choose(self, token: int) -> int:
        """The token to take where the model has chosen `token`; to be asked for every new token, in order."""
        if not self._lines or (self._at == 0 and token != self._lines[0][0]):
            return token
        allowed = [line for line in self._lines if line[self._at] == token]
        for name, kind in self._refused.items():
            self._refused[name] = [line for line in kind if line[self._at : self._at + 1] == (token,)]
        if not allowed:
            if not self.overruled:
                # What it says next belongs to what it meant, which is none of them.
                self.wanted = next((name for name, kind in self._refused.items() if kind), None)
            self.overruled = True
            allowed = self._lines[:1]
            token = allowed[0][self._at]
        self._at += 1
        self._lines = [line for line in allowed if len(line) > self._at]
        return token
