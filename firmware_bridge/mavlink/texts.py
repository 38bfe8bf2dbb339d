"""STATUSTEXT for the operator: made harmless, and few a second. Pure."""

from __future__ import annotations

from typing import Final

_INFO: Final = 6  # MAV_SEVERITY: debug lines are dropped
_PER_S: Final = 3.0
_BURST: Final = 10.0
_REASON_NS: Final = 1_000_000_000
_MAX_CHARS: Final = 60


class TextFilter:
    """Lets the autopilot's texts through; the newest explains a denied command."""

    def __init__(self) -> None:
        self.dropped = 0
        self._tokens = _BURST
        self._refilled_ns = 0
        self._newest = ""
        self._newest_ns = -_REASON_NS

    def take(self, severity: int, text: str, now_ns: int) -> str | None:
        """Return the line for the operator; None for an empty text, a debug text and one too many."""
        line = "".join(character if " " <= character <= "~" else "?" for character in text[:_MAX_CHARS]).strip()
        if not line or severity > _INFO:
            return None
        repeated = line == self._newest and now_ns - self._newest_ns < _REASON_NS
        self._newest, self._newest_ns = line, now_ns
        self._tokens = min(_BURST, self._tokens + (now_ns - self._refilled_ns) / 1e9 * _PER_S)
        self._refilled_ns = now_ns
        if repeated or self._tokens < 1.0:
            self.dropped += 1
            return None
        self._tokens -= 1.0
        return f"STATUSTEXT of the rover: {line}"

    def reason(self, since_ns: int) -> str | None:
        """Return the newest text, if it came at most one second before `since_ns`."""
        return self._newest if self._newest_ns >= since_ns - _REASON_NS else None
