"""The memory of one instruction: the path, the last progress, the next turn, the stop.

The reasoning thread and the benchmark's virtual time share it, so that both give the model the same prompt. Its poses
come from the token ring, where every frame has its pose at capture: the memory does not depend on the generation rate.
"""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass, replace
from statistics import median
from typing import Final

from edge.core.geometry import SE2, wrap_angle
from edge.reasoning.decoding_rules import DONE, DecodingContext, TextConstraint, TurnEstimator
from edge.reasoning.generation_cycle import ReasoningConfig
from edge.reasoning.path_memory import PERIOD_NS, PastPath, PathMemory
from edge.reasoning.told_turn import split_turn
from edge.state.reasoning_text import ReasoningText, Stop, parse_text
from edge.state.ring import EncodedFrame, TokenRing
from edge.state.semantic import SemanticSlot
from edge.state.switches import Decoding

MOST_FRAMES = 1 << 16
"""Number of frames, more than the capacity of a ring."""
NEAR_M: Final = 4.0
"""Largest distance of goal and stop in a text that places a stop, m."""
RECENT_TEXTS: Final = 3
AGREEING_TEXTS: Final = 2
"""Number of the RECENT_TEXTS that have to place a stop."""
SAME_HEADING_RAD: Final = 0.7
"""Stops placed at a heading that differs by more than this, 40°, belong to another place."""
STOP_NOW_M: Final = 0.5
"""Distance of "stop now", which is written below 1 m."""
DROPPING_TEXTS: Final = 5
CONTRADICTING_TEXTS: Final = 4
"""Number of the last DROPPING_TEXTS without a nearby stop that drop the stop."""
COLOURS: Final = frozenset(("red", "orange", "yellow", "green", "blue", "purple", "white", "black", "grey", "brown"))


class StopEstimator:
    """Estimate of the stop that one instruction's texts plan; for one thread."""

    def __init__(self, instruction: str) -> None:
        """`instruction` names the goal."""
        self._words = _words(instruction)
        self._stops: deque[SE2 | None] = deque(maxlen=RECENT_TEXTS)
        self._contradicts: deque[bool] = deque(maxlen=DROPPING_TEXTS)
        self.T_odom_stop: SE2 | None = None
        """Pose of the stop, with the robot's heading when it was placed; None while it is unknown."""

    def update(self, text: ReasoningText, T_odom_anchor: SE2) -> None:
        """Take a complete text as the model chose it, before any rule, about a frame captured at a pose."""
        goal_m, stop_m = self._goal_m(text), _stop_m(text)
        last_leg = text.progress is not None and text.progress.is_last_leg
        stops = stop_m is not None and stop_m <= NEAR_M and last_leg
        self._contradicts.append(not stops or (goal_m is not None and goal_m > NEAR_M))
        counts = stops and goal_m is not None and goal_m <= NEAR_M
        self._stops.append(T_odom_anchor @ SE2(stop_m, 0.0, 0.0) if counts and stop_m is not None else None)
        placed = [
            stop
            for stop in self._stops
            if stop is not None and abs(wrap_angle(stop.theta_rad - T_odom_anchor.theta_rad)) <= SAME_HEADING_RAD
        ]
        if counts and len(placed) >= AGREEING_TEXTS:
            x_m, y_m = median(stop.x_m for stop in placed), median(stop.y_m for stop in placed)
            self.T_odom_stop = SE2(x_m, y_m, T_odom_anchor.theta_rad)
            self._contradicts.clear()
        elif sum(self._contradicts) >= CONTRADICTING_TEXTS:
            self.T_odom_stop = None

    def _goal_m(self, text: ReasoningText) -> float | None:
        """Return the distance of the first object in view that the instruction names, m; None without any."""
        return next((float(seen.distance_m) for seen in text.objects or () if self._names(seen.name)), None)

    def _names(self, name: str) -> bool:
        """Return whether the instruction contains the name, with or without its colour."""
        words = _words(name)
        return self._has(words) or (words[0] in COLOURS and self._has(words[1:], uncoloured=True))

    def _has(self, words: tuple[str, ...], *, uncoloured: bool = False) -> bool:
        count = len(words)
        return count > 0 and any(
            self._words[start : start + count] == words
            and not (uncoloured and start > 0 and self._words[start - 1] in COLOURS)
            for start in range(len(self._words) - count + 1)
        )


class InstructionMemory:
    """Path, progress, turn and stop of one instruction; a new instruction gets a new memory. For one thread."""

    def __init__(self, from_ns: int | None, instruction: str, decoding: Decoding = Decoding.CONSTRAINED) -> None:
        """`from_ns`: the newest frame's stamp when the instruction was given; None: the path begins at any frame."""
        self._instruction, self._decoding = instruction, decoding
        self.waits = False
        """Whether it begins anew at the end of the turn that its instruction begins with."""
        self.begin(from_ns)

    def begin(self, from_ns: int | None) -> None:
        """Forget everything before the frame with this stamp; None: the path begins at any frame."""
        self.from_ns, self.waits = from_ns, False
        self._path = PathMemory()
        self._context = DecodingContext()
        self._turn = TurnEstimator()
        self._stop = StopEstimator(self._instruction)

    @property
    def stop(self) -> SE2 | None:
        """T_odom_stop: the stop that the texts so far plan; None while it is unknown."""
        return self._stop.T_odom_stop

    def context(self, anchor: EncodedFrame) -> DecodingContext:
        """Return the prompt's memory and the decoding context of a generation with this newest frame."""
        if self._decoding is Decoding.FREE:
            return DecodingContext(self._context.before)
        turn = self._turn
        return replace(
            self._context, turn=turn.distances(anchor.T_odom_base), turn_may_be_done=turn.may_be_done, keeps_form=True
        )

    def watch(self, ring: TokenRing) -> None:
        """Take the ring's new poses, at most about once a second; call it more often than the ring is long."""
        newest_ns, seen_ns = ring.newest_ns, self._path.newest_ns
        if newest_ns is not None and (seen_ns is None or newest_ns >= seen_ns + PERIOD_NS):
            self._take(ring, newest_ns)

    def past_path(self, ring: TokenRing, anchor: EncodedFrame) -> PastPath:
        """Return the path up to a generation's newest frame, in its robot frame; the next call takes later frames."""
        self._take(ring, anchor.stamp_ns)
        # The ring may have dropped the frame during the generation's wait.
        self._put(anchor.stamp_ns, anchor.T_odom_base)
        return self._path.past_path(anchor.T_odom_base)

    def update(self, text: str, constraint: TextConstraint, anchor: EncodedFrame) -> None:
        """Take a published text's progress, and the model's own turn and stop."""
        self._context = self._context.after(text, constraint)
        parts = parse_text(text)
        if constraint.has_plan and not constraint.overruled:
            self._stop.update(parts, anchor.T_odom_base)
        if parts.progress is None and not constraint.has_plan:
            return  # the text was cut short before turn and stop
        overruled = constraint.overruled or not constraint.has_plan
        claimed = constraint.refused == DONE
        self._turn.update(parts.progress, constraint.turn, anchor, overruled=overruled, claimed=claimed)

    def _take(self, ring: TokenRing, until_ns: int) -> None:
        for stamp_ns, T_odom_base in ring.newest(MOST_FRAMES):
            if stamp_ns <= until_ns:
                self._put(stamp_ns, T_odom_base)

    def _put(self, stamp_ns: int, T_odom_base: SE2) -> None:
        if self.from_ns is None or stamp_ns >= self.from_ns:
            self._path.put(stamp_ns, T_odom_base)
            self._turn.put(stamp_ns, T_odom_base)


@dataclass(frozen=True)
class Job:
    """One instruction and its memory."""

    number: int
    instruction: str
    memory: InstructionMemory


class Instructions:
    """Makes jobs of instructions, and lets control make the turn on the spot that one begins with."""

    def __init__(self, config: ReasoningConfig, slot: SemanticSlot, instruction: str) -> None:
        """`instruction`: the first one."""
        self._config, self._slot = config, slot
        self.job = self._job(0, instruction, None)
        """The newest job."""

    def next(self, instruction: str, newest_ns: int | None) -> Job:
        """Return the job of another instruction, given when the newest frame had this stamp.

        After a turn alone the job before goes on.
        """
        self.job = self._job(self.job.number + 1, instruction, newest_ns)
        return self.job

    def again(self) -> Job:
        """Return the newest job once more, as another one."""
        self.job = replace(self.job, number=self.job.number + 1)
        return self.job

    def ready(self, job: Job, newest_ns: int | None) -> bool:
        """Whether the job's turn has ended; its memory then begins at the newest frame."""
        if self._slot.turn is not None:
            return False
        if job.memory.waits:
            job.memory.begin(newest_ns)
        return True

    def _job(self, number: int, instruction: str, newest_ns: int | None) -> Job:
        turn, rest = split_turn(instruction) if self._config.turns_as_told else (None, instruction)
        if turn is not None and not rest:
            if number == 0:
                turn, rest = None, instruction  # there is nothing to go on with
            else:
                self._slot.tell(turn)
                return replace(self.job, number=number)
        memory = InstructionMemory(newest_ns, rest, self._config.decoding)
        memory.waits = turn is not None
        self._slot.tell(turn)
        return Job(number, rest, memory)


def _words(text: str) -> tuple[str, ...]:
    return tuple(re.findall(r"[a-z]+", text.lower()))


def _stop_m(text: ReasoningText) -> float | None:
    """Return the distance ahead at which a text plans to stop, m; None for another plan."""
    action = None if text.plan is None else text.plan.action
    return float(action.distance_m or STOP_NOW_M) if isinstance(action, Stop) else None
