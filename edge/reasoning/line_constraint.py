"""Constraints on the tokens of single lines of a text: one of a few lines, or any line that the grammar allows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import takewhile
from typing import Final, TypeAlias

from edge.state.reasoning_text import (
    AHEAD,
    AREAS,
    CROSSING,
    CROWDS,
    ENTERED_AREAS,
    LEFT,
    MAX_DISTANCE_M,
    PLAN_HEAD,
    RIGHT,
    SIDES,
    SITUATION_HEAD,
    Plan,
    Situation,
    Stop,
    Turn,
    TurnBack,
    format_plan,
    format_situation,
)

Line: TypeAlias = tuple[int, ...]
Encode: TypeAlias = Callable[[str], Sequence[int]]
Node: TypeAlias = "dict[int, Node]"
"""The next tokens of some lines, each with what may follow it; empty: a line ends here."""

USUAL_M: Final = 3
"""Distance that is written where the model writes none, m."""


class LineConstraint:
    """Constrains one line of a text to some lines of tokens, the first of them preferred.

    The line begins where the model chooses their common first token. Where the model chooses a token that none of the
    remaining lines has, the preferred remaining line replaces its choice. A text without such a line is unchanged.
    """

    def __init__(self, lines: Sequence[Line], refused: Mapping[str, Sequence[Line]] | None = None) -> None:
        """`lines`: one token or more each, none the start of another; `refused`: lines that are not allowed, by kind.

        Raises ValueError unless all lines begin with the same token.
        """
        if len({line[:1] for line in lines}) != 1 or not lines[0]:
            raise ValueError("expected lines that begin with the same token")
        self._lines = list(lines)
        self._refused = {name: list(kind) for name, kind in (refused or {}).items()}
        self._at = 0
        self.overruled = False
        """Whether a choice of the model was replaced."""
        self.refused: str | None = None
        """Kind of the refused line that the model began; None for another line."""

    def choose(self, token: int) -> int:
        """Return the token to take where the model chooses `token`; call it for every new token, in order."""
        if not self._lines or (self._at == 0 and token != self._lines[0][0]):
            return token
        allowed = [line for line in self._lines if line[self._at] == token]
        for name, kind in self._refused.items():
            self._refused[name] = [line for line in kind if line[self._at : self._at + 1] == (token,)]
        if not allowed:
            if not self.overruled:
                # Later tokens follow the replaced one, not the model's own choice.
                self.refused = next((name for name, kind in self._refused.items() if kind), None)
            self.overruled = True
            allowed = self._lines[:1]
            token = allowed[0][self._at]
        self._at += 1
        self._lines = [line for line in allowed if len(line) > self._at]
        return token

    def forced(self) -> Line:
        """Return the next tokens that `choose` will return whatever the model chooses."""
        rest = [line[self._at :] for line in self._lines] if self._at else []
        same = takewhile(lambda column: len(set(column)) == 1, zip(*rest, strict=False))
        return tuple(column[0] for column in same)


class TextForms:
    """Every situation and every plan that the grammar can write, as tokens; made once, for any number of texts.

    A text that leaves its grammar in one of these lines may end without waypoints. A robot that stands would then
    write the same text again and again, and stand for ever.
    """

    def __init__(self, encode: Encode) -> None:
        """`encode` returns the model's tokens of a text. A kind whose lines it does not tell apart has no form."""
        self.heads: dict[int, Node] = {}
        """By its first token, the tokens of each kind of line."""
        self.ends: set[int] = set()
        """Tokens that end a line."""
        for head, phrases in ((SITUATION_HEAD, _situations()), (PLAN_HEAD, _plans())):
            lines = [tuple(encode(f"{head}{phrase}.\n")) for phrase in phrases]
            tree = _tree(lines)
            if tree is not None and len(tree) == 1:
                self.heads |= tree
                self.ends |= {line[-1] for line in lines}


class FormConstraint:
    """Keeps one text's situation and plan within the grammar: `choose` for every token.

    Where the model's token continues no line of the kind, the usual line that begins like the text replaces its choice.
    """

    def __init__(self, forms: TextForms) -> None:
        self._forms = forms
        self._begins = True  # whether the next token begins a line
        self._node: Node = {}  # what may follow; empty outside such a line
        self._kind_known = False  # whether the text has left the tokens that all lines of the kind share
        self.replaced = False
        """Whether a choice of the model was replaced in the newest line of a kind."""

    def choose(self, token: int) -> int:
        """Return the token to take where the model chooses `token`."""
        if self._begins and token in self._forms.heads:
            self._node, self._kind_known, self.replaced = {token: self._forms.heads[token]}, False, False
        if self._node:
            self._kind_known = self._kind_known or len(self._node) > 1
            if self._kind_known and token not in self._node:
                token, self.replaced = next(iter(self._node)), True
            self._node = self._node.get(token, {})
        self._begins = token in self._forms.ends
        return token

    def forced(self) -> Line:
        """Return the next tokens that `choose` will return whatever the model chooses."""
        found, node = [], self._node if self._kind_known else {}
        while len(node) == 1:
            ((token, node),) = node.items()
            found.append(token)
        return tuple(found)


def _tree(lines: Iterable[Line]) -> Node | None:
    """Return the tokens of lines as a tree, in their order; None if a line is empty or begins another one."""
    root: Node = {}
    for line in lines:
        node, new = root, False
        for token in line:
            if node is not root and not node and not new:
                return None
            new = new or token not in node
            node = node.setdefault(token, {})
        if node or not new:
            return None
    return root


def _situations() -> Iterator[str]:
    for area in AREAS:
        for crowd in range(len(CROWDS)):
            yield format_situation(Situation(area, crowd))


def _plans() -> Iterator[str]:
    """Write the plans, the usual distances first."""
    places = [(side, area) for side in (AHEAD, LEFT, RIGHT) for area in ENTERED_AREAS]
    places += [(side, CROSSING) for side in SIDES]
    for waits in (False, True):
        for distance_m in sorted(range(MAX_DISTANCE_M + 1), key=lambda metres: abs(metres - USUAL_M)):
            for side, area in places:
                yield format_plan(Plan(Turn(side, area, distance_m), waits))
            yield format_plan(Plan(Stop(distance_m), waits))
        yield format_plan(Plan(TurnBack(), waits))
