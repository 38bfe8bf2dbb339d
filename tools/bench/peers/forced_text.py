"""Constraints that make a language model write a given text, so that models with random weights can be timed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from edge.reasoning.decoding_rules import DecodingContext, TextConstraint, TurnDistances
from edge.reasoning.line_constraint import Encode, Line
from edge.state.reasoning_text import Progress


def context_of(rules: Mapping[str, Any]) -> DecodingContext:
    """Return the recorded rules of a generation. Raises KeyError, TypeError, ValueError."""
    before = None if rules["before"] is None else Progress(**rules["before"])
    turn = None if rules["turn"] is None else TurnDistances(rules["turn"], tuple(rules["turn_left_m"]))
    return DecodingContext(before, rules["follow"], turn, rules["turn_may_be_done"])


class ForcedText(TextConstraint):
    """Replaces every choice by the next token of a text; what the rules of a context force can be guessed."""

    def __init__(self, tokens: Sequence[int], end: int, encode: Encode, context: DecodingContext | None = None) -> None:
        """`end`: token after the text; `context`: rules that the text obeys, None for free decoding."""
        super().__init__(DecodingContext() if context is None else context, encode)
        self._tokens = iter((*tokens, end))

    def choose(self, token: int) -> int:
        """Return the text's next token. Raises ValueError where the rules do not allow it."""
        wanted = next(self._tokens)
        if (chosen := super().choose(wanted)) != wanted:
            raise ValueError(
                f"the rules replace the text's token {wanted} by {chosen}: expected a text that obeys them"
            )
        return wanted

    def replace_line(self, line: str) -> Line | None:
        """Keep every line: those of a recorded text have been replaced already."""
        return None
