"""What is remembered for as long as one instruction is followed: its way, the progress last said, where to stop.

Shared by the reasoning thread and by the benchmark's virtual time, so that both tell the model the same. It is fed from
the token ring, where every frame has the pose that it was captured at: what is remembered does not depend on how often
a generation runs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from edge.core.geometry import SE2
from edge.reasoning.arrival import Arrival
from edge.reasoning.decoding_rules import DONE, NOTHING_KNOWN, Known, TextGuide
from edge.reasoning.path_memory import PERIOD_NS, PathMemory, Way
from edge.reasoning.turn_estimate import TurnMemory
from edge.state.reasoning_text import parse_progress
from edge.state.ring import EncodedFrame, TokenRing

MOST_FRAMES = 1 << 16
"""More than a ring holds."""


class InstructionMemory:
    """Way, progress and stop of one instruction; a new instruction gets a new one. For one thread."""

    def __init__(self, from_ns: int | None, instruction: str) -> None:
        """`from_ns`: the newest frame's stamp when the instruction was given; None: it counts from the first frame."""
        self._from_ns = from_ns
        self._path = PathMemory()
        self._known = NOTHING_KNOWN
        self._turn = TurnMemory()
        self._arrival = Arrival(instruction)

    @property
    def stop(self) -> SE2 | None:
        """T_odom_stop: where what was heard so far means to stop (`edge.reasoning.arrival`)."""
        return self._arrival.T_odom_stop

    def known(self, anchor: EncodedFrame) -> Known:
        """What is known before a generation with this newest frame."""
        turn = self._turn
        return replace(self._known, turn=turn.left(anchor.T_odom_base), may_be_done=turn.may_be_done)

    def watch(self, ring: TokenRing) -> None:
        """Take what has come into the ring, at most about once a second: call it more often than the ring is long."""
        newest_ns, seen_ns = ring.newest_ns, self._path.newest_ns
        if newest_ns is not None and (seen_ns is None or newest_ns >= seen_ns + PERIOD_NS):
            self._take(ring, newest_ns)

    def way(self, ring: TokenRing, anchor: EncodedFrame) -> Way:
        """The way until a generation's newest frame, told there; the frames after it are left for the next time."""
        self._take(ring, anchor.stamp_ns)
        # The ring may have forgotten it while it was waited for.
        self._put(anchor.stamp_ns, anchor.T_odom_base)
        return self._path.way(anchor.T_odom_base)

    def heard(self, text: str, guide: TextGuide, anchor: EncodedFrame) -> None:
        """Remember what a published generation says of its progress, and of its turn before it was held to it."""
        self._known = self._known.after(text, guide)
        progress = parse_progress(text)
        if guide.plan_said and not guide.overruled:
            self._arrival.heard(text, progress, anchor.T_odom_base)
        if progress is None and not guide.plan_said:
            return  # cut short before it came to that
        overruled = guide.overruled or not guide.plan_said
        self._turn.heard(progress, guide.look, anchor, overruled=overruled, claimed=guide.wanted == DONE)

    def _take(self, ring: TokenRing, until_ns: int) -> None:
        for stamp_ns, T_odom_base in ring.newest(MOST_FRAMES):
            if stamp_ns <= until_ns:
                self._put(stamp_ns, T_odom_base)

    def _put(self, stamp_ns: int, T_odom_base: SE2) -> None:
        if self._from_ns is None or stamp_ns >= self._from_ns:
            self._path.put(stamp_ns, T_odom_base)
            self._turn.put(stamp_ns, T_odom_base)


@dataclass(frozen=True)
class Job:
    """What is to be thought about, and what is remembered of it."""

    number: int
    instruction: str
    memory: InstructionMemory
