"""Configuration of stage `rl`: PPO (Table 9), its rollouts, and the selection of the best policy."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from edge.inference.latency_profile import LatencyProfile, load_profile
from tools.train.config.scenes import SHARES, TASKS_PER_SCENE

POLICIES: Final = ("action", "point-goal")
_DELAYS: Final = 41
LOG_STD_RANGE = (-4.0, 0.5)
"""Range of the exploration's log standard deviation: 0.018 to 1.6 m/s or rad/s. Less does not explore, more does not
drive."""


@dataclass(frozen=True)
class PpoConfig:
    """PPO constants (Table 9).

    Once a minibatch's KL divergence exceeds 1.5 `target_kl`, an update trains only the value function; 0: no limit.
    """

    action_lr: float = 1e-5
    value_lr: float = 1e-4
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2
    grad_clip: float = 0.5
    entropy: float = 0.001
    epochs: int = 5
    batch: int = 64
    target_kl: float = 0.0

    def __post_init__(self) -> None:
        if not (0 < self.action_lr < 1 and 0 < self.value_lr < 1 and 0 < self.gamma <= 1 and 0 <= self.gae_lambda <= 1):
            raise ValueError("ppo: expected learning rates, gamma and gae_lambda within 0 to 1")
        if not (0 < self.clip < 1 and self.grad_clip > 0 and self.entropy >= 0 and self.target_kl >= 0):
            raise ValueError("ppo: expected clip within 0 to 1, grad_clip above 0, entropy and target_kl from 0 on")
        if self.epochs < 1 or self.batch < 2:
            raise ValueError("ppo: expected 1 epoch or more and batches of 2 or more")


@dataclass(frozen=True)
class RlConfig:
    """Online reinforcement learning of the action expert's last layer and head."""

    policy: str = "action"
    """`action`: train the action expert's last layer and head; `point-goal`: the paper's baseline, from scratch."""
    iterations: int = 300
    episodes: int = 16
    """Episodes of one iteration, about 4,000 steps at 250 steps each (the paper: 1,024 steps)."""
    episodes_per_job: int = TASKS_PER_SCENE
    """Episodes of one worker job: those of one layout, because a job must also generate the layout's earlier tasks."""
    ppo: PpoConfig = field(default_factory=PpoConfig)
    log_std: tuple[float, ...] = (-1.9, -1.5)
    """Initial log standard deviations of v and ω: 0.15 m/s and 0.22 rad/s."""
    reward_scale: float = 0.01
    mean_delay_s: float = 5.0
    """Latencies are drawn uniformly from 0 to twice this, s (paper: about 50 environment steps on average)."""
    delay_profile: str = ""
    """Latency profile of `edge-calib latency` to draw from instead."""
    rotation: tuple[str, ...] = ("office", "hospital", "warehouse")
    rotate_every: int = 100
    """Iterations in one kind of scene before the next; 0: all kinds in every iteration."""
    tasks: int = 3
    """Tasks of each kind, all in one layout, repeated with new crowds; 0: always new tasks."""
    drift: str = "typical"
    max_s: float = 90.0
    warmup_iterations: int = 3
    """First iterations, in which only the value network is trained."""
    imitation: float = 0.0
    """Weight of a penalty on the distance from the imitated policy's commands; the paper has none."""
    evaluate_every: int = 10
    evaluate_episodes: int = 24
    keep_margin: float = 0.06
    """Least gain in success over the best policy to replace it, because scores are noisy."""
    fall_back: float = 0.08
    """Loss of success against the best policy, or rise of collisions without more success, that resets to the best."""
    final_episodes: int = 32
    """Episodes on other scenarios that compare the first and the best policy; the best is kept if it is ahead."""
    jobs: int = 0
    """Worker processes; 0: one per core. Does not change the result."""

    def __post_init__(self) -> None:
        driven = (self.episodes, self.episodes_per_job, self.evaluate_episodes, self.final_episodes)
        counts = (self.iterations, self.evaluate_every, *driven)
        if self.policy not in POLICIES:
            raise ValueError(f"policy {self.policy!r}: expected one of {', '.join(POLICIES)}")
        if min(counts) < 1 or min(self.rotate_every, self.tasks, self.warmup_iterations, self.jobs) < 0:
            raise ValueError("expected counts of 1 or more, and rotate_every, tasks, warmup_iterations, jobs from 0 on")
        if len(self.log_std) != 2 or not all(LOG_STD_RANGE[0] <= v <= LOG_STD_RANGE[1] for v in self.log_std):
            raise ValueError(f"log_std: expected two numbers within {LOG_STD_RANGE}, found {self.log_std}")
        if unknown := sorted(set(self.rotation) - set(SHARES)):
            raise ValueError(f"rotation: unknown kind {unknown[0]!r}, expected of {', '.join(SHARES)}")
        if not self.rotation or self.drift not in ("none", "typical", "severe"):
            raise ValueError("expected a rotation of one kind or more, and drift none, typical or severe")
        if not (self.reward_scale > 0 and 0 <= self.mean_delay_s <= 30 and 5 <= self.max_s <= 3600):
            raise ValueError("expected reward_scale above 0, mean_delay_s from 0 to 30 and max_s from 5 to 3600")
        if not (self.imitation >= 0 and 0 <= self.fall_back <= 1 and 0 <= self.keep_margin <= 1):
            raise ValueError("expected imitation from 0 on, fall_back and keep_margin from 0 to 1")

    def kinds(self, iteration: int) -> dict[str, float]:
        """Return the shares of the kinds of scenes of an iteration."""
        if self.rotate_every == 0:
            return dict.fromkeys(self.rotation, 1.0)
        return {self.rotation[(iteration // self.rotate_every) % len(self.rotation)]: 1.0}

    def numbers(self, iteration: int) -> tuple[int, ...]:
        """Return the numbers of an iteration's scenarios."""
        first = iteration * self.episodes
        return tuple(n % self.tasks if self.tasks else n for n in range(first, first + self.episodes))

    def delays(self) -> LatencyProfile:
        """Return the latency profile to draw from. Raises LatencyError."""
        if self.delay_profile:
            return load_profile(Path(self.delay_profile))
        times = tuple(round(float(v), 4) for v in np.linspace(0.0, 2 * self.mean_delay_s, _DELAYS))
        return LatencyProfile("training", "drawn", times)
