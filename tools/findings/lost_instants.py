"""The generations of an episode beside the text that would have been true at each newest frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from edge.core.geometry import SE2
from edge.state.reasoning_text import ReasoningText, parse_text
from sim_hil.benchmark.policies.expert import NEAR, along, driving_of, from_here
from sim_hil.benchmark.policies.expert_route import RoutePlanner
from tools.train.config.collect import CollectConfig
from tools.train.drives.drive import PLAN_TIMES_S
from tools.train.drives.scenarios import Scenario
from tools.train.drives.traces import Tracer, turning_first
from tools.train.samples.anchors import turns_back

LOST_M: Final = 2.0
"""Walking distance to the route beyond which the robot is lost, m; also where the true plan is to turn back."""
_REACH_M: Final = 10.0  # planned length of a route, as for tours


@dataclass(frozen=True)
class Instant:
    """One generation: its text, and the truth at its newest frame."""

    time_s: float
    driven_m: float
    """Distance driven since the episode's start, by odometry."""
    heading_rad: float
    said: ReasoningText
    overruled: bool
    """Whether a decoding rule chose the progress."""
    true_back: bool
    """Whether the true plan is to turn back."""
    true_progress: bool
    """Whether the text's progress is right."""
    strayed_m: float
    """Walking distance to the route, m."""

    @property
    def lost(self) -> bool:
        """Whether the robot has left its route."""
        return self.true_back or self.strayed_m > LOST_M

    @property
    def says_back(self) -> bool:
        """Whether the text plans to turn back."""
        return turns_back(self.said)


@dataclass(frozen=True)
class Deviation:
    """Consecutive instants at which the robot is lost."""

    begin_s: float
    noticed_s: float | None
    """Time from the beginning to the first text that plans to turn back; None: none did."""
    back_s: float | None
    """Time from the beginning to the first instant on the route; None: the episode ended before."""

    def contains(self, instant: Instant) -> bool:
        """Whether an instant of the same episode is one of these."""
        since_s = instant.time_s - self.begin_s
        return since_s >= 0.0 and (self.back_s is None or since_s < self.back_s)


class RouteTexts:
    """Writes the text that is true at a pose of one scenario, without people."""

    def __init__(self, scenario: Scenario) -> None:
        episode, config = scenario.episode, CollectConfig()
        self.tracer = Tracer(scenario)
        self._driving, self._speed_mps = driving_of(episode.robot), config.speed_mps
        near_m = NEAR * config.arrive_share * episode.threshold_m
        ground = scenario.site.planner_ground(episode.robot)
        self._planner = RoutePlanner(ground, episode.goal_xy, near_m, scenario.task.path)

    def at(self, pose: SE2) -> ReasoningText:
        """Return the true text; the plan is that of a robot that drives on along the shortest way."""
        nobody = np.zeros((0, 3))
        route = from_here(self._planner.route((pose.x_m, pose.y_m), nobody[:, :2], _REACH_M), pose)
        first = along(route, pose, self._speed_mps, self._driving, PLAN_TIMES_S)[0]
        means = [turning_first(first, self._driving.turn_radps, self._speed_mps)]
        return self.tracer.trace(pose, nobody, nobody[:, :2], means)


def instants_of(log: Mapping[str, Any], scenario: Scenario) -> list[Instant]:
    """Return the generations of an episode's log (`read_log`), in order."""
    columns, texts = log["columns"], RouteTexts(scenario)
    times = np.array(columns["time_s"], np.float64)
    x, y = (np.array(columns[name], np.float64) for name in ("odom_x_m", "odom_y_m"))
    driven = np.concatenate(((0.0,), np.cumsum(np.hypot(np.diff(x), np.diff(y)))))
    found = []
    for record in log["generations"]:
        k = int(np.argmin(np.abs(times - record["anchor_s"])))
        pose = SE2(*(float(columns[name][k]) for name in ("x_m", "y_m", "theta_rad")))
        said, truth = parse_text(str(record["text"])), texts.at(pose)
        found.append(
            Instant(
                time_s=float(times[k]),
                driven_m=float(driven[k]),
                heading_rad=pose.theta_rad,
                said=said,
                overruled=bool(record["overruled"]),
                true_back=turns_back(truth),
                true_progress=said.progress == truth.progress,
                strayed_m=texts.tracer.progress.strayed_m(pose),
            )
        )
    return found


def deviations(instants: Sequence[Instant]) -> list[Deviation]:
    """Return each stretch of an episode in which the robot was lost."""
    found, k = [], 0
    while k < len(instants):
        if not instants[k].lost:
            k += 1
            continue
        begin = k
        while k < len(instants) and instants[k].lost:
            k += 1
        begin_s = instants[begin].time_s
        said = next((each.time_s - begin_s for each in instants[begin:k] if each.says_back), None)
        found.append(Deviation(begin_s, said, instants[k].time_s - begin_s if k < len(instants) else None))
    return found
