"""Other sources of commands than the expert: bursts of noise, or in DAgger rounds a policy, run by the robot's code."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, sqrt
from pathlib import Path
from typing import Final

import numpy as np

from edge.artifacts.files import ArtifactError
from sim_hil.benchmark.conditions.latency import LatencyProfile
from sim_hil.benchmark.env.observation import Observation
from sim_hil.benchmark.policies.artifacts_policy import ArtifactsPolicy
from sim_hil.benchmark.policies.select import robot_config
from sim_hil.benchmark.suite.episode import Episode
from tools.train.config.collect import RATE_HZ
from tools.train.drives.drive import EXPERT, NOISE, POLICY, POLICY_DRIVER

Velocity = tuple[float, float, float]

_SPEED_MPS: Final = (-0.3, 1.1)
"""Range of a disturbed forward speed, m/s: a robot's own limits."""
_TURN_RADPS: Final = 1.2
"""Upper limit of a disturbed yaw rate, rad/s."""


@dataclass(frozen=True)
class NoiseConfig:
    """Bursts of noise: an Ornstein-Uhlenbeck process on forward speed and yaw rate."""

    burst_s: tuple[float, float] = (0.5, 2.0)
    pause_s: tuple[float, float] = (2.0, 10.0)
    keep_s: float = 0.7
    """Correlation time of the noise, s."""
    speed_mps: float = 0.3
    turn_radps: float = 0.6


class SteeringNoise:
    """Adds bursts of noise to the expert's command; the same generator state gives the same bursts."""

    def __init__(self, rng: np.random.Generator, config: NoiseConfig | None = None) -> None:
        self._rng = rng
        self._config = config if config is not None else NoiseConfig()
        self._left = -self._ticks(
            self._config.pause_s
        )  # negative: remaining ticks of the pause; positive: of the burst
        self._offset = np.zeros(2)

    def _ticks(self, bounds_s: tuple[float, float]) -> int:
        return max(1, round(float(self._rng.uniform(*bounds_s)) * RATE_HZ))

    def command(self, wanted: Velocity) -> tuple[Velocity, int]:
        """Return the command in place of `wanted` and its source, EXPERT or NOISE."""
        config = self._config
        sigma = np.array((config.speed_mps, config.turn_radps))
        if self._left < 0:
            self._left += 1
            if self._left < 0:
                return wanted, EXPERT
            self._left = self._ticks(config.burst_s)
            self._offset = sigma * self._rng.standard_normal(2)
        keep = exp(-1 / RATE_HZ / config.keep_s)
        self._offset = keep * self._offset + sqrt(1 - keep * keep) * sigma * self._rng.standard_normal(2)
        self._left -= 1
        if self._left == 0:
            self._left = -self._ticks(config.pause_s)
        speed = min(max(wanted[0] + float(self._offset[0]), _SPEED_MPS[0]), _SPEED_MPS[1])
        turn = min(max(wanted[2] + float(self._offset[1]), -_TURN_RADPS), _TURN_RADPS)
        return (speed, wanted[1], turn), NOISE


class SharedControl:
    """Alternates between policy and expert: each stretch is the expert's with probability `beta` (DAgger)."""

    STRETCH_S: Final = (2.0, 5.0)
    """Range of a stretch's duration, s."""

    def __init__(self, rng: np.random.Generator, beta: float) -> None:
        if not 0 <= beta <= 1:
            raise ValueError(f"beta: expected 0 to 1, found {beta}")
        self._rng = rng
        self._beta = beta
        self._left = 0
        self._expert = False

    def command(self, wanted: Velocity, policys: Velocity) -> tuple[Velocity, int]:
        """Choose the expert's command `wanted` or the policy's; return it and its source, EXPERT or POLICY."""
        if self._left == 0:
            self._left = max(1, round(float(self._rng.uniform(*self.STRETCH_S)) * RATE_HZ))
            self._expert = bool(self._rng.uniform() < self._beta)
        self._left -= 1
        return (wanted, EXPERT) if self._expert else (policys, POLICY)


SHORTEST_S: Final = 0.5
"""Shortest latency of a generation, s."""
LONGEST_S: Final = 6.0
"""Longest mean latency of a drive, s."""
_TIMES: Final = 16  # latencies in one drive's profile
_SPREAD: Final = 0.25  # largest relative deviation of a latency from the drive's mean


@dataclass(frozen=True)
class PolicyOptions:
    """Artifacts that drive, share `beta` of the expert's commands, and mean latency of generations, s."""

    artifacts: str
    manifest_sha256: str
    beta: float
    latency_mean_s: float

    def __post_init__(self) -> None:
        if not 0 <= self.beta <= 1 or not 0 <= self.latency_mean_s <= 10:
            raise ValueError(f"expected beta from 0 to 1 and a mean latency of 0 to 10 s, found {self}")


def draw_latency(mean_s: float, rng: np.random.Generator) -> LatencyProfile:
    """Draw the latencies of one drive around its own mean, which lies between 0.5 s and 2 `mean_s` (6 s at most)."""
    longest_s = min(max(2 * mean_s, SHORTEST_S), LONGEST_S)
    own_s = float(rng.uniform(SHORTEST_S, longest_s))
    times = tuple(round(float(own_s * share), 3) for share in rng.uniform(1 - _SPREAD, 1 + _SPREAD, _TIMES))
    return LatencyProfile(f"{own_s:.1f} s", "drawn for training", times)


class PolicyDriver:
    """The artifacts' policy in one drive. Raises ArtifactError, InstructionError."""

    def __init__(self, options: PolicyOptions, episode: Episode, rng: np.random.Generator) -> None:
        latency = draw_latency(options.latency_mean_s, rng)
        directory = Path(options.artifacts)
        self._policy = ArtifactsPolicy(directory, mode="async", latency=latency, robot=robot_config())
        if self._policy.manifest_sha256 != options.manifest_sha256:
            raise ArtifactError(f"{directory}: not the artifacts that this round was started with")
        self.name = f"{POLICY_DRIVER}{options.manifest_sha256[:12]}"
        self._shared = SharedControl(rng, options.beta)
        instruction = episode.instructions[int(rng.integers(len(episode.instructions)))]
        self._policy.reset(episode, instruction, None, episode.seed)

    def steer(self, observation: Observation, wanted: Velocity) -> tuple[Velocity, int]:
        """Return the command and its source: the policy's, or `wanted` in the expert's stretches.

        The policy processes every frame.
        """
        return self._shared.command(wanted, self._policy.act(observation))

    def __enter__(self) -> PolicyDriver:
        return self

    def __exit__(self, *_: object) -> None:
        self._policy.close()
