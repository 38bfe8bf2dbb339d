"""Detects the emergency-stop keys of the robot's remote. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from firmware_bridge.core.sections import REMOTE_KEYS

TOGETHER_NS: Final = 500_000_000
"""Time within which key presses count as one combination: a person rarely presses two keys within one 20 ms sample,
and a sample with both can be lost."""
_NEVER_NS: Final = -(2**62)


class StopKeys:
    """Detector of the emergency-stop combination, in any order of its keys."""

    def __init__(self, keys: Sequence[str]) -> None:
        """`keys`: names of `REMOTE_KEYS`, all of them needed."""
        self._pressed_ns = {1 << REMOTE_KEYS.index(key): _NEVER_NS for key in keys}

    def press(self, keys: int, now_ns: int) -> bool:
        """Take the key bits of one sample; return whether the combination is complete."""
        for bit in self._pressed_ns:
            if keys & bit:
                self._pressed_ns[bit] = now_ns
        return keys != 0 and all(now_ns - pressed_ns <= TOGETHER_NS for pressed_ns in self._pressed_ns.values())
