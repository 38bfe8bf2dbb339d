"""Stop phrases: short utterances that stop the robot at once instead of becoming an instruction for the model.

Imports nothing of the model: `edge-say` must be quick when a person wants the robot to stop.
"""

from __future__ import annotations

import unicodedata
from typing import Final

STOP_WORDS: Final = frozenset({"stop", "halt", "freeze", "estop"})
COMPANIONS: Final = frozenset({"now", "right", "immediately", "please", "emergency", "robot", "the", "moving", "e"})
"""Words that a stop phrase may also contain ("e" for "e-stop"); any other word makes it an instruction."""


def is_stop_phrase(text: str) -> bool:
    """Return whether the whole utterance is a stop word, alone or repeated, beside companion words only.

    Case, punctuation, whitespace, invisible characters and typographic forms of letters do not matter.
    """
    plain = unicodedata.normalize("NFKC", text).casefold()
    visible = "".join(letter for letter in plain if unicodedata.category(letter) != "Cf")
    words = set("".join(letter if letter.isalnum() else " " for letter in visible).split())
    return bool(words & STOP_WORDS) and words <= STOP_WORDS | COMPANIONS
