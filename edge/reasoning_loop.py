"""The slow thread: frames from the ring buffer → generation → one assignment of a new semantic state (Algorithm 4)."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable

from edge.graph import GraphError
from edge.language import CancelledError, ContextOverflowError, LanguageModel
from edge.policy import Policy
from edge.reasoning_text import parse_waypoints
from edge.recorder import Recorder
from edge.ring import EncodedFrame, TokenRing
from edge.semantic import SemanticState

IDLE_S = 0.02
NICENESS = 10


class SemanticSlot:
    """Where the reasoning thread leaves its newest result; reading and replacing `state` are single operations."""

    def __init__(self) -> None:
        self.state: SemanticState | None = None


class ReasoningLoop:
    """Generates without pause; each result is held back by `release_delay_s()` before the control thread sees it."""

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
        release_delay_s: Callable[[], float],
        recorder: Recorder | None,
        stop: threading.Event,
    ) -> None:
        self._language = language
        self._policy = policy
        self._ring = ring
        self._slot = slot
        self._instruction = instruction
        self._offsets_s = frame_offsets_s
        self._max_new_tokens = max_new_tokens
        self._release_delay_s = release_delay_s
        self._recorder = recorder
        self._stop = stop
        self._last_anchor_ns = -1
        self.generations = 0
        self.failed = 0
        self.invalid_texts = 0
        self.generation_ms: list[float] = []

    def run(self) -> None:
        """Loop until `stop`; a failed generation is counted and the next one is tried."""
        with contextlib.suppress(OSError):
            # Linux niceness is per thread: when both threads want the core, control gets it.
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
        while not self._stop.is_set():
            frames = self._ring.select(self._offsets_s)
            if not frames or frames[-1].stamp_ns == self._last_anchor_ns:
                self._stop.wait(IDLE_S)
                continue
            try:
                self._generate(frames)
            except CancelledError:
                return
            except (GraphError, ContextOverflowError):
                self.failed += 1
                self._stop.wait(IDLE_S)

    def _generate(self, frames: list[EncodedFrame]) -> None:
        anchor = frames[-1]
        self._last_anchor_ns = anchor.stamp_ns
        started_ns = time.monotonic_ns()
        generation = self._language.generate(
            self._language.prompt.build(frames, self._instruction),
            max_new_tokens=self._max_new_tokens,
            cancelled=self._stop.is_set,
        )
        context_started_ns = time.monotonic_ns()
        context = self._policy.semantic_context(generation.last_layer_kv)
        finished_ns = time.monotonic_ns()
        delay_s = self._release_delay_s()
        if self._stop.wait(delay_s):
            raise CancelledError
        waypoints = parse_waypoints(generation.text)
        ready_ns = time.monotonic_ns()
        self._slot.state = SemanticState(
            generation=self.generations,
            anchor_ns=anchor.stamp_ns,
            T_odom_anchor=anchor.T_odom_base,
            ready_ns=ready_ns,
            last_layer_kv=generation.last_layer_kv,
            context=context,
            text=generation.text,
            waypoints=waypoints,
        )
        self.generation_ms.append((finished_ns - started_ns) / 1e6)
        if waypoints is None:
            self.invalid_texts += 1
        if self._recorder is not None:
            record = {
                "generation": self.generations,
                "anchor_ns": anchor.stamp_ns,
                "anchor_pose": anchor.T_odom_base.as_tuple(),
                "started_ns": started_ns,
                "finished_ns": finished_ns,
                "ready_ns": ready_ns,
                "release_delay_s": delay_s,
                "frames_ns": [frame.stamp_ns for frame in frames],
                "prompt_tokens": generation.prompt_tokens,
                "new_tokens": generation.new_tokens,
                "text": generation.text,
                "waypoints": waypoints,
                "prefill_ms": generation.prefill_ms,
                "decode_ms": generation.decode_ms,
                "context_ms": (finished_ns - context_started_ns) / 1e6,
            }
            self._recorder.put("/semantic", ready_ns, record)
        self.generations += 1
