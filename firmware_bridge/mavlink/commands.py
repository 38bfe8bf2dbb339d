"""Commands to an autopilot, repeated until it acknowledges them. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

RETRY_NS: Final = 250_000_000
"""Our choice: more than a round trip of a telemetry radio. A report that comes sooner after a command says nothing of
its effect."""
_MAX_TRIES: Final = 6
_NEVER_NS: Final = 2**62
ACCEPTED, TEMPORARILY_REJECTED, UNSUPPORTED, IN_PROGRESS = 0, 1, 3, 5
RESULT_NAMES: Final = {
    0: "accepted",
    1: "temporarily rejected",
    2: "denied",
    3: "unsupported",
    4: "failed",
    5: "in progress",
    6: "cancelled",
}
"""MAV_RESULT."""


@dataclass
class _Pending:
    params: tuple[float, ...]
    due_ns: int
    careful: bool
    sent: int = 0
    sent_ns: int = 0


class CommandQueue:
    """Commands that wait for their acknowledgement; a newer command of the same number replaces the older one."""

    def __init__(self) -> None:
        self._pending: dict[int, _Pending] = {}

    def request(self, number: int, *params: float, at_ns: int = 0, careful: bool = False) -> None:
        """Send a command at `at_ns` or later; a repeated request of a waiting command changes nothing.

        `careful`: repeat it only when `observe` shows that it had no effect. Its acknowledgement may have been lost,
        and a person may have undone the command since then: repeating it would overrule that person.
        """
        waiting = self._pending.get(number)
        if waiting is None or waiting.params != params:
            self._pending[number] = _Pending(params, at_ns, careful)

    def observe(self, number: int, is_done: bool, now_ns: int) -> None:
        """Take the vehicle's report on the effect of a careful command: done, it ends; otherwise it is repeated."""
        waiting = self._pending.get(number)
        if waiting is None or not self.is_careful(number):
            return
        if is_done:
            del self._pending[number]
        elif waiting.sent and now_ns - waiting.sent_ns >= RETRY_NS:
            waiting.due_ns = now_ns

    def waits(self, number: int) -> bool:
        """Return whether a command with this number waits for its acknowledgement."""
        return number in self._pending

    def is_careful(self, number: int) -> bool:
        """Return whether a careful command with this number waits."""
        return number in self._pending and self._pending[number].careful

    def cancel(self, *numbers: int) -> None:
        """Give commands up."""
        for number in numbers:
            self._pending.pop(number, None)

    def acknowledge(self, number: int, result: int) -> str | None:
        """Take an acknowledgement; return the name of a result that ends the command without success.

        A temporary rejection ends it too: the bridge's rules repeat a step that has no effect.
        """
        waiting = self._pending.get(number)
        if waiting is None or not waiting.sent or result == IN_PROGRESS:
            return None
        del self._pending[number]
        return None if result == ACCEPTED else RESULT_NAMES.get(result, f"result {result}")

    def due(self, now_ns: int) -> list[tuple[int, int, tuple[float, ...]]]:
        """Return the commands to send now: number, count of earlier tries, parameters."""
        found: list[tuple[int, int, tuple[float, ...]]] = []
        for number, waiting in list(self._pending.items()):
            if now_ns < waiting.due_ns:
                continue
            if waiting.sent >= _MAX_TRIES:
                del self._pending[number]
                continue
            found.append((number, waiting.sent, waiting.params))
            waiting.sent, waiting.sent_ns = waiting.sent + 1, now_ns
            waiting.due_ns = _NEVER_NS if waiting.careful else now_ns + RETRY_NS
        return found
