"""The work of one generation: its frames, its prompt, its result, and the semantic state that the result becomes.

The robot's reasoning thread and the benchmark's virtual time share this work; each decides when a part runs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from edge.inference.graph import GraphError, Interrupt
from edge.inference.language import ContextOverflowError, Generation, GenerationRun, LanguageModel
from edge.inference.policy import Policy
from edge.reasoning.decoding_rules import DecodingContext, TextConstraint
from edge.reasoning.instruction_state import Job
from edge.reasoning.path_memory import PastPath
from edge.reasoning.prompt import format_before
from edge.state.reasoning_text import Waypoints, parse_waypoints
from edge.state.ring import EncodedFrame, TokenRing
from edge.state.semantic import Context, SemanticState


class NotFiniteError(RuntimeError):
    """Keys and values of a generation that contain a NaN or an infinity."""


GENERATION_ERRORS = (GraphError, ContextOverflowError, NotFiniteError)
"""Errors that end one generation and not the run."""


@dataclass(frozen=True)
class GenerationModels:
    """The graphs that a generation runs."""

    language: LanguageModel
    policy: Policy


@dataclass(frozen=True)
class GenerationResult:
    """Decoded text, its semantic context and its waypoints (m in the anchor's frame; None: the text has none)."""

    generation: Generation
    constraint: TextConstraint
    context: Context
    waypoints: Waypoints | None


class GenerationTask:
    """One generation of a job. `older` and the anchor are set before `finish`; for one thread."""

    def __init__(self, models: GenerationModels, job: Job, max_new_tokens: int) -> None:
        self._models = models
        self.job = job
        self.max_new_tokens = max_new_tokens
        self.older: list[EncodedFrame] = []
        """Frames before the anchor, oldest first."""
        self.anchor: EncodedFrame | None = None
        """The newest frame."""
        self._past_path: PastPath = ()
        self._context = DecodingContext()

    def prefill(self, run: GenerationRun, number: int, frame: EncodedFrame) -> None:
        """Prefill an older frame, the `number`th of the prompt, from 1. Raises GraphError, CancelledError."""
        run.feed([self._models.language.prompt.frame(number, frame, self.job.instruction)])

    def set_anchor(self, anchor: EncodedFrame, ring: TokenRing) -> None:
        """Set the newest frame, and read the instruction's memory up to its capture."""
        self.anchor = anchor
        self._past_path, self._context = self.job.memory.past_path(ring, anchor), self.job.memory.context(anchor)

    def finish(
        self,
        run: GenerationRun,
        interrupt: Interrupt | None = None,
        before_context: Callable[[], None] = lambda: None,
    ) -> GenerationResult:
        """Prefill the anchor and the prompt's tail, decode, and compute the semantic context.

        `before_context` is called between decoding and the context's graph. Raises one of GENERATION_ERRORS, or
        CancelledError.
        """
        assert self.anchor is not None
        language, policy = self._models.language, self._models.policy
        prompt = language.prompt
        rest = [
            prompt.frame(len(self.older) + 1, self.anchor, self.job.instruction),
            prompt.tail(self._past_path, self._context.before),
        ]
        constraint = language.constraint(self._context)
        generation = run.finish(rest, max_new_tokens=self.max_new_tokens, constraint=constraint)
        if not np.isfinite(generation.last_layer_kv).all():
            language.kept_ids = ()  # a retry that kept these rows would fail as well
            raise NotFiniteError("keys and values of the last layer are not finite")
        before_context()
        context = policy.semantic_context(generation.last_layer_kv, interrupt)
        return GenerationResult(generation, constraint, context, parse_waypoints(generation.text))

    def publish(self, result: GenerationResult, *, number: int, ready_ns: int, text_complete: bool) -> SemanticState:
        """Return the semantic state of a result that will drive the robot; store its text for the next generation."""
        assert self.anchor is not None
        self.job.memory.update(result.generation.text, result.constraint, self.anchor)
        return SemanticState(
            generation=number,
            anchor_ns=self.anchor.stamp_ns,
            T_odom_anchor=self.anchor.T_odom_base,
            ready_ns=ready_ns,
            last_layer_kv=result.generation.last_layer_kv,
            context=result.context,
            text=result.generation.text,
            waypoints=result.waypoints,
            text_complete=text_complete,
            T_odom_stop=self.job.memory.stop,
        )

    def state_record(self, result: GenerationResult, state: SemanticState) -> dict[str, Any]:
        """Return the `/semantic` record of a published result without the times of the thread that computed it."""
        assert self.anchor is not None
        frames = [*self.older, self.anchor]
        return {
            "generation": state.generation,
            "anchor_ns": state.anchor_ns,
            "anchor_pose": state.T_odom_anchor.as_tuple(),
            "ready_ns": state.ready_ns,
            "instruction": self.job.instruction,
            "frames_ns": [frame.stamp_ns for frame in frames],
            "frame_poses": [frame.T_odom_base.as_tuple() for frame in frames],
            **self.record(result),
            "max_new_tokens": self.max_new_tokens,
            "prefill_ms": result.generation.prefill_ms,
            "decode_ms": result.generation.decode_ms,
        }

    def record(self, result: GenerationResult) -> dict[str, Any]:
        """Return the log record of prompt and result; call it after `publish`."""
        stop = self.job.memory.stop
        return {
            "way": self._past_path,
            "before": format_before(self._context.before),
            **self._context.record(),
            "overruled": result.constraint.overruled,
            "planned": result.constraint.planned,
            "stop": None if stop is None else stop.as_tuple(),
            "prompt_tokens": result.generation.prompt_tokens,
            "new_tokens": result.generation.new_tokens,
            "decode_calls": len(result.generation.call_tokens),
            "call_tokens": result.generation.call_tokens,
            "text": result.generation.text,
            "waypoints": result.waypoints,
        }
