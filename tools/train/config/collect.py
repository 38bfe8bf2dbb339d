"""Configuration of recorded data: kinds of scenes, drives of the expert, tours, and DAgger rounds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from types import MappingProxyType
from typing import Annotated, Final

from sim_hil.layouts import KINDS as LAYOUTS
from tools.train.config.checks import Checked, Jobs, Natural, Quality, Range, Share

CORRIDOR: Final = "corridor"
KINDS: Final = (*LAYOUTS, CORRIDOR)
OUTDOORS: Final = frozenset(("sidewalk",))
TASKS_PER_SCENE: Final = 8
SHARES: Final[Mapping[str, float]] = MappingProxyType(
    {"hospital": 0.25, "office": 0.25, "warehouse": 0.24, "sidewalk": 0.20, CORRIDOR: 0.06}
)
"""Default shares of the kinds of scenes."""


def check_shares(kinds: Mapping[str, float]) -> None:
    """Raise ValueError unless `kinds` are shares of known kinds of scenes, of which one is positive."""
    if unknown := sorted(set(kinds) - set(KINDS)):
        raise ValueError(f"kinds: expected some of {', '.join(KINDS)}, found {unknown[0]}")
    if not all(0 <= share < inf for share in kinds.values()) or not any(kinds.values()):
        raise ValueError(f"kinds: expected shares of 0 or more, one of them positive, found {dict(kinds)}")


RATE_HZ: Final = 10
"""Frames per second of a recorded drive."""
TRACE_EVERY: Final = 10
"""Frames between two reasoning texts: one per second."""


@dataclass(frozen=True)
class CollectConfig(Checked):
    """Number, scenes and variation of the expert's drives. The same values and seed give the same drives.

    A `..._share` is the probability for each drive.
    """

    episodes: Annotated[int, Range(1, 1_000_000)] = 700
    kinds: Mapping[str, float] = field(default_factory=dict)
    """Shares of the kinds of scenes; empty: SHARES."""
    drives_per_layout: Annotated[int, Range(1, 100)] = 4
    """Drives in each layout. Fewer give more layouts, but each layout takes time to generate."""
    jobs: Jobs = 0
    """Parallel processes; 0: one per core. Does not change the drives."""
    noise_share: Share = 0.3
    """Drives with bursts of steering noise."""
    legs: bool = True
    """Whether robots walk and roll under physics. Without, a stand-in glides with their measured response, and a drive
    costs less (sim_hil/simulation/gliding.py)."""
    sharp_share: Share = 0.3
    """Drives whose images are rendered at twice the size and reduced, which resembles a real camera."""
    jpeg_quality_min: Annotated[int, Range(30, 100)] = 80
    jpeg_quality_max: Quality = 95
    typical_drift_share: Share = 0.5
    severe_drift_share: Share = 0.1
    speed_mps: Annotated[float, Range(0.2, 1.5)] = 0.8
    """Speed of the expert, m/s: the limit on the robot, as a policy could not imitate a faster expert."""
    margin_m: Annotated[float, Range(0, 0.5)] = 0.1
    """Distance kept to people in addition to the benchmark expert's, m."""
    wall_m: Annotated[float, Range(0, 0.3)] = 0.0
    """Distance kept to walls and objects in addition to the benchmark expert's where there is room, m."""
    arrive_share: Annotated[float, Range(0.3, 1)] = 0.7
    """A drive ends at this share of the success distance from the goal, so that the last metres are learned too."""
    linger_s: Annotated[float, Range(0, 10)] = 0.0
    """Longest recording after arrival, s; each drive takes between half of it and all of it. It teaches standing."""
    stray_share: Share = 0.0
    stray_m: Annotated[float, Range(1, 50)] = 6.0
    """Share of the expert's drives that leave the route and come back, and the longest detour, m. Most detours lead
    into an opening near the correct one, the others to any other place."""
    stray_into_m: Annotated[float, Range(2, 20)] = 2.0
    """Greatest depth that the robot enters a wrong opening, m; drawn from 2 m on for each detour."""
    turned_share: Share = 0.0
    """Drives that begin with a random heading and not along the route; the instruction says how to turn."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kinds:
            check_shares(self.kinds)
        if self.typical_drift_share + self.severe_drift_share > 1:
            raise ValueError("expected shares of the drifts with a sum up to 1")
        if self.jpeg_quality_min > self.jpeg_quality_max:
            raise ValueError("expected jpeg_quality_min up to jpeg_quality_max")


@dataclass(frozen=True)
class TourConfig(Checked):
    """Number and variation of tours. The same values and seed give the same tours.

    Exception: single pixels may differ in a layout whose recording was interrupted, because the renderer draws objects
    in the order in which it first saw them. A `..._share` is the probability for each tour.
    """

    count: Annotated[int, Range(0, 1_000_000)] = 0
    """Number of tours; 0: none."""
    per_layout: Annotated[int, Range(1, 100)] = 8
    kinds: Mapping[str, float] = field(default_factory=dict)
    """Shares of the kinds of scenes; empty: those of the drives."""
    people_most: Annotated[int, Range(0, 200)] = 20
    """Upper limit of people in a scene: more would occlude the described objects and slow the simulation."""
    stray_share: Share = 0.35
    """Tours that leave the route and come back; most lead into an opening near the correct one."""
    stray_m: Annotated[float, Range(1, 50)] = 8.0
    """Longest detour to another place, m."""
    stray_into_m: Annotated[float, Range(2, 20)] = 2.0
    """Greatest depth that the robot enters a wrong opening, m; drawn from 2 m on for each detour."""
    turned_share: Share = 0.0
    """Tours that begin with a random heading and not along the route; the instruction says how to turn."""
    linger_s: Annotated[float, Range(0, 60)] = 5.0
    """Longest recording after arrival, s; each tour takes between half of it and all of it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kinds:
            check_shares(self.kinds)


@dataclass(frozen=True)
class DaggerConfig(Checked):
    """Rounds in which the expert relabels the policy's own drives and imitation continues on them."""

    rounds: Annotated[int, Range(0, 100)] = 2
    episodes: Annotated[int, Range(1, 100_000)] = 150
    """Drives of the policy in one round."""
    expert_episodes: Annotated[int, Range(0, 100_000)] = 0
    """Additional drives of the expert alone in new layouts."""
    newest_only: bool = False
    """Train on the newest round's drives alone; the round then needs only the weights from before it."""
    sft_rounds: Natural = 1
    """The language model continues after this many first rounds: the expert's drives hardly contain missed turns."""
    latency_mean_s: Annotated[float, Range(0, 10)] = 2.0
    """Mean generation time in those drives; each drive draws its own between 0 and twice this."""
