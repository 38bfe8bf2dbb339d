"""The emergency-stop latch and the operator's permission that ends it. Pure: no clock, no I/O.

The latch applies in every state of the bridge. An operator's arm is a permission for one runner and one arming. It is
refused unless a connected runner has just requested arming; it expires; a danger, a stop or a disconnection voids it.
The latch ends when the permitted arming ends with the robot armed, and in no other way.
"""

from __future__ import annotations

from typing import Final

_NS_PER_S: Final = 1_000_000_000
_NEVER_NS: Final = -(2**62)
PERMIT_NS: Final = 10 * _NS_PER_S
"""Lifetime of an operator's arm: within it the operator still watches the robot."""
WAITING_NS: Final = 3 * _NS_PER_S
"""Time after its arm request for which a runner counts as waiting; `edge-run` repeats the request once a second."""


class OperatorPermit:
    """Latch and permission of one bridge. `required`: every arming needs a permission (`safety.operator_arm`)."""

    def __init__(self, required: bool, latch: str = "") -> None:
        """`latch`: reason of an earlier bridge process's emergency stop, or empty."""
        self.latch = latch
        self._required = required
        self._asked_ns = self._until_ns = _NEVER_NS
        self._begun = False

    def hold(self, reason: str) -> None:
        """Latch an emergency stop; the first reason stays. Voids a permission."""
        self.latch = self.latch or reason
        self.void()

    def ask(self, now_ns: int) -> None:
        """Note the connected runner's arm request."""
        self._asked_ns = now_ns

    def give(self, now_ns: int) -> bool:
        """Take an operator's arm; False when no runner is waiting for it."""
        if now_ns - self._asked_ns > WAITING_NS:
            return False
        self._until_ns = now_ns + PERMIT_NS
        return True

    def use(self) -> None:
        """Use the permission for the arming that begins now; it still expires before the first request is sent."""
        self._asked_ns = _NEVER_NS

    def begin(self) -> None:
        """Note that the arming has sent its first request: from now on the permission does not expire."""
        self._begun = self.is_needed

    def finish(self) -> None:
        """End the arming with the robot armed: clear latch and permission."""
        self.latch, self._until_ns, self._begun = "", _NEVER_NS, False

    def void(self, *, disconnected: bool = False) -> None:
        """Withdraw the permission, also during an arming."""
        self._until_ns, self._begun = _NEVER_NS, False
        self._asked_ns = _NEVER_NS if disconnected else self._asked_ns

    @property
    def is_needed(self) -> bool:
        """Whether an arming needs an operator."""
        return self._required or self.latch != ""

    def allows(self, now_ns: int) -> bool:
        """Whether an arming may begin or continue."""
        return not self.is_needed or self._begun or now_ns <= self._until_ns

    def state(self, now_ns: int) -> str:
        """One of link.PERMITS."""
        if not self.is_needed:
            return "not needed"
        return "given" if self.allows(now_ns) else "needed"
