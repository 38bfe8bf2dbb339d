"""Late anchor: when the newest frame of a generation is to be captured, so that the older ones can be prefilled first.

A generation's frames are 3 s apart. With all of them taken at its start, the newest one grows old while the older ones
are prefilled. Planned for the end of that, it stands only behind itself and the prompt's tail.
"""

from __future__ import annotations

from dataclasses import dataclass

EARLY_NS = 100_000_000
"""How long before the planned instant a frame may have been captured: one period of a 10 Hz camera."""
LATE_NS = 500_000_000
"""How long after it: as far as older frames may be from where they are wanted (`edge.state.ring`)."""


@dataclass(frozen=True)
class Anchor:
    """The planned capture of the newest frame; all stamps are on the frames' own clock."""

    begun_ns: int
    """Stamp of the frame that was newest when the generation began."""
    planned_ns: int
    """From here the older frames are counted back."""
    late_ns: int = LATE_NS
    """How long after it the frame may have been captured."""

    @classmethod
    def after(cls, newest_ns: int, prefix_ns: int) -> Anchor:
        """Planned for when the prefix, expected to take `prefix_ns`, is done.

        The frame that is newest then will be as old as the newest is now, so camera and encoder cancel out.
        """
        return cls(newest_ns, newest_ns + max(0, prefix_ns))

    @classmethod
    def now(cls, newest_ns: int) -> Anchor:
        """The frame that is newest already."""
        return cls(newest_ns, newest_ns, 0)

    def older_ns(self, offset_s: float) -> int:
        """Stamp that an older frame is wanted for."""
        return self.planned_ns - round(offset_s * 1e9)

    def is_older(self, stamp_ns: int) -> bool:
        """Whether a frame comes before every one that can be the newest."""
        return stamp_ns < max(self.begun_ns, self.planned_ns - EARLY_NS)

    def choose(self, newest_ns: int) -> int | None:
        """Stamp to take the frame at, of those up to the newest; None: wait for the next one.

        If the prefix took much longer than planned, the spacing is kept rather than the newest frame taken.
        """
        if newest_ns < self.planned_ns - EARLY_NS:
            return None
        return min(newest_ns, self.planned_ns + self.late_ns)
