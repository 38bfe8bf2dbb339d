"""Some other place that a robot leaves its told way for, for a while: what there is to learn is how it comes back."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import hypot
from typing import Final

import numpy as np

from edge.geometry import SE2
from sim_hil.benchmark.episode import Episode
from sim_hil.benchmark.expert import ExpertPolicy
from sim_hil.benchmark.observation import Observation
from sim_hil.benchmark.route import RouteError
from sim_hil.benchmark.tasks import draw_start
from sim_hil.benchmark.world import EpisodeWorld
from sim_hil.scene import Vec2
from tools.train.sites import Site
from tools.train.steering import Velocity

_LATEST: Final = 0.8  # of the way is behind it at most where it leaves it
_LEAST_M: Final = 1.0
_NEAR_M: Final = 1.0  # to the other place, where it turns back at the latest


@dataclass(frozen=True)
class Detour:
    """Towards `to` (x m, y m in the world) after `after_m` of driving, for `for_m` of it."""

    to: Vec2
    after_m: float
    for_m: float


def draw_detour(site: Site, robot: str, length_m: float, most_m: float, rng: np.random.Generator) -> Detour | None:
    """A detour of up to `most_m` from a way of `length_m`; None where no place was found."""
    where, far = (float(value) for value in rng.uniform(size=2))
    try:
        x, y, _ = draw_start(site.scene, site.robot_grid(robot), rng)
    except RouteError:
        return None
    return Detour((x, y), where * _LATEST * length_m, _LEAST_M + far * (most_m - _LEAST_M))


class Course:
    """Whether one is on a detour, by how far one has come."""

    def __init__(self, detour: Detour) -> None:
        self._detour = detour
        self._gone_m = self._off_m = 0.0
        self._over = False

    @property
    def aside(self) -> bool:
        """Whether to drive to the other place now."""
        return not self._over and self._gone_m >= self._detour.after_m

    def went(self, gone_m: float, pose: SE2) -> None:
        """So far, to this pose."""
        if self.aside:
            self._off_m += gone_m
            (x, y), far = self._detour.to, self._off_m >= self._detour.for_m
            self._over = far or hypot(x - pose.x_m, y - pose.y_m) < _NEAR_M
        self._gone_m += gone_m


class DetourDriver:
    """Drives to the other place as an expert would, while the course is aside."""

    def __init__(self, detour: Detour, episode: Episode, world: EpisodeWorld, teacher: ExpertPolicy) -> None:
        """Raises ValueError where there is no way to it, or it is where the episode begins."""
        elsewhere = replace(episode, goal_xy=detour.to, threshold_m=_NEAR_M)
        self._expert = teacher.alike()
        self._expert.reset(elsewhere, episode.instructions[0], world, episode.seed)
        self._course, self._world, self._last = Course(detour), world, world.pose()

    def command(self, observation: Observation) -> Velocity | None:
        """What is commanded instead of the teacher's command; None while the teacher drives."""
        pose = self._world.pose()
        self._course.went(hypot(pose.x_m - self._last.x_m, pose.y_m - self._last.y_m), pose)
        self._last = pose
        return self._expert.act(observation) if self._course.aside else None

    def close(self) -> None:
        """Forget the world."""
        self._expert.close()
