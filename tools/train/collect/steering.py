"""Other sources of commands than the expert: bursts of noise, a policy in DAgger rounds, and detours.

On a detour the robot leaves the route for another place and comes back, so that coming back can be learned.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import exp, hypot, sqrt
from pathlib import Path
from typing import Final

import numpy as np

from edge.artifacts.files import ArtifactError
from edge.core.geometry import SE2
from edge.state.reasoning_text import Progress, parse_progress
from sim_hil.benchmark.conditions.latency import LatencyProfile
from sim_hil.benchmark.env.observation import Observation
from sim_hil.benchmark.env.world import EpisodeWorld
from sim_hil.benchmark.language.openings import LINEAR, Frame, Opening, bounds_of, side_openings
from sim_hil.benchmark.language.route import RouteError, Step
from sim_hil.benchmark.language.tasks import Task, draw_start
from sim_hil.benchmark.policies.artifacts_policy import ArtifactsPolicy
from sim_hil.benchmark.policies.expert import ExpertPolicy
from sim_hil.benchmark.policies.select import robot_config
from sim_hil.benchmark.suite.episode import Episode
from sim_hil.scene.scene import Vec2
from tools.train.config.collect import RATE_HZ
from tools.train.drives.drive import EXPERT, NOISE, POLICY, POLICY_DRIVER
from tools.train.drives.scenarios import Site

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
        self._rng, self._beta = rng, beta
        self._left, self._expert = 0, False

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
        # The expert may have made the turn of an instruction already, in a stretch of its own.
        self._policy = ArtifactsPolicy(
            directory, mode="async", latency=latency, robot=robot_config(), turns_as_told=False
        )
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

    def progress(self) -> Progress | None:
        """Return the progress of the newest text: the one that the next generation's prompt has; None before it."""
        return parse_progress(str(self._policy.notes().get("text", "")))

    def __enter__(self) -> PolicyDriver:
        return self

    def __exit__(self, *_: object) -> None:
        self._policy.close()


_LATEST: Final = 0.8  # a detour begins within this share of the route's length
_LEAST_M: Final = 1.0  # shortest detour
_NEAR_M: Final = 1.0  # distance to the other place at which the robot turns back
_MISTAKEN: Final = 0.6  # share of detours into a wrong opening, if the route has one
_INTO_M: Final = 2.0  # least depth that the robot enters a wrong opening
_BEFORE_M: Final = 1.5  # distance before the opening, or before the route's turn, at which the detour begins
_GRAIN_M: Final = 0.1  # spacing of the points at which a route is sampled
_NEARBY_M: Final = 8.0  # distance to the correct opening within which another one is mistaken for it
_SAME_M: Final = 1.0  # openings closer than this to the correct one are the correct one
_NEXT_M: Final = 15.0  # the same distance for the openings counted before and after it


@dataclass(frozen=True)
class Detour:
    """A detour towards `to` (x m, y m in the world) that begins after `after_m` of driving and lasts `for_m`."""

    to: Vec2
    after_m: float
    for_m: float


def draw_detour(
    site: Site, robot: str, task: Task, most_m: float, rng: np.random.Generator, *, into_m: float = _INTO_M
) -> Detour | None:
    """Draw a detour from a task's route: into a wrong opening, as after miscounting, or up to `most_m` to any place.

    `into_m`: greatest depth in a wrong opening. Returns None if no place was found.
    """
    mistaken, where, far = (float(value) for value in rng.uniform(size=3))
    if mistaken < _MISTAKEN and (found := wrong_opening(site, robot, task, rng, into_m=into_m)) is not None:
        return found
    try:
        x, y, _ = draw_start(site.scene, site.robot_grid(robot), rng)
    except RouteError:
        return None
    return Detour((x, y), where * _LATEST * task.route.length_m, _LEAST_M + far * (most_m - _LEAST_M))


def wrong_opening(
    site: Site, robot: str, task: Task, rng: np.random.Generator, *, into_m: float = _INTO_M
) -> Detour | None:
    """Draw a detour into an opening near the correct one, up to `into_m` deep; None if there is none."""
    choices = [(step, opening) for step in task.route.steps for opening in _others(site, step)]
    if not choices:
        return None
    step, opening = choices[int(rng.integers(len(choices)))]
    goal_m = (float(rng.uniform(_INTO_M, into_m)) if into_m > _INTO_M else _INTO_M) + _NEAR_M
    frame, sign = Frame(step.ahead), 1.0 if opening.side == "left" else -1.0
    middle_m, across_m = opening.middle_m, frame.across(step.at)
    mouth = frame.point(middle_m, across_m)
    low_m, high_m = frame.span(bounds_of(opening.area))[1]
    # A crossed passage already begins on the other side of the route.
    edge_m = max(low_m, across_m) if sign > 0 else min(high_m, across_m)
    depth_m = high_m - edge_m if sign > 0 else edge_m - low_m
    inside = frame.point(middle_m, edge_m + sign * min(goal_m, 0.7 * depth_m))
    to = site.robot_grid(robot).nearest_free(*inside)
    if to is None or not opening.area.contains(*to):
        return None
    # An opening behind the correct one is reached by passing the correct one, not from within it.
    along_m, (x, y) = min(_nearest_on(task.path, mouth), _nearest_on(task.path, step.at))
    return Detour(to, max(along_m - _BEFORE_M, 0.0), _BEFORE_M + 1.5 * hypot(to[0] - x, to[1] - y))


def _others(site: Site, step: Step) -> list[Opening]:
    """Return openings that can be mistaken for a step's: those counted before and after it, and others close to it."""
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
    """Return the distance along a path to its point nearest to `point`, m, and that nearest point."""
    corners = np.array(path, np.float64)
    lengths = np.hypot(*np.diff(corners, axis=0).T)
    marks = np.concatenate([[0.0], np.cumsum(lengths)])
    at = np.append(np.arange(0.0, marks[-1], _GRAIN_M), marks[-1])
    xs, ys = (np.interp(at, marks, corners[:, axis]) for axis in range(2))
    nearest = int(np.argmin(np.hypot(xs - point[0], ys - point[1])))
    return float(at[nearest]), (float(xs[nearest]), float(ys[nearest]))


class DetourProgress:
    """Tracks by the driven distance whether a detour is active."""

    def __init__(self, detour: Detour) -> None:
        self._detour = detour
        self._gone_m = self._off_m = 0.0
        self._over = False

    @property
    def active(self) -> bool:
        """Whether the robot drives to the other place now."""
        return not self._over and self._gone_m >= self._detour.after_m

    def advance(self, gone_m: float, pose: SE2) -> None:
        """Add the distance driven to `pose`, m."""
        if self.active:
            self._off_m += gone_m
            (x, y), far = self._detour.to, self._off_m >= self._detour.for_m
            self._over = far or hypot(x - pose.x_m, y - pose.y_m) < _NEAR_M
        self._gone_m += gone_m


class DetourDriver:
    """An expert that drives to the other place while the detour is active."""

    def __init__(self, detour: Detour, episode: Episode, world: EpisodeWorld, teacher: ExpertPolicy) -> None:
        """Raises ValueError if there is no path to the place, or the episode begins there."""
        elsewhere = replace(episode, goal_xy=detour.to, threshold_m=_NEAR_M)
        self._expert = teacher.alike()
        self._expert.reset(elsewhere, episode.instructions[0], world, episode.seed)
        self._progress, self._world, self._last = DetourProgress(detour), world, world.pose()

    def command(self, observation: Observation) -> Velocity | None:
        """Return the command that replaces the teacher's; None while the detour is not active."""
        pose = self._world.pose()
        self._progress.advance(hypot(pose.x_m - self._last.x_m, pose.y_m - self._last.y_m), pose)
        self._last = pose
        return self._expert.act(observation) if self._progress.active else None

    def close(self) -> None:
        """Release the world."""
        self._expert.close()
