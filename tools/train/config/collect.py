"""Configuration of recorded data: drives of the expert, tours, and DAgger rounds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

RATE_HZ: Final = 10
"""Frames per second of a recorded drive."""
TRACE_EVERY: Final = 10
"""Frames between two reasoning texts: one per second."""
PLANNED_DRIVE_S: Final = 30.0
"""Typical length of a drive, s; used only to estimate a run's work."""


@dataclass(frozen=True)
class CollectConfig:
    """Number, scenes and variation of the expert's drives. The same values and seed give the same drives.

    A `..._share` is the probability for each drive.
    """

    episodes: int = 700
    kinds: Mapping[str, float] = field(default_factory=dict)
    """Shares of the kinds of scenes; empty: the default shares (`tools.train.config.scenes`)."""
    drives_per_layout: int = 4
    """Drives in each layout. Fewer give more layouts, but each layout takes time to generate."""
    jobs: int = 0
    """Parallel processes; 0: one per core. Does not change the drives."""
    noise_share: float = 0.3
    """Drives with bursts of steering noise."""
    sharp_share: float = 0.3
    """Drives whose images are rendered at twice the size and reduced, which resembles a real camera."""
    jpeg_quality_min: int = 80
    jpeg_quality_max: int = 95
    typical_drift_share: float = 0.5
    severe_drift_share: float = 0.1
    speed_mps: float = 0.8
    """Speed of the expert, m/s: the limit on the robot, as a policy could not imitate a faster expert."""
    margin_m: float = 0.1
    """Distance kept to people in addition to the benchmark expert's, m."""
    wall_m: float = 0.0
    """Distance kept to walls and objects in addition to the benchmark expert's where there is room, m."""
    arrive_share: float = 0.7
    """A drive ends at this share of the success distance from the goal, so that the last metres are learned too."""
    linger_s: float = 0.0
    """Longest recording after arrival, s; each drive takes between half of it and all of it. It teaches standing."""
    stray_share: float = 0.0
    stray_m: float = 6.0
    """Share of the expert's drives that leave the route and come back, and the longest detour, m. Most detours lead
    into an opening near the correct one, the others to any other place."""

    def __post_init__(self) -> None:
        if not 1 <= self.episodes <= 1_000_000 or not 0 <= self.jobs <= 1024:
            raise ValueError(f"expected 1 to 1000000 episodes and 0 to 1024 jobs, found {self.episodes}, {self.jobs}")
        shares = (self.noise_share, self.sharp_share, self.typical_drift_share, self.severe_drift_share)
        if not all(0 <= share <= 1 for share in shares) or self.typical_drift_share + self.severe_drift_share > 1:
            raise ValueError(f"expected shares of 0 to 1 and a sum of the drift shares up to 1, found {shares}")
        if not 30 <= self.jpeg_quality_min <= self.jpeg_quality_max <= 100:
            raise ValueError("jpeg_quality: expected 30 <= min <= max <= 100")
        if not 1 <= self.drives_per_layout <= 100:
            raise ValueError(f"drives_per_layout: expected 1 to 100, found {self.drives_per_layout}")
        if not 0.2 <= self.speed_mps <= 1.5:
            raise ValueError(f"speed_mps: expected 0.2 to 1.5, found {self.speed_mps}")
        if not (0 <= self.stray_share <= 1 and 1 <= self.stray_m <= 50):
            raise ValueError("expected stray_share from 0 to 1 and stray_m from 1 to 50")
        if not 0 <= self.linger_s <= 10:
            raise ValueError(f"expected linger_s from 0 to 10, found {self.linger_s}")
        if not 0 <= self.wall_m <= 0.3:
            raise ValueError(f"expected wall_m from 0 to 0.3, found {self.wall_m}")
        if not 0 <= self.margin_m <= 0.5 or not 0.3 <= self.arrive_share <= 1:
            raise ValueError("expected margin_m from 0 to 0.5 and arrive_share from 0.3 to 1")


OF_TOURS: Final = "tours: "
"""Prefix of the budget lines that concern tours."""


@dataclass(frozen=True)
class TourConfig:
    """Number and variation of tours. The same values and seed give the same tours.

    Exception: single pixels may differ in a layout whose recording was interrupted, because the renderer draws objects
    in the order in which it first saw them. A `..._share` is the probability for each tour.
    """

    count: int = 0
    """Number of tours; 0: none."""
    per_layout: int = 8
    people_most: int = 20
    """Upper limit of people in a scene: more would occlude the described objects and slow the simulation."""
    stray_share: float = 0.35
    """Tours that leave the route and come back; most lead into an opening near the correct one."""
    stray_m: float = 8.0
    """Longest detour to another place, m."""
    linger_s: float = 5.0
    """Longest recording after arrival, s; each tour takes between half of it and all of it."""

    def __post_init__(self) -> None:
        if not 0 <= self.count <= 1_000_000 or not 1 <= self.per_layout <= 100:
            raise ValueError(
                f"expected a count of 0 to 1000000 and per_layout of 1 to 100, found {self.count}, {self.per_layout}"
            )
        if not 0 <= self.people_most <= 200 or not 0 <= self.stray_share <= 1:
            raise ValueError("expected people_most from 0 to 200 and stray_share from 0 to 1")
        if not (1 <= self.stray_m <= 50 and 0 <= self.linger_s <= 60):
            raise ValueError("expected stray_m from 1 to 50 and linger_s from 0 to 60")


@dataclass(frozen=True)
class DaggerConfig:
    """Rounds in which the expert relabels the policy's own drives and imitation continues on them."""

    rounds: int = 2
    episodes: int = 150
    """Drives of the policy in one round."""
    expert_episodes: int = 0
    """Additional drives of the expert alone in new layouts."""
    newest_only: bool = False
    """Train on the newest round's drives alone; the round then needs only the weights from before it."""
    sft_rounds: int = 1
    """The language model continues after this many first rounds: the expert's drives hardly contain missed turns."""
    latency_mean_s: float = 2.0
    """Mean generation time in those drives; each drive draws its own between 0 and twice this."""

    def __post_init__(self) -> None:
        if not (0 <= self.rounds <= 100 and 1 <= self.episodes <= 100_000 and 0 <= self.latency_mean_s <= 10):
            raise ValueError("expected 0 to 100 rounds of 1 to 100000 episodes and a mean latency of 0 to 10 s")
        if min(self.sft_rounds, self.expert_episodes) < 0 or self.expert_episodes > 100_000:
            raise ValueError("expected sft_rounds from 0 on and expert_episodes of 0 to 100000")
