"""The policy of a DAgger drive: exported artifacts, run by the robot's code."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from edge.artifacts.files import ArtifactError
from sim_hil.benchmark.conditions.latency import LatencyProfile
from sim_hil.benchmark.env.observation import Observation
from sim_hil.benchmark.policies.artifacts_policy import ArtifactsPolicy
from sim_hil.benchmark.policies.select import robot_config
from sim_hil.benchmark.suite.episode import Episode
from tools.train.collect.steering import SharedControl, Velocity
from tools.train.drives.drive import POLICY_DRIVER

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
