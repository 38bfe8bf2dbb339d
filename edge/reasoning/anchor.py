"""Late anchor: when the newest frame of a generation is to be captured, so that the older ones can be prefilled first.

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
        """Planned for when the prefix, expected to take `prefix_ns`, is done.

        The frame that is newest then will be as old as the newest is now, so camera and encoder cancel out.
        """
        return cls(newest_ns, newest_ns + max(0, prefix_ns))

    @classmethod
    def now(cls, newest_ns: int) -> Anchor:
        """Return an anchor whose newest frame is already captured."""
        return cls(newest_ns, newest_ns, 0)

    def older_ns(self, offset_s: float) -> int:
        """Wanted stamp of an older frame of that age, ns."""
        return self.planned_ns - round(offset_s * 1e9)

    def is_older(self, stamp_ns: int) -> bool:
        """Whether a frame precedes every candidate for the newest frame."""
        return stamp_ns < max(self.begun_ns, self.planned_ns - EARLY_NS)

    def choose(self, newest_ns: int) -> int | None:
        """Stamp to take the frame at, of those up to the newest; None: wait for the next one.

        If the prefix took much longer than planned, the spacing is kept rather than the newest frame taken.
        """
        if newest_ns < self.planned_ns - EARLY_NS:
            return None
        return min(newest_ns, self.planned_ns + self.late_ns)


def older_frames(ring: TokenRing, plan: Anchor, offsets_s: Sequence[float]) -> Iterator[EncodedFrame]:
    """Frames before the newest at the given ages, oldest first; `offsets_s`: ages, s, in descending order.

    Each frame is looked up only when it is asked for: with a slow model it may not have been captured earlier.
    """
    last_ns: int | None = None
    for offset_s in offsets_s:
        frame = ring.nearest(plan.older_ns(offset_s))
        if frame is None or not plan.is_older(frame.stamp_ns):
            continue
        if last_ns is not None and frame.stamp_ns <= last_ns:
            continue
        last_ns = frame.stamp_ns
        yield frame
