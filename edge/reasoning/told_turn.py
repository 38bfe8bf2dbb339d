"""A turn on the spot that an instruction begins with: "turn around, then leave the room".

Routes are described from where they begin, and a model that learned them from robots that faced their routes does not
find the beginning of one behind it. Such a turn needs no picture: odometry measures it, and the model is given the rest
of the instruction once the robot faces its route (ours).
"""

from __future__ import annotations

import math
import re
from typing import Final

from edge.state.reasoning_text import LEFT
from edge.state.semantic import ToldTurn

_SPACE: Final = r"[\s,]+"
_POLITE: Final = (
    r"(?:please|now|okay|ok|all right|robot|hey|hello|hi|(?:could|would|can) you|i want you to|"
    rf"you should|first){_SPACE}"
)
_GOAL: Final = (
    r"(?:(?:find|your goal is|we need you at) the [\w ]{2,60}[.:]"
    r"|(?:go to|head for|bring yourself to) the [\w ]{2,60}:)\s+"  # with a full stop, it comes before the turn
)
_TURN: Final = (
    r"(?:(?P<around>turn (?:around|round)|make a u-turn)"
    r"|turn (?P<a>left|right) on the spot|turn on the spot to the (?P<b>left|right)|turn to face (?P<c>left|right))"
)
_NEXT: Final = r"(?:,? please)?(?:\s*[.,;!?]+\s*|\s+(?=(?:and|then)\s)|\s*$)(?:(?:and then|and|then|after that)[\s,]+)?"
_FIRST: Final = re.compile(
    rf"\s*(?:{_POLITE})*(?:(?P<goal>{_GOAL})(?:{_POLITE})*)?{_TURN}{_NEXT}(?!\s*(?:if|once|as soon)\b)", re.IGNORECASE
)


def split_turn(instruction: str) -> tuple[ToldTurn | None, str]:
    """Split an instruction into the turn on the spot that it begins with and the rest.

    Only a whole clause counts: in "turn around the corner" there is none. None and the whole instruction without one;
    an empty rest for the turn alone. A goal that is named before the turn stays in the rest.
    """
    found = _FIRST.match(instruction)
    if found is None or (found["goal"] and not instruction[found.end() :].strip()):
        return None, instruction
    side = found["a"] or found["b"] or found["c"]
    turn_rad = math.pi if side is None else math.copysign(math.pi / 2, 1 if side.lower() == LEFT else -1)
    goal, rest = found["goal"] or "", instruction[found.end() :].strip()
    if not rest:
        return ToldTurn(turn_rad), ""
    text = goal + (rest if goal.rstrip().endswith(":") else rest[:1].upper() + rest[1:])
    return ToldTurn(turn_rad), text[:1].upper() + text[1:]
