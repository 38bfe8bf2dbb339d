"""Proximal policy optimisation with a clipped surrogate (Schulman et al. 2017), numbers from the paper's Table 9."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from tools.train.config.rl import PpoConfig


class Learner(Protocol):
    """What is optimised: a policy and a value function over the steps of a rollout, by their numbers."""

    @property
    def actor_parameters(self) -> Sequence[torch.nn.Parameter]:
        """What `action_lr` moves."""
        ...

    @property
    def critic_parameters(self) -> Sequence[torch.nn.Parameter]:
        """What `value_lr` moves."""
        ...

    def act(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Log-probabilities [B] of the actions taken, mean entropy [], and a penalty [] to add to the loss."""
        ...

    def value(self, rows: Tensor) -> Tensor:
        """Values [B] of the states."""
        ...


@dataclass(frozen=True)
class PpoStats:
    """Of one update: means over its minibatches."""

    policy_loss: float
    value_loss: float
    entropy: float
    kl: float
    clipped: float
    """Share of steps whose ratio lay outside the clip."""
    skipped: int
    """Minibatches whose gradient was not finite; nothing was learned from them."""
    moved: int
    """Minibatches that the policy was moved by."""


class PpoOptimiser:
    """Two AdamW without decay, the policy's and the value function's."""

    def __init__(self, learner: Learner, config: PpoConfig) -> None:
        self.config = config
        self.actor = torch.optim.Adam(learner.actor_parameters, lr=config.action_lr)
        self.critic = torch.optim.Adam(learner.critic_parameters, lr=config.value_lr)

    def update(
        self,
        learner: Learner,
        advantages: Tensor,
        returns: Tensor,
        generator: torch.Generator,
        *,
        policy: bool = True,
    ) -> PpoStats:
        """Optimise over all steps of a rollout; `policy` False trains the value function alone (its warm-up)."""
        config, count = self.config, len(advantages)
        with torch.no_grad():
            old = torch.cat([learner.act(rows)[0] for rows in torch.arange(count).split(config.batch)])
        scaled = (advantages - advantages.mean()) / (advantages.std(unbiased=False) + 1e-8)
        totals = {"policy": 0.0, "value": 0.0, "entropy": 0.0, "kl": 0.0, "clipped": 0.0}
        valued, moved, skipped = 0, 0, 0
        for _ in range(config.epochs):
            for rows in torch.randperm(count, generator=generator).split(config.batch):
                value_loss = torch.nn.functional.mse_loss(learner.value(rows), returns[rows])
                skipped += not _step(self.critic, value_loss, learner.critic_parameters, config.grad_clip)
                totals["value"] += float(value_loss.detach())
                valued += 1
                if not policy:
                    continue
                log_prob, entropy, penalty = learner.act(rows)
                difference = log_prob - old[rows]
                ratio = torch.exp(difference)
                kl = float((ratio - 1 - difference).mean().detach())
                if config.target_kl and kl > 1.5 * config.target_kl:
                    policy = False
                    continue
                advantage = scaled[rows]
                within = ratio.clamp(1 - config.clip, 1 + config.clip)
                policy_loss = -torch.minimum(ratio * advantage, within * advantage).mean()
                loss = policy_loss - config.entropy * entropy + penalty
                skipped += not _step(self.actor, loss, learner.actor_parameters, config.grad_clip)
                totals["kl"] += kl
                totals["clipped"] += float(((ratio.detach() - 1).abs() > config.clip).float().mean())
                totals["policy"] += float(policy_loss.detach())
                totals["entropy"] += float(entropy.detach())
                moved += 1
        mean = {key: total / max(valued if key == "value" else moved, 1) for key, total in totals.items()}
        return PpoStats(mean["policy"], mean["value"], mean["entropy"], mean["kl"], mean["clipped"], skipped, moved)


def _step(
    optimiser: torch.optim.Optimizer, loss: Tensor, parameters: Sequence[torch.nn.Parameter], clip: float
) -> bool:
    """One clipped update; False, and no update, where the gradient is not finite."""
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    norm = float(torch.nn.utils.clip_grad_norm_(list(parameters), clip))
    finite = math.isfinite(norm)
    if finite:
        optimiser.step()
    optimiser.zero_grad(set_to_none=True)
    return finite
