"""How late messages arrive, from stamps of a clock that is neither set to ours nor runs quite as fast."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

CLOCK_DRIFT: Final = 500e-6
"""Largest rate difference between the sender's clock and ours, as while ntpd corrects one; more counts as a delay."""
CLOCK_BACK_NS: Final = 100_000_000
CLOCK_STEP_NS: Final = 5_000_000_000
"""The sender's clock was set when its stamps go back by more than the first, or the offset between its clock and ours
grows by more than the second from one message to the next. An offset that grows more slowly is a delay."""


@dataclass(frozen=True)
class _SenderClock:
    """Difference between the sender's clock and ours, by the messages so far, ns."""

    at_ns: int
    """Arrival of the quickest message."""
    least_ns: int
    """Its offset: arrival minus stamp."""
    stamp_ns: int
    """Newest stamp."""
    offset_ns: int
    """Offset of the last message."""


class StampLag:
    """Tells each message's delay against the quickest one so far."""

    def __init__(self) -> None:
        self._clock: _SenderClock | None = None

    def of(self, received_ns: int, stamp_ns: int) -> int:
        """Return the delay of a message, ns; 0 for the quickest, after the clock was set, and for no stamp (0)."""
        if stamp_ns <= 0:
            return 0
        offset_ns, clock = received_ns - stamp_ns, self._clock
        if clock is not None:
            lag_ns = offset_ns - clock.least_ns - round(CLOCK_DRIFT * (received_ns - clock.at_ns))
            went_back = stamp_ns <= clock.stamp_ns - CLOCK_BACK_NS
            # Not the lag itself: on a congested link it grows without end, although no clock was set.
            was_set = went_back or offset_ns - clock.offset_ns > CLOCK_STEP_NS
            if lag_ns > 0 and not was_set:
                self._clock = replace(clock, stamp_ns=max(stamp_ns, clock.stamp_ns), offset_ns=offset_ns)
                return lag_ns
        self._clock = _SenderClock(received_ns, offset_ns, stamp_ns, offset_ns)
        return 0
