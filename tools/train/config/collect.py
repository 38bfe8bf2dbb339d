"""The numbers of recorded data: drives of the expert, tours, and rounds of DAgger."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

RATE_HZ: Final = 10
TRACE_EVERY: Final = 10  # frames: reasoning is written down once a second
PLANNED_DRIVE_S: Final = 30.0


@dataclass(frozen=True)
class CollectConfig:
    """How many drives of the expert, where, and how varied. The same numbers and seed give the same drives.

    What is called a share is the chance of each drive.
    """

    episodes: int = 700
    kinds: Mapping[str, float] = field(default_factory=dict)
    """Shares of the kinds of scenes; empty: those of `tools.train.scenes.scenarios`."""
    drives_per_layout: int = 4
    """Fewer show more places; each place takes its time to be thought up, and a process makes the drives in it."""
    jobs: int = 0
    """Processes at a time; 0: as many as there are cores. Changes nothing in what comes out."""
    noise_share: float = 0.3
    """Drives in which the steering is disturbed now and then."""
    sharp_share: float = 0.3
    """Drives whose pictures are rendered twice as large and shrunk, as a real camera's are."""
    jpeg_quality_min: int = 80
    jpeg_quality_max: int = 95
    typical_drift_share: float = 0.5
    severe_drift_share: float = 0.1
    speed_mps: float = 0.8
    """The expert's, which is what a policy may drive on board: it could not follow a faster one."""
    margin_m: float = 0.1
    """Kept to people beyond what the benchmark's expert keeps."""
    wall_m: float = 0.0
    """Kept to walls and things beyond what it keeps, where there is room."""
    arrive_share: float = 0.7
    """Of the distance that counts as arrived: so near the goal a drive goes, that the last metres are learned too."""
    linger_s: float = 0.0
    """A drive goes on for up to so long after it has arrived, and at least half of it: to stay there, where the expert
    comes to rest, is to be learned as well."""
    stray_share: float = 0.0
    stray_m: float = 6.0
    """Drives of the expert that leave their way and come back: as a rule for an opening near the one that is to be
    taken, else for some other place, up to so far."""

    def __post_init__(self) -> None:
        if not 1 <= self.episodes <= 1_000_000 or not 0 <= self.jobs <= 1024:
            raise ValueError(f"expected 1 to 1000000 episodes and 0 to 1024 jobs, found {self.episodes}, {self.jobs}")
        shares = (self.noise_share, self.sharp_share, self.typical_drift_share, self.severe_drift_share)
        if not all(0 <= share <= 1 for share in shares) or self.typical_drift_share + self.severe_drift_share > 1:
            raise ValueError(f"expected shares of 0 to 1, those of the drifts 1 together at most, found {shares}")
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
"""How the lines of a budget begin that are not of drives."""


@dataclass(frozen=True)
class TourConfig:
    """How many tours, and how varied. The same numbers and seed give the same tours.

    But for a pixel here and there in those of a layout that was ended in between: a renderer draws what it has drawn
    before in the order in which it first did.
    What is called a share is the chance of each tour.
    """

    count: int = 0
    """0: none."""
    per_layout: int = 8
    people_most: int = 20
    """More people than these a scene never has: they hide what is spoken of, and take their time to be moved."""
    stray_share: float = 0.35
    """Tours that leave their way, as a rule for an opening near theirs, else for some other place, and come back."""
    stray_m: float = 8.0
    """So far they are carried to some other place at most."""
    linger_s: float = 5.0
    """A tour goes on for up to so long after it has arrived, half of it at least: on to the goal, where it stands."""

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
    """Rounds in which the expert relabels the policy's own drives, after which imitation goes on."""

    rounds: int = 2
    episodes: int = 150
    """Drives of the policy in one round."""
    expert_episodes: int = 0
    """New drives of the expert alone beside them, in other layouts than all before."""
    newest_only: bool = False
    """Learn after a round from its drives alone. It then needs nothing of what is before it but the weights."""
    sft_rounds: int = 1
    """The language model goes on after so many of the first rounds: an expert's drives hardly show it a missed turn."""
    latency_mean_s: float = 2.0
    """Mean generation time in those drives; each drive draws its own between 0 and twice this."""

    def __post_init__(self) -> None:
        if not (0 <= self.rounds <= 100 and 1 <= self.episodes <= 100_000 and 0 <= self.latency_mean_s <= 10):
            raise ValueError("expected 0 to 100 rounds of 1 to 100000 episodes and a mean latency of 0 to 10 s")
        if min(self.sft_rounds, self.expert_episodes) < 0 or self.expert_episodes > 100_000:
            raise ValueError("expected sft_rounds from 0 on and expert_episodes of 0 to 100000")
