"""The emergency-stop latch and the operator's permission that ends it. Pure: no clock, no I/O.

A latch holds from every state of the bridge. An operator's arm is a permission for one runner and one arming: it is
refused unless a connected runner has just asked to arm, it expires, and a danger, a stop or a disconnection voids it.
The latch ends when the permitted arming ends with the robot armed, and in no other way.
"""

from __future__ import annotations

from typing import Final

_NS_PER_S: Final = 1_000_000_000
_NEVER_NS: Final = -(2**62)
PERMIT_NS: Final = 10 * _NS_PER_S
"""An operator's arm expires after this time: the operator still watches the robot."""
WAITING_NS: Final = 3 * _NS_PER_S
"""A runner that asked to arm within this time counts as waiting; `edge-run` asks once a second."""


class OperatorPermit:
    """Latch and permission of one bridge. `required`: every arming needs a permission (`safety.operator_arm`)."""

    def __init__(self, required: bool, latch: str = "") -> None:
        """`latch`: the reason of an emergency stop that an earlier bridge process has left, or empty."""
        self.latch = latch
        self._required = required
        self._asked_ns = self._until_ns = _NEVER_NS
        self._begun = False

    def hold(self, reason: str) -> None:
        """Latch an emergency stop; the first reason stays. Voids a permission."""
        self.latch = self.latch or reason
        self.void()

    def ask(self, now_ns: int) -> None:
        """Note that the connected runner asks to arm."""
        self._asked_ns = now_ns

    def give(self, now_ns: int) -> bool:
        """Take an operator's arm; False when no runner is waiting for it."""
        if now_ns - self._asked_ns > WAITING_NS:
            return False
        self._until_ns = now_ns + PERMIT_NS
        return True

    def use(self) -> None:
        """Spend the permission on the arming that begins now; it still expires before the first request is sent."""
        self._asked_ns = _NEVER_NS

    def begin(self) -> None:
        """Note that the arming has sent its first request: from now on the permission does not expire."""
        self._begun = self.is_needed

    def finish(self) -> None:
        """End that arming with the robot armed: the latch is gone, the permission used up."""
        self.latch, self._until_ns, self._begun = "", _NEVER_NS, False

    def void(self, *, disconnected: bool = False) -> None:
        """Take the permission back, also from an arming that has begun."""
        self._until_ns, self._begun = _NEVER_NS, False
        self._asked_ns = _NEVER_NS if disconnected else self._asked_ns

    @property
    def is_needed(self) -> bool:
        """Whether an arming needs a person."""
        return self._required or self.latch != ""

    def allows(self, now_ns: int) -> bool:
        """Whether an arming may begin or go on."""
        return not self.is_needed or self._begun or now_ns <= self._until_ns

    def state(self, now_ns: int) -> str:
        """One of link.PERMITS."""
        if not self.is_needed:
            return "not needed"
        return "given" if self.allows(now_ns) else "needed"
