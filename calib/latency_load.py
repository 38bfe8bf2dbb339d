"""Runs the runner's reasoning thread beside ticks that encode and act, without a robot."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import Artifacts
from edge.core.geometry import SE2
from edge.inference.generation_task import GenerationModels
from edge.inference.graph import GraphError
from edge.inference.language import ContextOverflowError
from edge.inference.latency_profile import times_of
from edge.inference.policy import Policy
from edge.inference.scheduling import GiveWay, Schedule, TickActivity, enter, schedule_for
from edge.inference.speculation import next_rows
from edge.inference.start_guard import WARM_UP_S
from edge.inference.warm_up import open_proven, warm_up
from edge.reasoning.generation_cycle import Mode, ReasoningConfig
from edge.run.reasoning_loop import ReasoningLoop, ReasoningOutputs, ReasoningSchedule
from edge.state.frame import fit_frame
from edge.state.ring import EncodedFrame, TokenRing
from edge.state.semantic import SemanticSlot, SharedState
from export.evaluation.calibration import Clip

WARM: Final = 3
"""First generations that are left out: their waits depend on earlier durations."""
SAY_EVERY_S: Final = 15.0
POLL_S: Final = 0.05
JOIN_S: Final = 5.0


class MeasureError(RuntimeError):
    """An unusable measurement; one line."""


@dataclass(frozen=True)
class Decoding:
    """Time of a generation's decoding calls after its first token, s, and the tokens that each call fed."""

    after_first_s: float
    call_tokens: tuple[int, ...]


@dataclass(frozen=True)
class Measured:
    """Measurement: (generation time, time from its start to its newest frame), s, and the ticks beside it."""

    times_s: tuple[tuple[float, float], ...]
    ticks: int
    late: int
    """Number of ticks that ended after the next one's deadline."""
    failed: int
    decoding: tuple[Decoding, ...]
    """Decoding of each of the generations."""
    call_ns: Mapping[int, float]
    """Duration of a decoding call alone by its permitted number of rows, ns; without guesses all equal."""

    @property
    def call_s(self) -> tuple[tuple[int, float], ...]:
        """Duration of a call beside control by its number of rows, s; empty without calls after the first token.

        The durations alone, all times one factor that gives the time that all calls took together.
        """
        alone_ns = sum(self.call_ns[rows] for decoding in self.decoding for rows in self._rows(decoding))
        if not alone_ns:
            return ()
        factor = sum(decoding.after_first_s for decoding in self.decoding) / alone_ns
        return tuple((rows, self.call_ns[rows] * factor) for rows in sorted(self.call_ns))

    def _rows(self, decoding: Decoding) -> list[int]:
        return [next_rows(sorted(self.call_ns), tokens) for tokens in decoding.call_tokens[1:]]


@dataclass
class Generations:
    """Collects the records of generations in place of a flight log."""

    times_s: list[tuple[float, float]] = field(default_factory=list)
    decoding: list[Decoding] = field(default_factory=list)

    def put(self, topic: str, _stamp_ns: int, record: Mapping[str, Any]) -> None:
        """Store the times of a finished generation."""
        if topic == "/semantic":
            self.decoding.append(Decoding(record["decode_ms"] / 1e3, tuple(record["call_tokens"])))
            self.times_s.append(times_of(record))


class Ticks:
    """The control thread's work at its rate: encode a picture into the ring, run the action expert."""

    def __init__(
        self, artifacts: Artifacts, policy: Policy, ring: TokenRing, slot: SemanticSlot, clip: Clip, schedule: Schedule
    ) -> None:
        self._policy, self._ring, self._slot, self._schedule = policy, ring, slot, schedule
        self._period_ns = artifacts.runtime.tick_period_ms * 1_000_000
        self._pictures = [fit_frame(frame.image, artifacts.runtime.image_px) for frame in clip.frames]
        self._poses = [frame.T_odom_base for frame in clip.frames]
        self.ticks = self.late = 0
        self.error = ""

    def run(self, stop: threading.Event) -> None:
        """Tick until `stop` on absolute deadlines; skip missed ones."""
        enter(self._schedule.control)
        deadline_ns = time.monotonic_ns() + self._period_ns
        try:
            while not stop.wait(max(0.0, (deadline_ns - time.monotonic_ns()) / 1e9)):
                self._tick()
                now_ns = time.monotonic_ns()
                deadline_ns += self._period_ns
                if now_ns > deadline_ns:
                    self.late += 1
                    deadline_ns += math.ceil((now_ns - deadline_ns) / self._period_ns) * self._period_ns
        except (GraphError, ValueError) as error:
            self.error = str(error)
            stop.set()

    def _tick(self) -> None:
        now_ns = time.monotonic_ns()
        # The clip's pictures are about a second apart; each stays the input for as long.
        index = (self.ticks * self._period_ns // 1_000_000_000) % len(self._pictures)
        tokens = self._policy.encode(self._pictures[index], self._ring.next_buffer())
        self._ring.put(EncodedFrame(now_ns, self._poses[index], tokens))
        state = self._slot.state
        if state is not None and (state.waypoints is not None or not self._policy.guided_by_waypoints):
            delay_s = (now_ns - state.anchor_ns) / 1e9
            self._policy.act(tokens, (0.5, 0.0, 0.0), delay_s, SE2(0.0, 0.0, 0.0), state)
        self.ticks += 1


def measure(
    artifacts: Artifacts,
    clip: Clip,
    *,
    instruction: str,
    mode: Mode,
    generations: int,
    seconds: float,
    say: Callable[[str], None],
    stop: threading.Event,
) -> Measured:
    """Run both threads until the number of generations or the time limit is reached, or until `stop`.

    Raises ArtifactError, InstructionError, MeasureError.
    """
    # Here: they load every robot's protocol, which no other job of `edge-calib` needs.
    from edge.run.assembly import HISTORY_MARGIN_S
    from edge.run.command import SWITCH_INTERVAL_S

    runtime = artifacts.runtime
    schedule = schedule_for(artifacts)
    activity = TickActivity(runtime.tick_period_ms * 1_000_000)
    opened = open_proven(artifacts, schedule=schedule, activity=activity)
    policy, language = opened.policy, opened.language
    language.check_instruction(instruction)
    try:
        with opened.guard.stage("warming up", WARM_UP_S):
            warm_up(policy, language, runtime.speculation)
    except (GraphError, ContextOverflowError) as error:
        raise ArtifactError(f"{artifacts.directory}: the graphs do not run ({error})") from error
    slot, found = SemanticSlot(), Generations()
    capacity = math.ceil((max(runtime.frame_offsets_s) + HISTORY_MARGIN_S) * 1e3 / runtime.tick_period_ms)
    ring = TokenRing(capacity, policy.tokens_shape)
    ticks = Ticks(artifacts, policy, ring, slot, clip, schedule)
    reasoning = ReasoningLoop(
        GenerationModels(language, policy),
        SharedState(ring, slot),
        ReasoningConfig(runtime.frame_offsets_s, runtime.max_new_tokens, mode, turns_as_told=False),
        instruction,
        stop=stop,
        schedule=ReasoningSchedule(give_way=GiveWay(activity) if schedule.shared else None, role=schedule.reasoning),
        outputs=ReasoningOutputs(found, say),  # type: ignore[arg-type]  # it only puts
    )
    threads = [
        threading.Thread(target=lambda: ticks.run(stop), name="control", daemon=True),
        threading.Thread(target=reasoning.run, name="reasoning", daemon=True),
    ]
    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    try:
        for thread in threads:
            thread.start()
        _wait(found, generations + WARM, seconds, stop, say)
    finally:
        stop.set()
        reasoning.cancel()
        for thread in threads:
            thread.join(JOIN_S)
        sys.setswitchinterval(interval_s)
    why = ticks.error or reasoning.cycle.failure
    if why:
        raise MeasureError(f"it ended by itself: {why}")
    count = len(found.times_s)
    times_s, decoding = tuple(found.times_s[WARM:]), tuple(found.decoding[WARM:count])
    call_ns = dict.fromkeys(language.rows, 1.0) if language.speculator is None else language.speculator.call_ns
    return Measured(times_s, ticks.ticks, ticks.late, reasoning.cycle.failed, decoding, call_ns)


def _wait(found: Generations, wanted: int, seconds: float, stop: threading.Event, say: Callable[[str], None]) -> None:
    started_s = said_s = time.monotonic()
    while len(found.times_s) < wanted and not stop.wait(POLL_S):
        now_s = time.monotonic()
        if now_s - started_s > seconds:
            return
        if now_s - said_s > SAY_EVERY_S:
            said_s = now_s
            say(f"{max(0, len(found.times_s) - WARM)} of {wanted - WARM} generations, {now_s - started_s:.0f} s")
