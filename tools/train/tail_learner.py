"""The tail of the action expert and the value network over one rollout: what PPO optimises (paper Fig. 3b, Table 9)."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from export.model.network import TicVla
from tools.train.action_tail import freeze_all_but_tail, now_of, padded, tail, tail_parameters
from tools.train.command_policy import LOG_STD_RANGE, CommandLimits, command_mean, entropy, log_prob
from tools.train.gae import advantages
from tools.train.rollout import Rollout


@dataclass(frozen=True)
class Estimates:
    """Of every step: advantage and return, normalised rewards."""

    advantages: Tensor
    returns: Tensor


class TailLearner:
    """Keeps the network; `take` gives it a rollout to learn from."""

    def __init__(
        self, network: TicVla, limits: CommandLimits, log_std: Sequence[float], *, imitation: float = 0.0
    ) -> None:
        """`imitation`: weight of a penalty on leaving the means that the policy began with."""
        self.network = network.eval()
        freeze_all_but_tail(network.action)
        for part in (network.vision, network.language):
            part.requires_grad_(False)
        self.log_std = torch.nn.Parameter(torch.tensor(log_std, dtype=torch.float32))
        self._limits = limits
        self._imitation = imitation
        self._reference = copy.deepcopy(network.action).requires_grad_(False) if imitation > 0 else None
        self._rollout: Rollout | None = None
        self._tensors: dict[str, Tensor] = {}
        self._semantic: list[Tensor] = []

    @property
    def actor_parameters(self) -> list[torch.nn.Parameter]:
        """The tail and the exploration."""
        return [*tail_parameters(self.network.action).values(), self.log_std]

    @property
    def critic_parameters(self) -> list[torch.nn.Parameter]:
        """The value network."""
        return list(self.network.value.parameters())

    def take(self, rollout: Rollout) -> None:
        """Learn from this rollout from now on."""
        self._rollout = rollout
        device = self.log_std.device
        self._tensors = {name: torch.from_numpy(array).to(device) for name, array in rollout.arrays.items()}
        self._semantic = [torch.from_numpy(each).to(device) for each in rollout.semantic]

    def means(self, rows: Tensor, *, reference: bool = False) -> Tensor:
        """Mean commands (v m/s, ω rad/s) [B, 2] of steps."""
        expert = self._reference if reference and self._reference is not None else self.network.action
        t = self._tensors
        now = now_of(expert, t["visual"][rows], t["state"][rows], t["latency"][rows])
        semantic, real = padded([self._semantic[number] for number in t["generation"][rows].tolist()])
        trajectory = tail(expert, t["queries"][rows], now, semantic, real.to(semantic.device))
        return command_mean(trajectory, expert.config.action.step_s, self._limits)

    def act(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See `ppo.Learner`."""
        mean = self.means(rows)
        log_std = self.log_std.clamp(*LOG_STD_RANGE)
        penalty = mean.new_zeros(())
        if self._reference is not None and torch.is_grad_enabled():
            with torch.no_grad():
                wanted = self.means(rows, reference=True)
            penalty = self._imitation * (((mean - wanted) * torch.exp(-log_std.detach())) ** 2).sum(-1).mean()
        return log_prob(self._tensors["action"][rows], mean, log_std), entropy(log_std), penalty

    def value(self, rows: Tensor) -> Tensor:
        """See `ppo.Learner`."""
        t = self._tensors
        return self.network.value(t["visual"][rows], t["state"][rows], t["goal"][rows])

    def estimates(self, *, gamma: float, lam: float, reward_scale: float, batch: int = 256) -> Estimates:
        """Advantages and returns of the rollout's steps by the value network as it is; rewards times the scale."""
        if self._rollout is None:
            raise RuntimeError("estimates: expected a rollout to be taken first")
        t = self._tensors
        with torch.no_grad():
            rows = torch.arange(self._rollout.steps, device=self.log_std.device)
            values = torch.cat([self.value(part) for part in rows.split(batch)]).double().cpu().numpy()
            after = self.network.value(t["after_visual"], t["after_state"], t["after_goal"]).double().cpu().numpy()
        rewards = self._rollout.arrays["reward"].astype(np.float64) * reward_scale
        found, returns = np.zeros(len(rewards)), np.zeros(len(rewards))
        for steps, number, end in self._rollout.episodes():
            found[steps], returns[steps] = advantages(
                rewards[steps], values[steps], float(after[number]), terminal=end.terminal, gamma=gamma, lam=lam
            )
        device = self.log_std.device
        return Estimates(torch.from_numpy(found).float().to(device), torch.from_numpy(returns).float().to(device))
