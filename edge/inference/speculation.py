"""Exact speculative decoding: one call of the language model verifies several guessed tokens.

A text mostly repeats the previous one, so the previous text is the guess; where it does not, the guess is what followed
the same tokens in earlier texts, and what the decoding rules force. A call feeds the last token and the guesses
after it, and returns the model's choice after each. Guesses that equal the choices are accepted; the first other choice
replaces its guess, and the next call overwrites the rows of the refused guesses in the KV buffers.

Condition of exactness: a token's row has the same bits in calls of different numbers of rows. Products of one row use
other kernels, and some kernels take rows in pairs. So each call has `LEAST_ROWS`, or one of the numbers of rows for
which `LanguageModel.speculate` found equal bits on the device; the rest of a call is padding. Texts, keys and values
are then equal bit for bit, with and without guesses.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from time import monotonic_ns
from typing import Final

import numpy as np

from edge.artifacts.manifest import LEAST_ROWS, MOST_ROWS
from edge.inference.calls import Call, Chunk, Floats
from edge.reasoning.decoding_rules import TextConstraint
from edge.state.reasoning_text import (
    AHEAD,
    OPEN_AREA,
    Plan,
    Progress,
    ReasoningText,
    SeenObject,
    SeenPerson,
    Situation,
    Turn,
    format_text,
)

MOST_FOLLOWERS: Final = 8192
"""Number of single tokens and pairs whose follower is known, at most 2 MiB: a large vocabulary has a billion pairs."""
MEMORY: Final = 200.0
"""Number of recent guesses that determine the acceptance."""
FIRST_TEXT: Final = format_text(
    ReasoningText(
        Situation(OPEN_AREA),
        (SeenObject("doorway", AHEAD, 5),),
        (SeenPerson(AHEAD, 3, "coming"),),
        Progress(1, 1, 0),
        Plan(Turn(AHEAD, "corridor", 5)),
        ((1.0, 0.0), (2.0, 0.0), (3.0, 0.0)),
    )
)
"""The grammar's example, from which the first text is guessed."""


def exact_calls_ns(call: Call, kv: Floats, past: int, ids: Sequence[int]) -> dict[int, int]:
    """Return the numbers of rows whose calls give the bits of the shortest calls, with a call's duration, ns.

    Compared are K‖V of the last layer and the logits. `call` copies logits; `ids`: MOST_ROWS tokens, fed after `past`
    tokens. Raises GraphError.
    """
    assert call.logits is not None
    expected_logits = np.empty_like(call.logits)
    for i in range(len(ids) + 1 - LEAST_ROWS):
        call(Chunk(tuple(ids[i : i + LEAST_ROWS]), None, 0), past + i, kv, None)
        expected_logits[i : i + LEAST_ROWS] = call.logits[:LEAST_ROWS]
    expected_kv = kv[:, past : past + len(ids)].copy()
    took_ns: dict[int, list[int]] = {rows: [] for rows in range(LEAST_ROWS, MOST_ROWS + 1)}
    # Twice, in turn: what disturbs one measurement of a number of rows seldom disturbs the other.
    for _ in range(2):
        for rows in tuple(took_ns):
            started_ns = monotonic_ns()
            call(Chunk(tuple(ids[:rows]), None, 0), past, kv, None)
            took_ns[rows].append(monotonic_ns() - started_ns)
            if not (
                np.array_equal(kv[:, past : past + rows], expected_kv[:, :rows])
                and np.array_equal(call.logits[:rows], expected_logits[:rows])
            ):
                del took_ns[rows]
    return {rows: min(times) for rows, times in took_ns.items()}


def next_rows(permitted: Sequence[int], tokens: int) -> int:
    """Return the smallest permitted number of rows for so many tokens, else the largest one; `permitted` ascends."""
    return next((rows for rows in permitted if rows >= tokens), permitted[-1])


def most_rows(permitted: Sequence[int], room: int) -> int:
    """Return the largest permitted number of rows within `room` positions, else the smallest; `permitted` ascends."""
    return next((rows for rows in reversed(permitted) if rows <= room), permitted[0])


@dataclass
class TextUnderWay:
    """The new tokens of one generation, and counts of the calls that chose them."""

    limit: int
    """Most new tokens."""
    constraint: TextConstraint | None
    drafter: Drafter | None
    """None: guess nothing."""
    ids: list[int] = field(default_factory=list)
    line_at: int = 0
    """Index of the current line's first token."""
    call_tokens: list[int] = field(default_factory=list)
    """Tokens fed by each call."""
    guessed: int = 0
    """Guesses that were compared with the model's choice."""
    accepted: int = 0

    def append(self, token: int) -> None:
        """Take the next token."""
        self.ids.append(token)
        if self.drafter is not None:
            self.drafter.take(token)


class EarlierTexts:
    """The previous text, and which token followed each one and each pair last."""

    def __init__(self, first: Sequence[int]) -> None:
        """`first`: tokens of an example."""
        self.newest: tuple[int, ...] = ()
        self._followers: dict[tuple[int, ...], int] = {}
        self.put(first)

    def put(self, text: Sequence[int]) -> None:
        """Take the tokens of a finished text; the followers that were seen longest ago are dropped."""
        self.newest = tuple(text)
        for i, token in enumerate(text):
            for tokens in (tuple(text[max(0, i - 2) : i]), tuple(text[max(0, i - 1) : i])):
                self._followers.pop(tokens, None)  # so that the newest is the last one
                self._followers[tokens] = token
        while len(self._followers) > MOST_FOLLOWERS:
            del self._followers[next(iter(self._followers))]

    def __len__(self) -> int:
        """Return the number of known followers."""
        return len(self._followers)

    def follower(self, tokens: Sequence[int]) -> int | None:
        """Return what followed the last tokens; None: unknown."""
        return self._followers.get(tuple(tokens[-2:])) or self._followers.get(tuple(tokens[-1:]))


class Drafter:
    """Guesses one text from earlier ones: `take` every token, `guess` the tokens after them. Pure.

    The current line is aligned with a line of the previous text by edit distance, one row of its table per token.
    """

    def __init__(self, texts: EarlierTexts, ends_line: Callable[[int], bool]) -> None:
        """`ends_line` returns whether a token's text ends a line."""
        self._texts = texts
        self._ends_line = ends_line
        self._lines: list[list[int]] = [[]]
        for token in texts.newest:
            self._lines[-1].append(token)
            if ends_line(token):
                self._lines.append([])
        self._taken: list[int] = []
        self._begin(0)

    def _begin(self, line: int) -> None:
        self._line = min(line, len(self._lines) - 1)
        self._distances = list(range(len(self._lines[self._line]) + 1))
        self._at = 0

    def take(self, token: int) -> None:
        """Take the next token of the text."""
        starts = not self._taken or self._ends_line(self._taken[-1])
        self._taken.append(token)
        if starts and self._lines[self._line][:1] != [token]:
            # Lines begin with their head: guess a line that was left out or repeated from the one with this head.
            self._begin(next((i for i, line in enumerate(self._lines) if line[:1] == [token]), self._line))
        if self._ends_line(token):
            self._begin(self._line + 1)
            return
        line, above = self._lines[self._line], self._distances
        row = [above[0] + 1]
        for i, other in enumerate(line):
            row.append(min(above[i] + (other != token), above[i + 1] + 1, row[i] + 1))
        self._distances = row
        straight = min(self._at + 1, len(line))
        # Of equal distances, take the one that ends with this token, then the next position.
        self._at = min(range(len(row)), key=lambda i: (row[i], line[i - 1 : i] != [token], abs(i - straight)))

    def guess(self, most: int) -> list[int]:
        """Return at most so many tokens that may come next."""
        tokens, number, at = self._taken[-2:], self._line, self._at
        found: list[int] = []
        while len(found) < most:
            line = self._lines[number]
            expected = line[at] if at < len(line) else None
            if at > 0 and line[at - 1 : at] != tokens[-1:]:
                # The text differs from the previous one here: what followed this token before is likelier.
                follower = self._texts.follower(tokens)
                if follower is not None and follower != expected:
                    expected = follower
                    at = line.index(follower, at) if follower in line[at:] else at - 1
            if expected is None:
                break
            found.append(expected)
            tokens = [*tokens[-1:], expected]
            at += 1
            if self._ends_line(expected):
                number, at = number + 1, 0
                if number == len(self._lines):
                    break
        return found


class Speculator:
    """Guesses of one model: its earlier texts, and the number of guesses with the most tokens per time."""

    def __init__(
        self,
        first: Sequence[int],
        call_ns: Mapping[int, float],
        ends_line: Callable[[int], bool],
        is_number: Callable[[int], bool],
    ) -> None:
        """`first`: tokens of FIRST_TEXT; `call_ns`: duration of a call by its number of rows, ns; `is_number`: whether
        a token has a digit, so that it changes from text to text."""
        if LEAST_ROWS not in call_ns or min(call_ns.values()) <= 0 or max(call_ns) > MOST_ROWS:
            raise ValueError(
                f"expected durations above 0 of calls of {LEAST_ROWS} to {MOST_ROWS} rows, found {call_ns}"
            )
        self._texts = EarlierTexts(first)
        self._ends_line, self._is_number = ends_line, is_number
        self.rows = tuple(sorted(call_ns))
        """Permitted numbers of rows."""
        # By the number of tokens, padded to the next permitted number. A longer measurement of a shorter call is noise.
        self._call_ns = [min(call_ns[rows] for rows in self.rows if rows >= n) for n in range(1, self.rows[-1] + 1)]
        self.call_ns = {rows: self._call_ns[rows - 1] for rows in self.rows}
        """Duration of a call by its number of rows, ns; a longer call takes as long or longer."""
        # Accepted and all guesses, of other tokens and of numbers; the start is soon outweighed.
        self._counts = [[9.0, 10.0], [6.0, 10.0]]

    def begin(self) -> Drafter:
        """Begin the guesses of a text."""
        return Drafter(self._texts, self._ends_line)

    def end(self, text: Sequence[int]) -> None:
        """Take the tokens of a finished text."""
        if text:
            self._texts.put(text)

    def guess(self, text: TextUnderWay, fed: int, longest_ns: float) -> list[int]:
        """Return the guesses to verify in a call that feeds `fed` tokens, within `longest_ns` if it guesses any."""
        most = min(self.rows[-1] - fed, text.limit - len(text.ids))
        if text.drafter is None or most <= 0:
            return []
        forced = [] if text.constraint is None else list(text.constraint.forced())[:most]
        guesses = text.drafter.guess(most)
        if guesses[: len(forced)] != forced:
            guesses = forced
        return guesses[: self.length(guesses, len(forced), fed, longest_ns)]

    def length(self, guesses: Sequence[int], forced: int, fed: int, longest_ns: float) -> int:
        """Return how many of the guesses to verify; the first `forced` ones are certain."""
        best, best_rate = 0, 0.0
        tokens = share = 1.0
        for count in range(len(guesses) + 1):
            if count:
                share *= 1.0 if count <= forced else self.acceptance(guesses[count - 1])
                tokens += share
            duration_ns = self._call_ns[fed + count - 1]
            if fed + count > LEAST_ROWS and duration_ns > longest_ns:
                break
            if tokens / duration_ns >= best_rate:
                best, best_rate = count, tokens / duration_ns
        return best

    def acceptance(self, token: int) -> float:
        """Return the share of recent guesses of this kind of token that were accepted, 0 to 1."""
        accepted, compared = self._counts[self._is_number(token)]
        return accepted / compared

    def record(self, guess: int, *, accepted: bool) -> None:
        """Take the outcome of a guess that was compared with the model's choice."""
        counts = self._counts[self._is_number(guess)]
        counts[0] = counts[0] * (1 - 1 / MEMORY) + accepted
        counts[1] = counts[1] * (1 - 1 / MEMORY) + 1
