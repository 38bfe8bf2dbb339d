"""Reasoning beside a policy that is being trained: the robot's generation cycle, memory and prompt in virtual time.

Algorithm 2, lines 5 and 6: "run VLM inference asynchronously in the background; retrieve the delayed hidden state".
`VirtualTimeReasoner` runs the generations, as in the benchmark.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from edge.artifacts.manifest import Artifacts
from edge.core.geometry import SE2
from edge.inference.generation_task import GenerationModels
from edge.inference.graph import Interrupt
from edge.inference.language import LanguageModel
from edge.inference.policy import Policy
from edge.reasoning.generation_cycle import Mode, ReasoningConfig
from edge.run.assembly import semantic_config
from edge.safety.monitors.semantic import SemanticMonitor
from edge.state.frame import fit_frame
from edge.state.ring import EncodedFrame, TokenRing
from edge.state.semantic import Context, SemanticSlot, SemanticState, SharedState
from sim_hil.benchmark.conditions.latency import Timing
from sim_hil.benchmark.policies.artifacts_policy import CONTROL_PERIOD_NS, RING_S
from sim_hil.benchmark.policies.lockstep_reasoner import VirtualTimeReasoner

START_NS = 1_000_000_000
"""Virtual time at an episode's start, ns; not zero, because stamps are never zero."""


class _NoContextPolicy:
    """A policy without a semantic context: the trained action expert reads keys and values itself."""

    guided_by_waypoints = False

    def semantic_context(self, last_layer_kv: npt.NDArray[np.float32], interrupt: Interrupt | None = None) -> Context:
        """Return an empty context."""
        return {}


class Models:
    """Encoder and language model of exported artifacts, opened once for many episodes with one thread each."""

    def __init__(self, artifacts: Artifacts) -> None:
        self.artifacts = artifacts
        # Judge semantic states by their age alone: the training does not change the text.
        self.ages = replace(semantic_config(artifacts, Mode.ASYNC), judge_text=False)
        self.policy = Policy(artifacts, threads=1)
        self.language = LanguageModel(artifacts, threads=1)

    def encode(self, image: npt.NDArray[np.uint8], out: npt.NDArray[np.float32] | None) -> npt.NDArray[np.float32]:
        """Encode an image [h, w, 3] as visual tokens [1, N, D]."""
        return self.policy.encode(fit_frame(image, self.artifacts.runtime.image_px), out)


class RolloutReasoner:
    """Frames, instruction memory and generations of one episode; `draw` returns the latency of the next generation."""

    def __init__(self, models: Models, instruction: str, draw: Callable[[], Timing]) -> None:
        runtime = models.artifacts.runtime
        self._models = models
        self._ages, self._monitor = models.ages, SemanticMonitor(models.ages)
        self._slot = SemanticSlot()
        self._ring = TokenRing(round(RING_S * 1e9) // CONTROL_PERIOD_NS, models.policy.tokens_shape)
        stand_in: Any = _NoContextPolicy()
        self._reasoner = VirtualTimeReasoner(
            GenerationModels(models.language, stand_in),
            SharedState(self._ring, self._slot),
            ReasoningConfig(runtime.frame_offsets_s, runtime.max_new_tokens),
            instruction,
            draw,
        )

    def observe(self, time_s: float, image: npt.NDArray[np.uint8], T_odom_base: SE2) -> npt.NDArray[np.float32]:
        """Begin a control period: release the generation that is due and encode the frame.

        Returns a copy of the frame's visual tokens [1, N, D].
        """
        now_ns = START_NS + round(time_s * 1e9)
        self._reasoner.release(now_ns)
        tokens = self._models.encode(image, self._ring.next_buffer())
        self._ring.put(EncodedFrame(now_ns, T_odom_base, tokens))
        return tokens.copy()

    def start_generation(self, time_s: float) -> None:
        """End a control period: start the next generation if none is under way."""
        self._reasoner.start(START_NS + round(time_s * 1e9))

    @property
    def semantic(self) -> SemanticState | None:
        """The semantic state released last; None before the first."""
        return self._slot.state

    def metadata(self, time_s: float, T_odom_base: SE2) -> tuple[float, float, float, float]:
        """(Δt s, Δx m, Δy m, Δθ rad) of that state now, as on the robot; zeros before the first."""
        state = self._slot.state
        if state is None:
            return (0.0, 0.0, 0.0, 0.0)
        now_ns = START_NS + round(time_s * 1e9)
        latency = state.latency_input(now_ns, T_odom_base, self._ages.trained_delay_s)
        return (latency.delay_s, *latency.offset.as_tuple())

    def speed_scale(self, time_s: float) -> float:
        """Share of the speed limits, 0 to 1, that the robot's monitor leaves at the age of the semantic state."""
        found = self._monitor.step(self._slot.state, 0, START_NS + round(time_s * 1e9))
        return min((each.speed_scale or 0.0 for each in found), default=1.0)

    @property
    def failure(self) -> str | None:
        """Why reasoning has ended for this episode; None while it continues."""
        return self._reasoner.cycle.failure
