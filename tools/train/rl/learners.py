"""What PPO optimises over one rollout: the end of the action expert, or a point-goal network; and the value network.

Paper Fig. 3b, Table 9 and appendix D. The value network is the same for both and is trained in either case.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from export.model.action import ActionExpert
from export.model.network import TicVla
from tools.train.config.rl import LOG_STD_RANGE
from tools.train.imitate.point_goal_net import PointGoalNet
from tools.train.rl.action_tail import freeze_all_but_tail, load_tail, now_of, padded, tail, tail_parameters
from tools.train.rl.command_policy import CommandLimits, arc_command, entropy, log_prob, within_limits
from tools.train.rl.gae import advantages
from tools.train.rl.rollout import GOAL_SCALE_M, Rollout


@dataclass(frozen=True)
class Estimates:
    """Advantage and return of every step, [S] each."""

    advantages: Tensor
    returns: Tensor


class Learner(ABC):
    """A policy and the network's value function; `take` gives it a rollout to learn from."""

    def __init__(self, network: TicVla, limits: CommandLimits, log_std: Sequence[float]) -> None:
        self.network = network.eval()
        for part in (network.vision, network.language):
            part.requires_grad_(False)
        device = next(network.parameters()).device
        self.log_std = torch.nn.Parameter(torch.tensor(log_std, dtype=torch.float32, device=device))
        self._limits = limits
        self._step_s = network.config.action.step_s
        self._rollout: Rollout | None = None
        self._tensors: dict[str, Tensor] = {}

    @property
    @abstractmethod
    def policy_parameters(self) -> Mapping[str, torch.nn.Parameter]:
        """By name: what workers are given."""

    @abstractmethod
    def load_policy(self, tensors: Mapping[str, Tensor]) -> None:
        """Give the policy other weights."""

    @abstractmethod
    def arcs(self, rows: Tensor) -> Tensor:
        """What steps' plans ask for, (v m/s, ω rad/s) [B, 2], within no limits yet."""

    def means(self, rows: Tensor) -> Tensor:
        """Mean commands (v m/s, ω rad/s) [B, 2] of steps."""
        return within_limits(self.arcs(rows), self._limits)

    def penalty(self, rows: Tensor, arc: Tensor) -> Tensor:
        """Added to the loss, by `arcs` of the steps; none as a rule."""
        return arc.new_zeros(())

    @property
    def actor_parameters(self) -> list[torch.nn.Parameter]:
        """The policy and the exploration."""
        return [*self.policy_parameters.values(), self.log_std]

    @property
    def critic_parameters(self) -> list[torch.nn.Parameter]:
        """The value network."""
        return list(self.network.value.parameters())

    def policy_tensors(self) -> dict[str, Tensor]:
        """A copy of the policy's weights, on the CPU."""
        return {name: each.detach().cpu().clone() for name, each in self.policy_parameters.items()}

    def take(self, rollout: Rollout) -> None:
        """Learn from this rollout from now on."""
        self._rollout = rollout
        device = self.log_std.device
        self._tensors = {name: torch.from_numpy(array).to(device) for name, array in rollout.arrays.items()}

    def act(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See `ppo.Learner`."""
        arc = self.arcs(rows)
        mean = within_limits(arc, self._limits)
        log_std = self.log_std.clamp(*LOG_STD_RANGE)
        penalty = self.penalty(rows, arc) if torch.is_grad_enabled() else arc.new_zeros(())
        return log_prob(self._tensors["action"][rows], mean, log_std), entropy(log_std), penalty

    def value(self, rows: Tensor) -> Tensor:
        """See `ppo.Learner`."""
        t = self._tensors
        values: Tensor = self.network.value(t["visual"][rows], t["state"][rows], t["goal"][rows])
        return values

    def estimates(self, *, gamma: float, lam: float, reward_scale: float, batch: int = 256) -> Estimates:
        """Advantages and returns of the rollout's steps by the value network as it is; rewards times the scale."""
        if self._rollout is None:
            raise RuntimeError("estimates: expected a rollout to be taken first")
        t, device = self._tensors, self.log_std.device
        with torch.no_grad():
            rows = torch.arange(self._rollout.steps, device=device)
            values = torch.cat([self.value(part) for part in rows.split(batch)]).double().cpu().numpy()
            after = self.network.value(t["after_visual"], t["after_state"], t["after_goal"]).double().cpu().numpy()
        rewards = self._rollout.arrays["reward"].astype(np.float64) * reward_scale
        found, returns = np.zeros(len(rewards)), np.zeros(len(rewards))
        for steps, number, end in self._rollout.episodes():
            found[steps], returns[steps] = advantages(
                rewards[steps], values[steps], float(after[number]), terminal=end.terminal, gamma=gamma, lam=lam
            )
        return Estimates(torch.from_numpy(found).float().to(device), torch.from_numpy(returns).float().to(device))


class TailLearner(Learner):
    """The last cross-attention layer and the head of the action expert; all before is frozen."""

    def __init__(
        self, network: TicVla, limits: CommandLimits, log_std: Sequence[float], *, imitation: float = 0.0
    ) -> None:
        """`imitation`: weight of a penalty on leaving the arcs that the policy began with."""
        super().__init__(network, limits, log_std)
        freeze_all_but_tail(network.action)
        self._imitation = imitation
        self._reference = copy.deepcopy(network.action).requires_grad_(False) if imitation > 0 else None
        self._semantic: list[Tensor] = []

    @property
    def policy_parameters(self) -> Mapping[str, torch.nn.Parameter]:
        """In the expert's names."""
        return tail_parameters(self.network.action)

    def load_policy(self, tensors: Mapping[str, Tensor]) -> None:
        """Raises ActionTailError for another network's."""
        load_tail(self.network.action, tensors)

    def take(self, rollout: Rollout) -> None:
        """See `Learner.take`."""
        super().take(rollout)
        self._semantic = [torch.from_numpy(each).to(self.log_std.device) for each in rollout.semantic]

    def arcs(self, rows: Tensor) -> Tensor:
        """From what the rollout kept of the frozen layers."""
        return self._arcs(rows, self.network.action)

    def penalty(self, rows: Tensor, arc: Tensor) -> Tensor:
        """Squared distance, in standard deviations, from the arcs that were imitated: beyond the limits it grows on."""
        if self._reference is None:
            return arc.new_zeros(())
        with torch.no_grad():
            wanted = self._arcs(rows, self._reference)
            std = torch.exp(self.log_std.clamp(*LOG_STD_RANGE))
        return self._imitation * (((arc - wanted) / std) ** 2).sum(-1).mean()

    def _arcs(self, rows: Tensor, expert: ActionExpert) -> Tensor:
        t = self._tensors
        now = now_of(expert, t["visual"][rows], t["state"][rows], t["latency"][rows])
        semantic, real = padded([self._semantic[number] for number in t["generation"][rows].tolist()])
        trajectory = tail(expert, t["queries"][rows], now, semantic, real.to(semantic.device))
        return arc_command(trajectory, self._step_s)


class PointGoalLearner(Learner):
    """The whole point-goal network over a frozen encoder (paper appendix D, the RL baseline)."""

    def __init__(self, network: TicVla, net: PointGoalNet, limits: CommandLimits, log_std: Sequence[float]) -> None:
        super().__init__(network, limits, log_std)
        network.action.requires_grad_(False)
        self.net = net

    @property
    def policy_parameters(self) -> Mapping[str, torch.nn.Parameter]:
        """All of the network's."""
        return dict(self.net.named_parameters())

    def load_policy(self, tensors: Mapping[str, Tensor]) -> None:
        """Raises RuntimeError for another network's."""
        self.net.load_state_dict(dict(tensors))

    def arcs(self, rows: Tensor) -> Tensor:
        """To the plan's point 1 s ahead."""
        t = self._tensors
        # Kept in tens of metres for the value network.
        plan = self.net(t["visual"][rows], t["state"][rows], GOAL_SCALE_M * t["goal"][rows])
        return arc_command(plan, self._step_s)
