"""The policies that reinforcement learning trains, while they drive one episode, and the parts that PPO trains.

The action expert is split before its last cross-attention layer (paper, appendix D: "we finetune only the final
cross-attention Transformer layer and the MLP decoder"). The frozen prefix is computed once in a rollout and reused in
every epoch. A policy is a Gaussian over commands (v, ω) whose mean is the arc to the trajectory's point 1 s ahead, with
the arc and limits of `edge.motion.controller` in torch. The other policy is the paper's baseline without language.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from edge.artifacts.manifest import Artifacts
from edge.core.geometry import SE2
from edge.inference.generation_task import GenerationModels
from edge.inference.graph import Interrupt
from edge.inference.language import LanguageModel
from edge.inference.policy import Policy
from edge.motion.controller import STEER_M, TARGET_TIME_S, TURN_IN_PLACE_M
from edge.reasoning.generation_cycle import Mode, ReasoningConfig
from edge.run.assembly import semantic_config
from edge.safety.monitors.semantic import SemanticMonitor
from edge.state.frame import fit_frame
from edge.state.ring import EncodedFrame, TokenRing
from edge.state.semantic import Context, SemanticSlot, SemanticState, SharedState
from export.model.action import ActionExpert
from export.model.heads import integrated
from export.model.vision import VisionEncoder
from sim_hil.benchmark.conditions.latency import Timing
from sim_hil.benchmark.policies.artifacts_policy import CONTROL_PERIOD_NS, RING_S
from sim_hil.benchmark.policies.virtual_time_reasoner import VirtualTimeReasoner
from tools.train.config.checks import TrainError
from tools.train.imitate.trainable_policies import PointGoalNet
from tools.train.rl.rollout import PolicyOutput


def check_tail(expert: ActionExpert) -> None:
    """Raise TrainError unless the expert's last layer and head alone compute the trajectory (head `query`)."""
    head = getattr(expert.config.action, "head", "query")
    if head != "query":
        raise TrainError(f"action.head {head!r}: reinforcement learning trains the query head alone; end with imitate")
    if expert.config.action.semantic_interface == "waypoints":
        raise TrainError(
            "semantic_interface 'waypoints': reinforcement learning needs kv or values-only, which a generation fixes"
        )


def tail_parameters(expert: ActionExpert) -> dict[str, torch.nn.Parameter]:
    """Return the tail's parameters by the expert's names: last cross-attention layer, its keys and values, and head."""
    last = len(expert.layers) - 1
    trained = (f"layers.{last}.", f"key_values.{last}.", "norm.", "head.", "out.")
    return {name: each for name, each in expert.named_parameters() if name.startswith(trained)}


def freeze_all_but_tail(expert: ActionExpert) -> None:
    """Disable gradients of all parameters but the tail's."""
    trained = tail_parameters(expert)
    for name, each in expert.named_parameters():
        each.requires_grad_(name in trained)


def load_tail(expert: ActionExpert, tensors: Mapping[str, Tensor]) -> None:
    """Replace the tail's weights. Raises TrainError unless the names are exactly the tail's."""
    wanted = tail_parameters(expert)
    if set(tensors) != set(wanted):
        odd = sorted(set(tensors) ^ set(wanted))[0]
        raise TrainError(f"weights of the last layer and the head: {odd} is missing or unknown")
    with torch.no_grad():
        for name, each in wanted.items():
            each.copy_(tensors[name])


def semantic_of(expert: ActionExpert, last_layer_kv: Tensor) -> Tensor:
    """Compute semantic tokens [1, T, hidden] from a generation's K‖V [1, T, kv_dim], without gradients."""
    with torch.no_grad():
        return expert.semantic_tokens(last_layer_kv)


def now_of(expert: ActionExpert, visual_tokens: Tensor, state: Tensor, latency: Tensor) -> Tensor:
    """Compute the tokens of the current frame, state and latency [B, N + 2, hidden], without gradients."""
    with torch.no_grad():
        return expert.now_tokens(visual_tokens, state, latency)


def prefix(expert: ActionExpert, now: Tensor, semantic: Tensor) -> Tensor:
    """Compute the queries [B, steps, hidden] before the last layer, without gradients.

    `now` [B, N + 2, hidden]; `semantic` [B, T, hidden], of equal length T in the whole batch.
    """
    with torch.no_grad():
        x = expert.queries.detach().expand(now.shape[0], -1, -1)
        pairs = list(zip(expert.key_values, expert.layers, strict=True))
        for key_value, layer in pairs[:-1]:
            keys, values = key_value(torch.cat([now, semantic], dim=1))
            x = layer(x, keys, values)
        return x


def tail(expert: ActionExpert, x: Tensor, now: Tensor, semantic: Tensor, real: Tensor | None = None) -> Tensor:
    """Compute the trajectory [B, steps, 3] from the queries before the last layer.

    `real` [B, T] is False at padded semantic tokens; None if none is padded.
    """
    c = expert.config.action
    tokens = torch.cat([now, semantic], dim=1)
    keys, values = expert.key_values[-1](tokens)
    mask = None
    if real is not None:
        mask = torch.cat([real.new_ones(now.shape[:2]), real], dim=1)[:, None, None, :]
    out = expert.out(expert.head(expert.norm(expert.layers[-1](x, keys, values, mask))))
    return integrated(out, c.parameterisation)


def padded(sequences: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Stack sequences [T_i, h] as a batch [B, T, h] padded with zeros; return it and which tokens are real [B, T]."""
    lengths = torch.tensor([len(each) for each in sequences])
    batch = torch.nn.utils.rnn.pad_sequence(list(sequences), batch_first=True)
    return batch, torch.arange(batch.shape[1])[None] < lengths[:, None]


@dataclass(frozen=True)
class CommandLimits:
    """The robot's largest forward speed, m/s, and yaw rate, rad/s."""

    vx_max_mps: float
    wz_max_radps: float

    def __post_init__(self) -> None:
        if not (self.vx_max_mps > 0 and self.wz_max_radps > 0):
            raise ValueError("command limits must be above 0")


def command_mean(trajectory: Tensor, step_s: float, limits: CommandLimits) -> Tensor:
    """Compute (v m/s, ω rad/s) [B, 2] of trajectories [B, steps, 3]: the arc to the target 1 s ahead, within limits."""
    return within_limits(arc_command(trajectory, step_s), limits)


def arc_command(trajectory: Tensor, step_s: float) -> Tensor:
    """Compute (v m/s, ω rad/s) [B, 2] of the arc to the target 1 s ahead, without limits (`controller.arc_to`)."""
    index = min(trajectory.shape[1], max(1, round(TARGET_TIME_S / step_s))) - 1
    x, y, theta = trajectory[:, index].unbind(-1)
    distance = torch.sqrt(x * x + y * y + 1e-12)
    bearing = torch.atan2(y, x)
    small = bearing.abs() < 1e-3
    # Both branches of a `where` receive gradients, so the branch that is not taken must be finite.
    sine = torch.where(small, torch.ones_like(bearing), torch.sin(bearing))
    divisor = torch.where(sine.abs() < 1e-6, torch.ones_like(sine), sine)
    stretch = torch.where(small, 1 + bearing * bearing / 6, bearing / divisor)
    near, behind = distance < TURN_IN_PLACE_M, bearing.abs() > math.pi / 2
    still = near | behind
    speed = torch.where(still, torch.zeros_like(distance), distance * stretch / TARGET_TIME_S)
    turn = torch.where(behind, torch.sign(bearing) * (math.pi / 2), 2 * bearing)
    share = ((distance - TURN_IN_PLACE_M) / (STEER_M - TURN_IN_PLACE_M)).clamp(0.0, 1.0)
    turn = share * turn + (1 - share) * theta
    return torch.stack([speed, turn / TARGET_TIME_S], dim=-1)


def within_limits(arc: Tensor, limits: CommandLimits) -> Tensor:
    """Scale commands [B, 2] down along their arcs until they are within the limits.

    The scale is detached: with its gradient, a plan above the speed limit could not learn to go slower.
    """
    speed, turn = arc.unbind(-1)
    over = torch.maximum(speed / limits.vx_max_mps, turn.abs() / limits.wz_max_radps).clamp(min=1.0).detach()
    return arc / over[..., None]


def log_prob(action: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Compute the log density [B] of actions [B, 2] under independent Gaussians; `log_std` [2]."""
    z = (action - mean) * torch.exp(-log_std)
    return (-0.5 * z * z - log_std - 0.5 * math.log(2 * math.pi)).sum(-1)


def entropy(log_std: Tensor) -> Tensor:
    """Compute the differential entropy [] of the Gaussian, nats."""
    return (log_std + 0.5 * math.log(2 * math.pi * math.e)).sum()


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


class TailPolicy:
    """The action expert acting on the last released generation (Algorithm 2, lines 4 to 9), for one episode.

    `VirtualTimeReasoner` runs the generations, as in the benchmark; `draw` returns their latencies.
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
        self._reasoner = VirtualTimeReasoner(
            GenerationModels(models.language, stand_in),
            SharedState(self._ring, self.slot),
            ReasoningConfig(runtime.frame_offsets_s, runtime.max_new_tokens, turns_as_told=False),
            instruction,
            draw,
        )
        self._number: int | None = None
        self._tokens = torch.empty(0)
        self.semantic: list[Floats] = []

    @property
    def failure(self) -> str | None:
        """Why reasoning has ended for good; None while it continues."""
        return self._reasoner.cycle.failure

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
        now_ns = START_NS + round(time_s * 1e9)
        latency = semantic.latency_input(now_ns, T_odom_base, self._models.ages.trained_delay_s)
        return (latency.delay_s, *latency.offset.as_tuple())

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
