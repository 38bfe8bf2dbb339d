"""What the benchmark drives with: a policy turns observations into velocities, ten a second."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

from sim_hil.benchmark.env.observation import Observation
from sim_hil.benchmark.suite.episode import Episode

if TYPE_CHECKING:
    from sim_hil.benchmark.env.world import EpisodeWorld

Velocity = tuple[float, float, float]


class Policy(Protocol):
    """Drives one episode after the other; the same episodes, wordings and seeds give the same velocities."""

    @property
    def name(self) -> str:
        """What results call it."""
        ...

    @property
    def privileged(self) -> bool:
        """Whether it looks at the world itself instead of at observations only."""
        ...

    @property
    def needs_image(self) -> bool:
        """Whether its observations must hold a picture."""
        ...

    def reset(self, episode: Episode, instruction: str, world: EpisodeWorld | None, seed: int) -> None:
        """Begin an episode; only a privileged policy is given the world."""
        ...

    def act(self, observation: Observation) -> Velocity:
        """Body velocity for the next 0.1 s: vx m/s, vy m/s, wz rad/s."""
        ...

    def notes(self) -> Mapping[str, object]:
        """What the last act knew (such as `delay_s`, `text`, `waypoints` [[x, y], ...] m in the base frame)."""
        ...

    def close(self) -> None:
        """Let go of everything; may be called twice."""
        ...
