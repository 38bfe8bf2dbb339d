"""The policies that reinforcement learning trains, while they drive one episode.

`TailPolicy` is the action expert with asynchronous reasoning; `PointGoalRolloutPolicy` is the paper's baseline without
language.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch

from edge.artifacts.manifest import Artifacts
from edge.core.geometry import SE2
from edge.inference.language import LanguageModel
from edge.inference.policy import Policy
from edge.run.assembly import semantic_config
from edge.run.reasoning_loop import Mode
from edge.safety.monitors.semantic import SemanticMonitor
from edge.state.frame import fit_frame
from edge.state.ring import EncodedFrame, TokenRing
from edge.state.semantic import Context, SemanticSlot, SemanticState
from export.model.action import ActionExpert
from export.model.vision import VisionEncoder
from sim_hil.benchmark.conditions.latency import Timing
from sim_hil.benchmark.policies.artifacts_policy import CONTROL_PERIOD_NS, RING_S
from sim_hil.benchmark.policies.lockstep_reasoner import LockstepReasoner
from tools.train.imitate.trainable_policies import PointGoalNet
from tools.train.rl.action_tail import CommandLimits, command_mean, now_of, prefix, semantic_of, tail
from tools.train.rl.rollout import PolicyOutput

Floats = npt.NDArray[np.float32]


class RolloutPolicy(Protocol):
    """A trained policy during one episode; every control period calls `observe`, `choose`, then `start_generation`."""

    @property
    def semantic(self) -> Sequence[Floats]:
        """Semantic tokens [T, hidden] of each generation that an action was based on."""
        ...

    @property
    def failure(self) -> str | None:
        """Why the policy cannot continue; None while it can."""
        ...

    def observe(self, time_s: float, image: npt.NDArray[np.uint8], T_odom_base: SE2) -> Floats:
        """Take in the newest image [h, w, 3] and return its visual tokens [1, N, D]."""
        ...

    def choose(
        self, visual: Floats, state: tuple[float, ...], goal_m: tuple[float, float], time_s: float, T_odom_base: SE2
    ) -> PolicyOutput | None:
        """Compute the mean command; None before the first semantic state. `goal_m` (x, y) is in the robot frame."""
        ...

    def start_generation(self, time_s: float) -> None:
        """Start the next generation unless one is running or the policy has none."""
        ...


START_NS = 1_000_000_000
"""Virtual time at an episode's start, ns; not zero, because stamps are never zero."""


class _NoContextPolicy:
    """A policy without a semantic context: the trained action expert reads keys and values itself."""

    guided_by_waypoints = False

    def semantic_context(self, last_layer_kv: npt.NDArray[np.float32]) -> Context:
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


class TailPolicy:
    """The action expert acting on the last released generation (Algorithm 2, lines 4 to 9), for one episode.

    `LockstepReasoner` runs the generations in virtual time, as in the benchmark; `draw` returns their latencies.
    """

    def __init__(
        self, models: Models, expert: ActionExpert, limits: CommandLimits, instruction: str, draw: Callable[[], Timing]
    ) -> None:
        runtime = models.artifacts.runtime
        self._models, self._expert, self._limits = models, expert, limits
        self._monitor = SemanticMonitor(models.ages)
        self.slot = SemanticSlot()
        self._ring = TokenRing(round(RING_S * 1e9) // CONTROL_PERIOD_NS, models.policy.tokens_shape)
        stand_in: Any = _NoContextPolicy()
        self._reasoner = LockstepReasoner(
            language=models.language,
            policy=stand_in,
            ring=self._ring,
            slot=self.slot,
            instruction=instruction,
            frame_offsets_s=runtime.frame_offsets_s,
            max_new_tokens=runtime.max_new_tokens,
            draw=draw,
            mode=Mode.ASYNC,
        )
        self._number: int | None = None
        self._tokens = torch.empty(0)
        self.semantic: list[Floats] = []

    @property
    def failure(self) -> str | None:
        """Why reasoning has ended for good; None while it continues."""
        return self._reasoner.failure

    def observe(self, time_s: float, image: npt.NDArray[np.uint8], T_odom_base: SE2) -> Floats:
        """Release the generation that is due and encode the frame; return a copy of its visual tokens."""
        now_ns = START_NS + round(time_s * 1e9)
        self._reasoner.release(now_ns)
        tokens = self._models.encode(image, self._ring.next_buffer())
        self._ring.put(EncodedFrame(now_ns, T_odom_base, tokens))
        return tokens.copy()

    def choose(
        self, visual: Floats, state: tuple[float, ...], goal_m: tuple[float, float], time_s: float, T_odom_base: SE2
    ) -> PolicyOutput | None:
        """See `RolloutPolicy`; the goal is not used."""
        semantic = self.slot.state
        if semantic is None:
            return None
        if semantic.generation != self._number:
            self._number = semantic.generation
            self._tokens = semantic_of(self._expert, torch.from_numpy(semantic.last_layer_kv))
            self.semantic.append(self._tokens[0].numpy().copy())
        latency = self.latency(semantic, time_s, T_odom_base)
        now = now_of(self._expert, torch.from_numpy(visual), torch.tensor([state]), torch.tensor([latency]))
        x = prefix(self._expert, now, self._tokens)
        step_s = self._models.artifacts.runtime.step_s
        with torch.no_grad():
            mean = command_mean(tail(self._expert, x, now, self._tokens), step_s, self._limits)[0]
        command, scale = (float(mean[0]), float(mean[1])), self.speed_scale(time_s)
        return PolicyOutput(command, x[0].numpy().copy(), latency, len(self.semantic) - 1, scale)

    def start_generation(self, time_s: float) -> None:
        """Start the next generation unless one is running."""
        self._reasoner.start(START_NS + round(time_s * 1e9))

    def latency(self, semantic: SemanticState, time_s: float, T_odom_base: SE2) -> tuple[float, float, float, float]:
        """Return (Δt s, Δx m, Δy m, Δθ rad) of a state now; as in the runner, Δt is clipped to the longest delay."""
        delay_s = semantic.delay_s(START_NS + round(time_s * 1e9))
        return (self._models.ages.given_delay_s(delay_s), *semantic.motion_offset(T_odom_base).as_tuple())

    def speed_scale(self, time_s: float) -> float:
        """Return the share of the speed limits, 0 to 1, that the robot's monitor leaves at the semantic state's age."""
        found = self._monitor.step(self.slot.state, 0, START_NS + round(time_s * 1e9))
        return min((each.speed_scale or 0.0 for each in found), default=1.0)


class PointGoalRolloutPolicy:
    """The paper's RL baseline, for one episode: it reads the frame, the robot state and the goal, and never waits."""

    semantic: Sequence[Floats] = ()
    failure: str | None = None

    def __init__(self, vision: VisionEncoder, net: PointGoalNet, limits: CommandLimits, step_s: float) -> None:
        self._vision, self._net, self._limits, self._step_s = vision, net, limits, step_s

    def observe(self, time_s: float, image: npt.NDArray[np.uint8], T_odom_base: SE2) -> Floats:
        """Encode the frame."""
        with torch.no_grad():
            tokens: Floats = self._vision(torch.from_numpy(image)[None]).numpy()
        return tokens

    def choose(
        self, visual: Floats, state: tuple[float, ...], goal_m: tuple[float, float], time_s: float, T_odom_base: SE2
    ) -> PolicyOutput | None:
        """See `RolloutPolicy`; never None."""
        with torch.no_grad():
            plan = self._net(torch.from_numpy(visual), torch.tensor([state]), torch.tensor([goal_m]))
            mean = command_mean(plan, self._step_s, self._limits)[0]
        return PolicyOutput((float(mean[0]), float(mean[1])))

    def start_generation(self, time_s: float) -> None:
        """Do nothing: this policy has no language model."""
