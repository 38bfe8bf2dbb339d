"""The fast half of the model: shared encoder, semantic context, action expert."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TypeVar, cast

import numpy as np
import numpy.typing as npt
import onnxruntime as ort

from edge.artifacts.manifest import Artifacts
from edge.core.geometry import SE2
from edge.inference.graph import Graph, GraphError, Interrupt, zeros
from edge.inference.scheduling import Schedule, TickActivity, run_as
from edge.state.semantic import Context, SemanticState, waypoints_now

FloatArray = npt.NDArray[np.float32]
Result = TypeVar("Result")


class Policy:
    """π of equation 1, in the three calls that run at different rates.

    `encode` and `act` belong to one thread: their buffers are bound once and written in place.
    """

    def __init__(
        self,
        artifacts: Artifacts,
        *,
        threads: int | None = None,
        provider: str | None = None,
        schedule: Schedule | None = None,
        activity: TickActivity | None = None,
        interrupt: Interrupt | None = None,
    ) -> None:
        """`schedule`: where the graphs' own threads run and how urgently; `activity` records every call of a tick.

        `interrupt` ends every call that is given none of its own.
        """
        control, workers = (schedule.control, schedule.workers) if schedule else (None, None)

        def graph(name: str, cores: Sequence[int]) -> Graph:
            return Graph(artifacts, name, threads=threads, provider=provider, cores=cores, interrupt=interrupt)

        cores = control.cores if control else ()
        self._vision, self._action = run_as(
            control, lambda: (graph("vision_encoder", cores), graph("action_expert", cores))
        )
        self.guided_by_waypoints = artifacts.guided_by_waypoints
        """Whether the semantic context is computed in every tick from the text's waypoints instead of K‖V."""
        role = control if self.guided_by_waypoints else workers
        self._context = run_as(role, lambda: graph("semantic_context", role.cores if role else ()))
        self.artifacts = artifacts
        self._activity = activity or TickActivity(artifacts.runtime.tick_period_ms * 1_000_000)
        self.tokens_shape = zeros(self._vision.contract.output("visual_tokens")).shape
        """Shape of one frame's visual tokens, (1, N, D)."""
        self._encoding, self._acting = self._vision.binding(), self._action.binding()
        self._state, self._latency = (
            cast(FloatArray, zeros(self._action.contract.input(name))) for name in ("state", "latency")
        )
        self._trajectory = cast(FloatArray, zeros(self._action.contract.output("trajectory")))
        self._small = {
            name: ort.OrtValue.ortvalue_from_numpy(buffer)
            for name, buffer in (("state", self._state), ("latency", self._latency))
        }
        self._acting.bind_ortvalue_output("trajectory", ort.OrtValue.ortvalue_from_numpy(self._trajectory))
        self._bound: Context | None = None

    def encode(self, frame: npt.NDArray[np.uint8], out: FloatArray | None = None) -> FloatArray:
        """Encode a frame [1, px, px, 3] to visual tokens [1, N, D] (every new frame, control thread).

        They are written to `out` where given, such as a token ring's next buffer, else to a new array.
        """
        tokens = np.empty(self.tokens_shape, dtype=np.float32) if out is None else out
        if tokens.shape != self.tokens_shape or tokens.dtype != np.float32 or not tokens.flags.c_contiguous:
            raise ValueError(f"out must be a contiguous float32{list(self.tokens_shape)}")
        # Neither call copies data: both set where the graph reads and writes.
        self._encoding.bind_ortvalue_input("frame", ort.OrtValue.ortvalue_from_numpy(frame))
        self._encoding.bind_ortvalue_output("visual_tokens", ort.OrtValue.ortvalue_from_numpy(tokens))
        self._in_tick(lambda: self._vision.run_bound(self._encoding))
        return tokens

    def semantic_context(self, last_layer_kv: FloatArray, interrupt: Interrupt | None = None) -> Context:
        """Project K‖V [1, T, kv_dim] to keys and values for every layer (once a generation, reasoning thread).

        Empty for a policy that is guided by waypoints.
        """
        if self.guided_by_waypoints:
            return {}
        return self.make_context({"last_layer_kv": last_layer_kv}, interrupt)

    def make_context(self, feeds: Context, interrupt: Interrupt | None = None) -> Context:
        """Run the semantic context's graph on its input by name: K‖V or waypoints."""
        outputs = self._context.run(feeds, interrupt=interrupt)
        return dict(zip(self._context.output_names, outputs, strict=True))

    def act(
        self,
        visual_tokens: FloatArray,
        state: tuple[float, float, float],
        delay_s: float,
        offset: SE2,
        semantic: SemanticState,
    ) -> FloatArray:
        """Return the trajectory [steps, 3] in the current robot frame (every tick, control thread).

        Raises GraphError.
        """
        context = semantic.context
        if self.guided_by_waypoints:
            if semantic.waypoints is None:
                raise GraphError("the semantic state has no waypoints to be guided by")
            feeds: Context = {"waypoints": waypoints_now(semantic.waypoints, offset)}
            context = self._in_tick(lambda: self.make_context(feeds))
        if context is not self._bound:
            for name, tensor in context.items():
                self._acting.bind_ortvalue_input(name, ort.OrtValue.ortvalue_from_numpy(tensor))
            self._bound = context
        self._state[0] = state
        self._latency[0] = delay_s, offset.x_m, offset.y_m, offset.theta_rad
        # Bind again in every call: an accelerator's provider copies an input when it is bound.
        self._acting.bind_ortvalue_input("visual_tokens", ort.OrtValue.ortvalue_from_numpy(visual_tokens))
        for name, value in self._small.items():
            self._acting.bind_ortvalue_input(name, value)
        self._in_tick(lambda: self._action.run_bound(self._acting))
        return cast(FloatArray, self._trajectory[0].copy())

    def _in_tick(self, call: Callable[[], Result]) -> Result:
        """Run one call of a tick, to which reasoning gives way, and return its result."""
        self._activity.begin(time.monotonic_ns())
        try:
            return call()
        finally:
            self._activity.end(time.monotonic_ns())
