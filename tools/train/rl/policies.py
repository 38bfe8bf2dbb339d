"""The policies that are trained: the action expert beside asynchronous reasoning, and the point-goal network."""

from __future__ import annotations

from collections.abc import Callable, Sequence

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
from tools.train.rl.rollout import Chosen
from tools.train.rl.virtual_time_reasoner import Models, RolloutReasoner

Floats = npt.NDArray[np.float32]


class TailPilot:
    """Acts by the last released generation (Algorithm 2, lines 4 to 9); one episode."""

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
        """Of each generation that was acted by."""
        return self._semantic

    @property
    def failure(self) -> str | None:
        """Why reasoning has ended for this episode; None while it continues."""
        return self._reasoner.failure

    def see(self, time_s: float, image: npt.NDArray[np.uint8], T_odom_base: SE2) -> Floats:
        """Release the generation that is due and encode the frame."""
        return self._reasoner.observe(time_s, image, T_odom_base)

    def choose(
        self, visual: Floats, state: tuple[float, ...], goal_m: tuple[float, float], time_s: float, T_odom_base: SE2
    ) -> Chosen | None:
        """None before the first semantic state; the goal is not looked at."""
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
        return Chosen(
            (float(mean[0]), float(mean[1])),
            x[0].numpy().copy(),
            latency,
            len(self._semantic) - 1,
            self._reasoner.speed_scale(time_s),
        )

    def think(self, time_s: float) -> None:
        """Start the next generation if none is under way."""
        self._reasoner.start_generation(time_s)


class PointGoalPilot:
    """The paper's RL baseline: frame, state and where the goal is; nothing to wait for."""

    semantic: Sequence[Floats] = ()
    failure: str | None = None

    def __init__(self, vision: VisionEncoder, net: PointGoalNet, limits: CommandLimits, step_s: float) -> None:
        self._vision, self._net, self._limits, self._step_s = vision, net, limits, step_s

    def see(self, time_s: float, image: npt.NDArray[np.uint8], T_odom_base: SE2) -> Floats:
        """Encode the frame."""
        with torch.no_grad():
            tokens: Floats = self._vision(torch.from_numpy(image)[None]).numpy()
        return tokens

    def choose(
        self, visual: Floats, state: tuple[float, ...], goal_m: tuple[float, float], time_s: float, T_odom_base: SE2
    ) -> Chosen | None:
        """Always something."""
        with torch.no_grad():
            plan = self._net(torch.from_numpy(visual), torch.tensor([state]), torch.tensor([goal_m]))
            mean = command_mean(plan, self._step_s, self._limits)[0]
        return Chosen((float(mean[0]), float(mean[1])))

    def think(self, time_s: float) -> None:
        """It does not."""
