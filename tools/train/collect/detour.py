"""Some other place that a robot leaves its told way for, for a while: what there is to learn is how it comes back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import hypot
from typing import Final

import numpy as np

from edge.core.geometry import SE2
from sim_hil.benchmark.env.observation import Observation
from sim_hil.benchmark.env.world import EpisodeWorld
from sim_hil.benchmark.language.openings import LINEAR, Frame, Opening, bounds_of, side_openings
from sim_hil.benchmark.language.route import RouteError, Step
from sim_hil.benchmark.language.tasks import Task, draw_start
from sim_hil.benchmark.policies.expert import ExpertPolicy
from sim_hil.benchmark.suite.episode import Episode
from sim_hil.scene.scene import Vec2
from tools.train.collect.steering import Velocity
from tools.train.scenes.sites import Site

_LATEST: Final = 0.8  # of the way is behind it at most where it leaves it
_LEAST_M: Final = 1.0
_NEAR_M: Final = 1.0  # to the other place, where it turns back at the latest
_MISTAKEN: Final = 0.6  # of detours are into a wrong opening, where there is one
_INTO_M: Final = 2.0  # so deep it goes into one before it turns back
_BEFORE_M: Final = 1.5  # of the mouth, or of where the way turns off before it, it leaves the way
_GRAIN_M: Final = 0.1
_NEARBY_M: Final = 8.0  # from the one that is to be taken
_SAME_M: Final = 1.0
_NEXT_M: Final = 15.0  # the one counted next to it may be farther away


@dataclass(frozen=True)
class Detour:
    """Towards `to` (x m, y m in the world) after `after_m` of driving, for `for_m` of it."""

    to: Vec2
    after_m: float
    for_m: float


def draw_detour(site: Site, robot: str, task: Task, most_m: float, rng: np.random.Generator) -> Detour | None:
    """A detour from a task's way: into a wrong opening, as who has miscounted takes, or up to `most_m` to anywhere.

    None where no place was found.
    """
    mistaken, where, far = (float(value) for value in rng.uniform(size=3))
    if mistaken < _MISTAKEN and (found := wrong_opening(site, robot, task, rng)) is not None:
        return found
    try:
        x, y, _ = draw_start(site.scene, site.robot_grid(robot), rng)
    except RouteError:
        return None
    return Detour((x, y), where * _LATEST * task.told.length_m, _LEAST_M + far * (most_m - _LEAST_M))


def wrong_opening(site: Site, robot: str, task: Task, rng: np.random.Generator) -> Detour | None:
    """Into some other opening near one that is to be taken."""
    choices = [(step, opening) for step in task.told.steps for opening in _others(site, step)]
    if not choices:
        return None
    step, opening = choices[int(rng.integers(len(choices)))]
    frame, sign = Frame(step.ahead), 1.0 if opening.side == "left" else -1.0
    middle_m, across_m = opening.middle_m, frame.across(step.at)
    mouth = frame.point(middle_m, across_m)
    low_m, high_m = frame.span(bounds_of(opening.area))[1]
    # A passage that is crossed begins on the other side already.
    edge_m = max(low_m, across_m) if sign > 0 else min(high_m, across_m)
    depth_m = high_m - edge_m if sign > 0 else edge_m - low_m
    inside = frame.point(middle_m, edge_m + sign * min(_INTO_M + _NEAR_M, 0.7 * depth_m))
    to = site.robot_grid(robot).nearest_free(*inside)
    if to is None or not opening.area.contains(*to):
        return None
    # One that comes after the right one is missed by passing that, not by leaving where it leads.
    along_m, (x, y) = min(_nearest_on(task.path, mouth), _nearest_on(task.path, step.at))
    return Detour(to, max(along_m - _BEFORE_M, 0.0), _BEFORE_M + 1.5 * hypot(to[0] - x, to[1] - y))


def _others(site: Site, step: Step) -> list[Opening]:
    """Openings that a step's is mistaken for: those counted next to it, and any to the sides not far from it."""
    frame = Frame(step.ahead)
    at_m, across_m = frame.along(step.at), frame.across(step.at)
    found = [
        opening
        for number, opening in enumerate(step.counted, start=1)
        if abs(number - step.ordinal) == 1 and abs(opening.middle_m - at_m) <= _NEXT_M
    ]
    before = frame.point(at_m - _GRAIN_M, across_m)
    followed = [area for area in site.scene.areas if area.kind in LINEAR and area.contains(*before)][:1]
    for side in ("left", "right") if followed else ():
        for opening in side_openings(site.scene, site.grid, frame, followed, [], side):
            past_m = opening.middle_m - at_m
            taken = side == step.side and abs(past_m) < _SAME_M
            if not taken and -min(step.before_m, _NEARBY_M) <= past_m <= _NEARBY_M:
                found.append(opening)
    return found


def _nearest_on(path: Sequence[Vec2], point: Vec2) -> tuple[float, Vec2]:
    """How far along a path its point nearest to another one is, m, and which that is."""
    corners = np.array(path, np.float64)
    lengths = np.hypot(*np.diff(corners, axis=0).T)
    marks = np.concatenate([[0.0], np.cumsum(lengths)])
    at = np.append(np.arange(0.0, marks[-1], _GRAIN_M), marks[-1])
    xs, ys = (np.interp(at, marks, corners[:, axis]) for axis in range(2))
    nearest = int(np.argmin(np.hypot(xs - point[0], ys - point[1])))
    return float(at[nearest]), (float(xs[nearest]), float(ys[nearest]))


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
