"""Reasoning in virtual time (paper appendix D, Algorithms 3 and 4): a generation started at t is released at t + L.

There is no thread and no clock: call `release` before each tick of the control loop and `start` after it. A generation
is computed at its release from the frames that it captured, so its real computing time has no effect.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from edge.inference.graph import GraphError
from edge.inference.language import ContextOverflowError, Generation, LanguageModel
from edge.inference.policy import Policy
from edge.reasoning.decoding_rules import DecodingContext, TextConstraint
from edge.reasoning.instruction_state import InstructionMemory
from edge.reasoning.path_memory import Way
from edge.reasoning.prompt import told_before
from edge.reasoning.sync_halt import seen_standing
from edge.run.reasoning_loop import FAILURE_WINDOW_S, FAILURES, RETRY_S, SYNC_DRIVE_S, Mode
from edge.state.reasoning_text import parse_waypoints
from edge.state.ring import EncodedFrame, TokenRing
from edge.state.semantic import SemanticSlot, SemanticState
from edge.state.switches import Decoding
from sim_hil.benchmark.conditions.latency import Timing


@dataclass
class _UnderWay:
    """A started generation; `frames` is None until its newest frame is captured."""

    started_ns: int
    timing: Timing
    frames: list[EncodedFrame] | None = None
    way: Way = ()
    context: DecodingContext = field(default_factory=DecodingContext)

    @property
    def release_ns(self) -> int:
        return self.started_ns + self.timing.total_ns

    @property
    def capture_ns(self) -> int:
        return self.started_ns + self.timing.anchor_after_ns


class LockstepReasoner:
    """Reasoner that runs one generation at a time; the next starts at its release (sync: when the robot stands)."""

    def __init__(
        self,
        *,
        language: LanguageModel,
        policy: Policy,
        ring: TokenRing,
        slot: SemanticSlot,
        instruction: str,
        frame_offsets_s: tuple[float, ...],
        max_new_tokens: int,
        draw: Callable[[], Timing],
        mode: Mode,
        decoding: Decoding = Decoding.CONSTRAINED,
    ) -> None:
        self._language = language
        self._policy = policy
        self._ring = ring
        self._slot = slot
        self._instruction = instruction
        self._memory = InstructionMemory(None, instruction, decoding)
        self._offsets_s = sorted({offset_s for offset_s in frame_offsets_s if offset_s > 0}, reverse=True)
        self._max_new_tokens = 0 if mode is Mode.NO_REASONING else max_new_tokens
        self._draw = draw
        self._sync = mode is Mode.SYNC
        self._under_way: _UnderWay | None = None
        self._retry_ns = 0
        self._failures: deque[int] = deque(maxlen=FAILURES)
        if self._sync:
            slot.drive_until_ns = 0
        self.failure: str | None = None
        """Why reasoning ended permanently; None while it runs."""
        self.failed = 0
        self.invalid_in_a_row = 0
        """Number of consecutive complete texts, up to the newest, that the grammar rejects."""
        self.released: list[Mapping[str, Any]] = []
        """One record per released generation, as JSON values."""

    @property
    def thinking_since_ns(self) -> int | None:
        """Start time of the current generation, ns; None if there is none."""
        return None if self._under_way is None else self._under_way.started_ns

    def release(self, now_ns: int) -> None:
        """Publish the current generation if its release time is reached; call before a tick."""
        job = self._under_way
        if job is None or job.frames is None or now_ns < job.release_ns:
            return
        self._under_way = None
        try:
            self._publish(job, job.frames, now_ns)
        except (GraphError, ContextOverflowError, _NotFiniteError) as error:
            self._fail(str(error), now_ns)

    def start(self, now_ns: int) -> None:
        """Start a generation, or capture its late newest frame; call after a tick, which adds its frame to the ring."""
        if self._under_way is None and self._may_start(now_ns):
            self._under_way = _UnderWay(now_ns, self._draw())
        job = self._under_way
        if job is not None and job.frames is None and now_ns >= job.capture_ns:
            job.frames = self._frames()
            if job.frames is not None:
                job.way = self._memory.way(self._ring, job.frames[-1])
                job.context = self._memory.context(job.frames[-1])
        self._memory.watch(self._ring)

    def _may_start(self, now_ns: int) -> bool:
        if self.failure is not None or now_ns < self._retry_ns:
            return False
        return seen_standing(self._ring.newest(2), self._slot.drive_until_ns)

    def _frames(self) -> list[EncodedFrame] | None:
        """Return the available frames at the offsets, oldest first; same selection as in the reasoning thread."""
        newest_ns = self._ring.newest_ns
        anchor = None if newest_ns is None else self._ring.nearest(newest_ns)
        if anchor is None:
            return None
        frames: list[EncodedFrame] = []
        for offset_s in self._offsets_s:
            frame = self._ring.nearest(anchor.stamp_ns - round(offset_s * 1e9))
            after_ns = frames[-1].stamp_ns if frames else None
            if (
                frame is not None
                and frame.stamp_ns < anchor.stamp_ns
                and (after_ns is None or frame.stamp_ns > after_ns)
            ):
                frames.append(frame)
        return [*frames, anchor]

    def _generate(self, job: _UnderWay, frames: list[EncodedFrame], constraint: TextConstraint) -> Generation:
        prompt = self._language.prompt
        run = self._language.begin(lambda: False)
        for number, frame in enumerate(frames[:-1], 1):
            run.feed([prompt.frame(number, frame, self._instruction)])
        rest = [prompt.frame(len(frames), frames[-1], self._instruction), prompt.tail(job.way, job.context.before)]
        generation = run.finish(rest, max_new_tokens=self._max_new_tokens, constraint=constraint)
        if not np.isfinite(generation.last_layer_kv).all():
            raise _NotFiniteError("keys and values of the last layer are not finite")
        return generation

    def _publish(self, job: _UnderWay, frames: list[EncodedFrame], now_ns: int) -> None:
        constraint, anchor = self._language.constraint(job.context), frames[-1]
        generation = self._generate(job, frames, constraint)
        context = self._policy.semantic_context(generation.last_layer_kv)
        waypoints = parse_waypoints(generation.text)
        complete = self._max_new_tokens > 0
        if complete:
            self.invalid_in_a_row = 0 if waypoints is not None else self.invalid_in_a_row + 1
        number = len(self.released)
        guided = waypoints is not None or not self._policy.guided_by_waypoints
        if guided:
            self._memory.update(generation.text, constraint, anchor)
        stop = self._memory.stop
        self.released.append(
            {
                "generation": number,
                "started_s": job.started_ns / 1e9,
                "anchor_s": anchor.stamp_ns / 1e9,
                "released_s": now_ns / 1e9,
                "frames": len(frames),
                "way": [list(point) for point in job.way],
                "before": told_before(job.context.before),
                **job.context.record(),
                "overruled": constraint.overruled,
                "planned": constraint.planned,
                "stop": None if stop is None else list(stop.as_tuple()),
                "prompt_tokens": generation.prompt_tokens,
                "new_tokens": generation.new_tokens,
                "text": generation.text,
                "waypoints": None if waypoints is None else [list(point) for point in waypoints],
                "used": guided,
            }
        )
        if not guided:
            return  # the previous state keeps ageing; the supervisor slows the robot down by its age
        self._slot.state = SemanticState(
            generation=number,
            anchor_ns=anchor.stamp_ns,
            T_odom_anchor=anchor.T_odom_base,
            ready_ns=now_ns,
            last_layer_kv=generation.last_layer_kv,
            context=context,
            text=generation.text,
            waypoints=waypoints,
            text_complete=complete,
            T_odom_stop=stop,
        )
        if self._sync:
            self._slot.drive_until_ns = now_ns + round(SYNC_DRIVE_S * 1e9)

    def _fail(self, why: str, now_ns: int) -> None:
        self.failed += 1
        self._retry_ns = now_ns + round(RETRY_S * 1e9)
        self._failures.append(now_ns)
        if len(self._failures) == FAILURES and now_ns - self._failures[0] <= FAILURE_WINDOW_S * 1e9:
            self.failure = f"{FAILURES} generations failed within {FAILURE_WINDOW_S:g} s, the last one: {why}"


class _NotFiniteError(RuntimeError):
    """Keys and values that contain NaN or infinity."""
