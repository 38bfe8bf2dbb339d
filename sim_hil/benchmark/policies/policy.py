"""Interface of a policy: it turns observations into velocities at 10 Hz."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

from sim_hil.benchmark.env.observation import Observation
from sim_hil.benchmark.suite.episode import Episode

if TYPE_CHECKING:
    from sim_hil.benchmark.env.world import EpisodeWorld

Velocity = tuple[float, float, float]


class Policy(Protocol):
    """A policy that drives episodes one after another; equal episodes, instructions and seeds give equal velocities."""

    @property
    def name(self) -> str:
        """Name of the policy in results."""
        ...

    @property
    def privileged(self) -> bool:
        """Whether the policy reads the simulator's ground truth in addition to observations."""
        ...

    @property
    def needs_image(self) -> bool:
        """Whether observations must contain an image."""
        ...

    def reset(self, episode: Episode, instruction: str, world: EpisodeWorld | None, seed: int) -> None:
        """Begin an episode; `world` is None for a policy that is not privileged."""
        ...

    def act(self, observation: Observation) -> Velocity:
        """Return the body velocity for the next 0.1 s: vx m/s, vy m/s, wz rad/s."""
        ...

    def notes(self) -> Mapping[str, object]:
        """Return details of the last `act`, such as `delay_s`, `text`, `waypoints` [[x, y], ...] (m, base frame)."""
        ...

    def close(self) -> None:
        """Release all resources; may be called twice."""
        ...
