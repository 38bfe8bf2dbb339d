"""The generation cycle in virtual time (paper appendix D, Algorithms 3 and 4): starts at t, is released at t + L.

No thread and no clock: call `release` before each tick of the control loop, `start` after it. A generation is computed
from the frames that it captured, so the computer's speed changes nothing: when it is released, or, where its latency
depends on its decoding calls, when they are captured.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from edge.flightlog.recorder import RecordSink
from edge.inference.generation_task import GENERATION_ERRORS, GenerationModels, GenerationResult, GenerationTask
from edge.reasoning.anchor import Anchor, older_frames
from edge.reasoning.generation_cycle import (
    Action,
    Anchored,
    CycleInputs,
    CycleOutputs,
    Event,
    Failed,
    Finished,
    GenerationCycle,
    ReasoningConfig,
)
from edge.reasoning.instruction_state import Instructions
from edge.state.semantic import SharedState
from sim_hil.benchmark.conditions.latency import Timing


@dataclass
class _UnderWay:
    """Generation in progress; its anchor is set when its newest frame is captured."""

    started_ns: int
    timing: Timing
    task: GenerationTask
    result: GenerationResult | None = None
    decode_ns: int = 0
    """Duration of the decoding calls after the first token, where the latency depends on them."""

    @property
    def release_ns(self) -> int:
        return self.started_ns + self.timing.total_ns + self.decode_ns

    @property
    def capture_ns(self) -> int:
        return self.started_ns + self.timing.anchor_after_ns


class VirtualTimeReasoner:
    """Runs one generation at a time; the next starts at the release (sync: when the robot stands)."""

    def __init__(
        self,
        models: GenerationModels,
        shared: SharedState,
        config: ReasoningConfig,
        instruction: str,
        draw: Callable[[], Timing],
        recorder: RecordSink | None = None,
    ) -> None:
        """`draw` returns the latency of the next generation; `recorder` takes the published ones."""
        self._recorder = recorder
        self._models = models
        self._ring, self._slot = shared.ring, shared.slot
        self._offsets_s = config.older_offsets_s
        self._instructions = Instructions(config, shared.slot, instruction)
        self._job = self._instructions.job
        self._draw = draw
        self._under_way: _UnderWay | None = None
        self.cycle = GenerationCycle(config)
        """Generation cycle with its counts, and the reason for the end of reasoning."""
        self._slot.drive_until_ns = self.cycle.drive_until_ns
        self.released: list[Mapping[str, Any]] = []
        """Record of every generation with a result, as JSON values."""

    @property
    def started_ns(self) -> int | None:
        """Start of the current generation, ns; None without one."""
        return None if self._under_way is None else self._under_way.started_ns

    def release(self, now_ns: int) -> None:
        """Compute and publish the current generation if it is due; call this before each tick."""
        under_way = self._under_way
        if under_way is None or under_way.task.anchor is None or now_ns < under_way.release_ns:
            return
        self._under_way = None
        result = under_way.result or self._compute(under_way.task, now_ns)
        if result is None:
            return
        has_waypoints, needs_waypoints = result.waypoints is not None, self._models.policy.guided_by_waypoints
        outputs = self._advance(now_ns, Finished(now_ns, result.generation.new_tokens, has_waypoints, needs_waypoints))
        self._publish(under_way, result, outputs, now_ns)

    def start(self, now_ns: int) -> None:
        """Start a generation, or capture a late newest frame; call this after each tick, whose frame is in the ring."""
        if not self._instructions.ready(self._job, self._ring.newest_ns):
            return
        if self._under_way is None:
            outputs = self._advance(now_ns)
            if outputs.action is Action.START:
                task = GenerationTask(self._models, self._job, outputs.max_new_tokens)
                self._under_way = _UnderWay(now_ns, self._draw(), task)
        under_way = self._under_way
        if under_way is not None and under_way.task.anchor is None and now_ns >= under_way.capture_ns:
            self._capture(under_way.task, now_ns)
            if under_way.task.anchor is not None and under_way.timing.decode_ns is not None:
                self._compute_calls(under_way, under_way.timing.decode_ns, now_ns)
        self._job.memory.watch(self._ring)

    def _advance(self, now_ns: int, event: Event | None = None) -> CycleOutputs:
        return self.cycle.step(CycleInputs(self._ring.newest(2), event=event), now_ns)

    def _capture(self, task: GenerationTask, now_ns: int) -> None:
        """Capture the newest frame and the older ones that the reasoning thread would select."""
        newest_ns = self._ring.newest_ns
        anchor = None if newest_ns is None else self._ring.nearest(newest_ns)
        if anchor is None:
            return
        task.older += older_frames(self._ring, Anchor.now(anchor.stamp_ns), self._offsets_s, task.job.memory.from_ns)
        task.set_anchor(anchor, self._ring)
        self._advance(now_ns, Anchored(anchor.stamp_ns))

    def _compute(self, task: GenerationTask, now_ns: int) -> GenerationResult | None:
        """Return the generation's result; None: it failed."""
        try:
            run = self._models.language.begin(lambda: False)
            for number, frame in enumerate(task.older, 1):
                task.prefill(run, number, frame)
            return task.finish(run)
        except GENERATION_ERRORS as error:
            self._advance(now_ns, Failed(str(error)))
            return None

    def _compute_calls(self, under_way: _UnderWay, decode_ns: Callable[[Sequence[int]], int], now_ns: int) -> None:
        """Compute the result now, because its release depends on the calls that its text takes."""
        under_way.result = self._compute(under_way.task, now_ns)
        if under_way.result is None:
            self._under_way = None
        else:
            under_way.decode_ns = decode_ns(under_way.result.generation.call_tokens[1:])

    def _publish(self, under_way: _UnderWay, result: GenerationResult, outputs: CycleOutputs, now_ns: int) -> None:
        task, number = under_way.task, len(self.released)
        assert task.anchor is not None
        used = outputs.action is Action.PUBLISH
        if used:
            self._slot.state = task.publish(result, number=number, ready_ns=now_ns, text_complete=outputs.text_complete)
            self._slot.drive_until_ns = outputs.drive_until_ns
            if self._recorder is not None:
                times = {"started_ns": under_way.started_ns, "finished_ns": now_ns, "release_delay_s": 0.0}
                record = {**times, **task.state_record(result, self._slot.state), "context_ms": 0.0}
                self._recorder.put("/semantic", now_ns, record)
        self.released.append(
            {
                "generation": number,
                "started_s": under_way.started_ns / 1e9,
                "anchor_s": task.anchor.stamp_ns / 1e9,
                "released_s": now_ns / 1e9,
                "frames": len(task.older) + 1,
                **task.record(result),
                "used": used,
            }
        )
