"""Proximal policy optimisation: advantages (GAE), the learners that are optimised, and the clipped update.

Schulman et al. 2016 (generalised advantage estimation) and 2017 (clipped surrogate); constants from the paper's
Table 9. A learner is one policy (the tail of the action expert, or the point-goal network) with the network's value
function; the value network is the same for both and is always trained (paper Fig. 3b and appendix D).
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from export.model.action import ActionExpert
from export.model.network import TicVla
from tools.train.config.rl import LOG_STD_RANGE, PpoConfig
from tools.train.imitate.trainable_policies import PointGoalNet
from tools.train.rl.policies import (
    CommandLimits,
    arc_command,
    entropy,
    freeze_all_but_tail,
    load_tail,
    log_prob,
    now_of,
    padded,
    tail,
    tail_parameters,
    within_limits,
)
from tools.train.rl.rollout import GOAL_SCALE_M, Rollout

Array = npt.NDArray[np.float64]


# Advantages


def advantages(
    rewards: Array, values: Array, after: float, *, terminal: bool, gamma: float, lam: float
) -> tuple[Array, Array]:
    """Compute advantages and returns [S] of one episode by generalised advantage estimation.

    `values` [S] belong to the states in which the S actions were taken, `after` to the state after the last action. An
    episode that was cut off (`terminal` False) is continued by `after`; a terminal one has no future reward.
    Raises ValueError if the shapes differ.
    """
    if rewards.shape != values.shape or rewards.ndim != 1:
        raise ValueError(f"expected as many values as rewards, found {values.shape} and {rewards.shape}")
    found = np.zeros(len(rewards), dtype=np.float64)
    running, next_value = 0.0, 0.0 if terminal else after
    for step in range(len(rewards) - 1, -1, -1):
        error = rewards[step] + gamma * next_value - values[step]
        running = error + gamma * lam * running
        found[step] = running
        next_value = values[step]
    return found, found + values


# Learners


class Learner(ABC):
    """A policy with the network's value function, trained on the rollout that `take` received last."""

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
        """Trained parameters of the policy by name, without `log_std`."""

    @abstractmethod
    def load_policy(self, tensors: Mapping[str, Tensor]) -> None:
        """Replace the policy's weights."""

    @abstractmethod
    def arcs(self, rows: Tensor) -> Tensor:
        """Compute the commands (v m/s, ω rad/s) [B, 2] of the steps' plans, before the robot's limits."""

    def penalty(self, rows: Tensor, arc: Tensor) -> Tensor:
        """Compute a penalty [] to add to the policy loss from the steps' `arcs`; zero unless overridden."""
        return arc.new_zeros(())

    @property
    def actor_parameters(self) -> list[torch.nn.Parameter]:
        """Parameters of the policy and of its exploration."""
        return [*self.policy_parameters.values(), self.log_std]

    @property
    def critic_parameters(self) -> list[torch.nn.Parameter]:
        """Parameters of the value network."""
        return list(self.network.value.parameters())

    def policy_tensors(self) -> dict[str, Tensor]:
        """Copy the policy's weights to the CPU, by name."""
        return {name: each.detach().cpu().clone() for name, each in self.policy_parameters.items()}

    def take(self, rollout: Rollout) -> None:
        """Set the rollout whose steps `rows` refer to."""
        self._rollout = rollout
        device = self.log_std.device
        self._tensors = {name: torch.from_numpy(array).to(device) for name, array in rollout.arrays.items()}

    def act(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return log-probabilities [B] of the recorded actions, the mean entropy [] and a penalty [] for the loss.

        `rows`: step indices [B]. The penalty is computed only where gradients are.
        """
        arc = self.arcs(rows)
        mean = within_limits(arc, self._limits)
        log_std = self.log_std.clamp(*LOG_STD_RANGE)
        penalty = self.penalty(rows, arc) if torch.is_grad_enabled() else arc.new_zeros(())
        return log_prob(self._tensors["action"][rows], mean, log_std), entropy(log_std), penalty

    def value(self, rows: Tensor) -> Tensor:
        """Return the values [B] of the states of steps."""
        t = self._tensors
        values: Tensor = self.network.value(t["visual"][rows], t["state"][rows], t["goal"][rows])
        return values

    def estimates(self, *, gamma: float, lam: float, reward_scale: float, batch: int = 256) -> tuple[Tensor, Tensor]:
        """Estimate advantages and returns [S] of the rollout with the current value network, after scaling rewards."""
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
        return torch.from_numpy(found).float().to(device), torch.from_numpy(returns).float().to(device)


class TailLearner(Learner):
    """Learner whose policy is the action expert's last cross-attention layer and head; earlier layers are frozen."""

    def __init__(
        self, network: TicVla, limits: CommandLimits, log_std: Sequence[float], *, imitation: float = 0.0
    ) -> None:
        """`imitation`: weight of a penalty on the distance from the arcs of the policy before this stage."""
        super().__init__(network, limits, log_std)
        freeze_all_but_tail(network.action)
        self._imitation = imitation
        self._reference = copy.deepcopy(network.action).requires_grad_(False) if imitation > 0 else None
        self._semantic: list[Tensor] = []

    @property
    def policy_parameters(self) -> Mapping[str, torch.nn.Parameter]:
        """Tail parameters under the action expert's names."""
        return tail_parameters(self.network.action)

    def load_policy(self, tensors: Mapping[str, Tensor]) -> None:
        """Replace the tail's weights. Raises TrainError for those of another network."""
        load_tail(self.network.action, tensors)

    def take(self, rollout: Rollout) -> None:
        """See `Learner.take`."""
        super().take(rollout)
        self._semantic = [torch.from_numpy(each).to(self.log_std.device) for each in rollout.semantic]

    def arcs(self, rows: Tensor) -> Tensor:
        """Compute arcs from the rollout's outputs of the frozen layers."""
        return self._arcs(rows, self.network.action)

    def penalty(self, rows: Tensor, arc: Tensor) -> Tensor:
        """Compute the mean squared distance, in standard deviations, from the imitated policy's arcs.

        Arcs, and not commands, are compared: beyond the robot's limits a command no longer changes, an arc does.
        """
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
    """Learner whose policy is the whole point-goal network over a frozen encoder (paper appendix D, RL baseline)."""

    def __init__(self, network: TicVla, net: PointGoalNet, limits: CommandLimits, log_std: Sequence[float]) -> None:
        super().__init__(network, limits, log_std)
        network.action.requires_grad_(False)
        self.net = net

    @property
    def policy_parameters(self) -> Mapping[str, torch.nn.Parameter]:
        """All parameters of the point-goal network."""
        return dict(self.net.named_parameters())

    def load_policy(self, tensors: Mapping[str, Tensor]) -> None:
        """Replace the weights. Raises RuntimeError for those of another network."""
        self.net.load_state_dict(dict(tensors))

    def arcs(self, rows: Tensor) -> Tensor:
        """Compute arcs to the plan's point 1 s ahead."""
        t = self._tensors
        # The rollout stores goals in tens of metres, as the value network reads them.
        plan = self.net(t["visual"][rows], t["state"][rows], GOAL_SCALE_M * t["goal"][rows])
        return arc_command(plan, self._step_s)


# Update


@dataclass(frozen=True)
class PpoStats:
    """Means of one update over its minibatches."""

    policy_loss: float
    value_loss: float
    entropy: float
    kl: float
    clipped: float
    """Share of steps whose ratio lay outside the clip."""
    skipped: int
    """Minibatches skipped because their gradient was not finite."""
    moved: int
    """Minibatches that updated the policy."""


class PpoOptimiser:
    """Two Adam optimisers: one for the policy, one for the value function."""

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
        """Optimise over all S steps of a rollout for `config.epochs` epochs.

        `advantages` and `returns` [S]; `generator` shuffles the minibatches. With `policy` False only the value
        function is trained (its warm-up). The policy is no longer updated once the KL divergence exceeds 1.5
        `config.target_kl`.
        """
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
    """Apply one update with a clipped gradient; return False, without an update, if the gradient is not finite."""
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    norm = float(torch.nn.utils.clip_grad_norm_(list(parameters), clip))
    finite = math.isfinite(norm)
    if finite:
        optimiser.step()
    optimiser.zero_grad(set_to_none=True)
    return finite
