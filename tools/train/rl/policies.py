"""The policies that reinforcement learning trains, while they drive one episode.

`TailPolicy` is the action expert with asynchronous reasoning; `PointGoalRolloutPolicy` is the paper's baseline without
language.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch

from edge.core.geometry import SE2
from export.model.action import ActionExpert
from export.model.vision import VisionEncoder
from sim_hil.benchmark.conditions.latency import Timing
from tools.train.imitate.point_goal_net import PointGoalNet
from tools.train.rl.action_tail import now_of, prefix, semantic_of, tail
from tools.train.rl.command_policy import CommandLimits, command_mean
from tools.train.rl.rollout import PolicyOutput
from tools.train.rl.virtual_time_reasoner import Models, RolloutReasoner

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


class TailPolicy:
    """The action expert acting on the last released generation (Algorithm 2, lines 4 to 9), for one episode."""

    def __init__(
        self,
        models: Models,
        expert: ActionExpert,
        limits: CommandLimits,
        instruction: str,
        draw: Callable[[], Timing],
    ) -> None:
        self._reasoner = RolloutReasoner(models, instruction, draw)
        self._expert, self._limits, self._step_s = expert, limits, models.artifacts.runtime.step_s
        self._number: int | None = None
        self._tokens = torch.empty(0)
        self._semantic: list[Floats] = []

    @property
    def semantic(self) -> Sequence[Floats]:
        """See `RolloutPolicy`."""
        return self._semantic

    @property
    def failure(self) -> str | None:
        """Why reasoning has ended for good; None while it continues."""
        return self._reasoner.failure

    def observe(self, time_s: float, image: npt.NDArray[np.uint8], T_odom_base: SE2) -> Floats:
        """See `RolloutReasoner.observe`."""
        return self._reasoner.observe(time_s, image, T_odom_base)

    def choose(
        self, visual: Floats, state: tuple[float, ...], goal_m: tuple[float, float], time_s: float, T_odom_base: SE2
    ) -> PolicyOutput | None:
        """See `RolloutPolicy`; the goal is not used."""
        semantic = self._reasoner.semantic
        if semantic is None:
            return None
        if semantic.generation != self._number:
            self._number = semantic.generation
            self._tokens = semantic_of(self._expert, torch.from_numpy(semantic.last_layer_kv))
            self._semantic.append(self._tokens[0].numpy().copy())
        latency = self._reasoner.metadata(time_s, T_odom_base)
        now = now_of(self._expert, torch.from_numpy(visual), torch.tensor([state]), torch.tensor([latency]))
        x = prefix(self._expert, now, self._tokens)
        with torch.no_grad():
            mean = command_mean(tail(self._expert, x, now, self._tokens), self._step_s, self._limits)[0]
        return PolicyOutput(
            (float(mean[0]), float(mean[1])),
            x[0].numpy().copy(),
            latency,
            len(self._semantic) - 1,
            self._reasoner.speed_scale(time_s),
        )

    def start_generation(self, time_s: float) -> None:
        """Start the next generation unless one is running."""
        self._reasoner.start_generation(time_s)


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
