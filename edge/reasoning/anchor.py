"""Late anchor: plans the capture of a generation's newest frame, so that the older ones can be prefilled first.

A generation's frames are 3 s apart. If all are taken at its start, the newest one ages while the older ones are
prefilled. The newest frame is therefore planned for the end of that prefill.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from edge.state.ring import EncodedFrame, TokenRing

EARLY_NS = 100_000_000
"""Earliest capture of the newest frame before the planned instant, ns: one period of a 10 Hz camera."""
LATE_NS = 500_000_000
"""Latest capture of the newest frame after the planned instant, ns: the tolerance of older frames
(`edge.state.ring`)."""


@dataclass(frozen=True)
class Anchor:
    """The planned capture of the newest frame; all stamps are on the frames' own clock."""

    begun_ns: int
    """Stamp of the frame that was newest when the generation began."""
    planned_ns: int
    """Instant from which the ages of the older frames count, ns."""
    late_ns: int = LATE_NS
    """Latest capture of the newest frame after that instant, ns."""

    @classmethod
    def after(cls, newest_ns: int, prefix_ns: int) -> Anchor:
        """Plan the capture for the end of the prefix, which takes about `prefix_ns`.

        The newest frame then will be as old as the newest is now, so the delays of camera and encoder cancel out.
        """
        return cls(newest_ns, newest_ns + max(0, prefix_ns))

    @classmethod
    def now(cls, newest_ns: int) -> Anchor:
        """Return an anchor whose newest frame is already captured."""
        return cls(newest_ns, newest_ns, 0)

    def older_ns(self, offset_s: float) -> int:
        """Return the planned stamp of an older frame of that age, ns."""
        return self.planned_ns - round(offset_s * 1e9)

    def is_older(self, stamp_ns: int) -> bool:
        """Return whether a frame precedes every candidate for the newest frame."""
        return stamp_ns < max(self.begun_ns, self.planned_ns - EARLY_NS)

    def choose(self, newest_ns: int) -> int | None:
        """Return the stamp of the frame to use, at most the newest; None: wait for the next one.

        If the prefix took much longer than planned, keep the spacing instead of the newest frame.
        """
        if newest_ns < self.planned_ns - EARLY_NS:
            return None
        return min(newest_ns, self.planned_ns + self.late_ns)


def older_frames(
    ring: TokenRing, plan: Anchor, offsets_s: Sequence[float], from_ns: int | None = None
) -> Iterator[EncodedFrame]:
    """Yield the frames before the newest, oldest first; `offsets_s`: ages, s, in descending order.

    `from_ns`: when the instruction was given, if another one came before it. Its frames are no part of this task: in
    training a drive begins with its instruction.
    Each frame is fetched only on iteration: with a slow model it may not have been captured earlier.
    """
    last_ns = (from_ns or 0) - 1
    for offset_s in offsets_s:
        frame = ring.nearest(plan.older_ns(offset_s))
        if frame is None or not plan.is_older(frame.stamp_ns) or frame.stamp_ns <= last_ns:
            continue
        last_ns = frame.stamp_ns
        yield frame
