"""Configuration of the stages that drive: `rl` (PPO, Table 9, and the selection of the best policy) and `evaluate`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Final, TypeAlias

import numpy as np

from edge.inference.latency_profile import LatencyProfile, load_profile
from tools.train.config.checks import Checked, Count, Jobs, Natural, Positive, Range, Share
from tools.train.config.collect import SHARES, TASKS_PER_SCENE

POLICIES: Final = ("action", "point-goal")
DRIFTS: Final = ("none", "typical", "severe")
Rate: TypeAlias = Annotated[float, Range(0, 1, above=True, below=True)]
_DELAYS: Final = 41
LOG_STD_RANGE = (-4.0, 0.5)
"""Range of the exploration's log standard deviation: 0.018 to 1.6 m/s or rad/s. Less does not explore, more does not
drive."""


@dataclass(frozen=True)
class PpoConfig(Checked):
    """PPO constants (Table 9).

    Once a minibatch's KL divergence exceeds 1.5 `target_kl`, an update trains only the value function; 0: no limit.
    """

    action_lr: Rate = 1e-5
    value_lr: Rate = 1e-4
    gamma: Annotated[float, Range(0, 1, above=True)] = 0.99
    gae_lambda: Share = 0.95
    clip: Rate = 0.2
    grad_clip: Positive = 0.5
    entropy: Annotated[float, Range(0)] = 0.001
    epochs: Count = 5
    batch: Annotated[int, Range(2)] = 64
    target_kl: Annotated[float, Range(0)] = 0.0


@dataclass(frozen=True)
class RlConfig(Checked):
    """Online reinforcement learning of the action expert's last layer and head."""

    policy: str = "action"
    """`action`: train the action expert's last layer and head; `point-goal`: the paper's baseline, from scratch."""
    iterations: Count = 300
    episodes: Count = 16
    """Episodes of one iteration, about 4,000 steps at 250 steps each (the paper: 1,024 steps)."""
    episodes_per_job: Count = TASKS_PER_SCENE
    """Episodes of one worker job: those of one layout, because a job must also generate the layout's earlier tasks."""
    ppo: PpoConfig = field(default_factory=PpoConfig)
    log_std: tuple[float, ...] = (-1.9, -1.5)
    """Initial log standard deviations of v and ω: 0.15 m/s and 0.22 rad/s."""
    reward_scale: Positive = 0.01
    mean_delay_s: Annotated[float, Range(0, 30)] = 5.0
    """Latencies are drawn uniformly from 0 to twice this, s (paper: about 50 environment steps on average)."""
    delay_profile: str = ""
    """Latency profile of `edge-calib latency` to draw from instead."""
    rotation: tuple[str, ...] = ("office", "hospital", "warehouse")
    rotate_every: Natural = 100
    """Iterations in one kind of scene before the next; 0: all kinds in every iteration."""
    tasks: Natural = 3
    """Tasks of each kind, all in one layout, repeated with new crowds; 0: always new tasks."""
    drift: str = "typical"
    max_s: Annotated[float, Range(5, 3600)] = 90.0
    warmup_iterations: Natural = 3
    """First iterations, in which only the value network is trained."""
    imitation: Annotated[float, Range(0)] = 0.0
    """Weight of a penalty on the distance from the imitated policy's commands; the paper has none."""
    evaluate_every: Count = 10
    evaluate_episodes: Count = 24
    keep_margin: Share = 0.06
    """Least gain in success over the best policy to replace it, because scores are noisy."""
    fall_back: Share = 0.08
    """Loss of success against the best policy, or rise of collisions without more success, that resets to the best."""
    final_episodes: Count = 32
    """Episodes on other scenarios that compare the first and the best policy; the best is kept if it is ahead."""
    jobs: Jobs = 0
    """Worker processes; 0: one per core. Does not change the result."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.policy not in POLICIES:
            raise ValueError(f"policy {self.policy!r}: expected one of {', '.join(POLICIES)}")
        if len(self.log_std) != 2 or not all(LOG_STD_RANGE[0] <= v <= LOG_STD_RANGE[1] for v in self.log_std):
            raise ValueError(f"log_std: expected two numbers within {LOG_STD_RANGE}, found {self.log_std}")
        if unknown := sorted(set(self.rotation) - set(SHARES)):
            raise ValueError(f"rotation: unknown kind {unknown[0]!r}, expected of {', '.join(SHARES)}")
        if not self.rotation or self.drift not in DRIFTS:
            raise ValueError(f"expected a rotation of one kind or more, and a drift of {', '.join(DRIFTS)}")

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


@dataclass(frozen=True)
class EvaluateConfig(Checked):
    """Episodes of the evaluation and the latency of reasoning in them."""

    episodes: Annotated[int, Range(1, 10_000)] = 60
    scenario_seed: Annotated[int, Range(0, 9_999)] = 9001
    """Seed of the layouts (`tools.train.drives.scenarios`); no other stage uses this one."""
    kinds: Mapping[str, float] = field(default_factory=dict)
    """Shares of the kinds of scenes; empty: the default shares."""
    latency_s: Annotated[float, Range(0, 60)] = 2.0
    drift: str = "none"
    jobs: Jobs = 0
    """Parallel processes; 0: one per core. Does not change the results."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.drift not in DRIFTS:
            raise ValueError(f"drift: expected one of {', '.join(DRIFTS)}, found {self.drift!r}")
