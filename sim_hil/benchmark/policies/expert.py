"""The privileged expert: knows the scene's plan and where everybody is and walks; shows that an episode can be done.

It drives as a considerate person would: with room to walls and people, slowing, waiting or stepping back rather than
pushing, and it is the teacher of policies that see only pictures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import cos, hypot, sin
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.core.geometry import SE2
from sim_hil.benchmark.env.observation import Observation
from sim_hil.benchmark.env.world import EpisodeWorld
from sim_hil.benchmark.policies.expert_motion import CONTROL_S, Choice, Driving, Motion
from sim_hil.benchmark.policies.expert_route import SPACING_M, RoutePlanner
from sim_hil.benchmark.policies.policy import Velocity
from sim_hil.benchmark.suite.episode import Episode
from sim_hil.benchmark.suite.robots import max_step_m

Array = NDArray[np.float64]
Vec2 = tuple[float, float]

PLAN_TIMES_S: Final = (3.0, 6.0, 9.0)  # where a reasoning model is asked to say that it will be
_REPLAN_TICKS: Final = 5
_REACH_M: Final = 10.0  # length of the way looked at: 9 s of it, and what the last steps need to aim at
_SIGHT_M: Final = 7.0  # people further away do not matter yet
_VIEW_M: Final = 12.0  # who stands about within this is led round
_STANDING_MPS: Final = 0.25
_OFF_ROUTE_M: Final = 0.6
NEAR: Final = 0.8  # of the threshold: so near has arrived for certain
_END_M: Final = 0.4
_STUCK_S: Final = 6.0
_STUCK_M: Final = 0.5  # who has come no further than this in that time is stuck


# What the expert must know of a robot that the robot itself does not tell.
_DRIVINGS: Final[Mapping[str, Driving]] = MappingProxyType(
    {"go2": Driving(), "carter": Driving(body_radius_m=0.31, body_reach_m=0.12, margin_m=0.17)}
)


class ExpertPolicy:
    """Drives by the world itself; needs `reset` with a world."""

    name = "expert"
    privileged = True
    needs_image = False

    def __init__(
        self, *, margin_m: float = 0.0, speed_mps: float | None = None, told: Sequence[Vec2] = (),
        patient: bool = False, rests: bool = False, wall_m: float = 0.0,
    ) -> None:  # fmt: skip
        """For a teacher: `margin_m` kept to people beyond what it keeps in the benchmark, `speed_mps` in its place.

        `told`: the way, m, that its pupil is told in words, and that it keeps to where another one is shorter.
        `patient`: it keeps its distance to people even after standing long, for it is its pupil that stands.
        `rests`: it stands at its way's end, where the benchmark's, whose episode is over by then, turns about.
        `wall_m`: wider than it is by so much on each side it drives where there is room: a pupil is less exact.
        """
        self._rests, self._wall_m = rests, wall_m
        self._patient = patient
        self._told = told
        self._margin_m = margin_m
        self._speed_mps = speed_mps
        self._world: EpisodeWorld | None = None
        self._choice: Choice | None = None

    def alike(self) -> ExpertPolicy:
        """Another one that drives as this one does, told no way."""
        return ExpertPolicy(
            margin_m=self._margin_m, speed_mps=self._speed_mps, patient=self._patient, wall_m=self._wall_m
        )

    def reset(self, episode: Episode, instruction: str, world: EpisodeWorld | None, seed: int) -> None:
        """Plan the episode. Raises ValueError without a world, or where the goal cannot be reached."""
        if world is None:
            raise ValueError("expert: expected the episode's world, which only a privileged policy is given")
        planner = RoutePlanner(
            world.scene,
            episode.goal_xy,
            world.robot.radius_m,
            max_step_m(episode.robot),
            NEAR * episode.threshold_m,
            self._told,
        )
        pose = world.pose()
        if not planner.reachable(pose.x_m, pose.y_m):
            raise ValueError(f"expert: episode {episode.id}: no way from the start to the goal for a {episode.robot}")
        driving = _DRIVINGS[episode.robot]
        self._world, self._planner = world, planner
        self._goal, self._threshold_m = episode.goal_xy, episode.threshold_m
        speed_mps = driving.speed_mps if self._speed_mps is None else self._speed_mps
        self._driving = replace(
            driving,
            margin_m=driving.margin_m + self._margin_m,
            speed_mps=speed_mps,
            body_radius_m=driving.body_radius_m + self._wall_m,
        )
        self._motion = Motion(planner.grid, self._driving)
        self._route = np.array([(pose.x_m, pose.y_m)])
        self._ticks = 0
        self._choice = None
        self._left: list[float] = []
        self._paces = np.ones(episode.people)  # nobody is known to stand before having been watched

    def act(self, observation: Observation) -> Velocity:
        """The next velocity, by the world as it is now."""
        world = self._running()
        pose = world.pose()
        people, velocities = self._watch(world)
        gaps = np.hypot(people[:, 0] - pose.x_m, people[:, 1] - pose.y_m)
        self._route = from_here(self._route, pose)
        if self._ticks % _REPLAN_TICKS == 0:
            standing = people[(gaps < _VIEW_M) & (self._paces < _STANDING_MPS)]
            here = (pose.x_m, pose.y_m)
            self._route = self._planner.route(here, standing, _REACH_M, self._route if self._on_route(pose) else None)
        self._ticks += 1
        near = gaps < _SIGHT_M
        self._left.append(self._planner.left(pose.x_m, pose.y_m))
        if self._rests and self._is_there(pose):
            self._choice = self._motion.stand(pose.as_tuple(), observation.state[0])
            return (self._choice.vx_mps, 0.0, self._choice.wz_radps)
        self._choice = self._motion.choose(
            pose.as_tuple(),
            observation.state[0],
            self._route,
            people[near],
            velocities[near],
            patience=self._patience(),
        )
        return (self._choice.vx_mps, 0.0, self._choice.wz_radps)

    def _is_there(self, pose: SE2) -> bool:
        """Whether it has arrived, and its way ends here."""
        (x, y), end = self._goal, self._route[-1]
        arrived = hypot(x - pose.x_m, y - pose.y_m) < self._threshold_m
        return arrived and hypot(end[0] - pose.x_m, end[1] - pose.y_m) < _END_M

    def _running(self) -> EpisodeWorld:
        if self._world is None:
            raise RuntimeError("expert: expected reset first")
        return self._world

    def _watch(self, world: EpisodeWorld) -> tuple[Array, Array]:
        """Where everybody is and how they walk; keeps each one's pace over the last second or two."""
        people, velocities = world.people()[:, :2], world.people_velocities()
        self._paces += 0.1 * (np.hypot(velocities[:, 0], velocities[:, 1]) - self._paces)
        return people, velocities

    def _on_route(self, pose: SE2) -> bool:
        x, y = self._route[0]
        return hypot(x - pose.x_m, y - pose.y_m) < _OFF_ROUTE_M

    def _patience(self) -> float:
        """1 while it comes on; less and less, down to 0.3, the longer it is stuck."""
        ticks = round(_STUCK_S / CONTROL_S)
        if self._patient or len(self._left) <= ticks:
            return 1.0
        stuck = 0
        for back in range(ticks, len(self._left), ticks):
            if self._left[-1 - back] - self._left[-1] > _STUCK_M:
                break
            stuck += 1
        return max(0.3, 1.0 - 0.25 * stuck)

    def plan(self, times_s: Sequence[float] = PLAN_TIMES_S) -> list[Vec2]:
        """Where it means to be at these times from now, m in the base frame (x forward, y left); costs next to nothing.

        Along its way, at the comfortable speed as soon as it can be reached: where to go, not how to pass people.
        """
        speed = self._choice.vx_mps if self._choice is not None else 0.0
        return along(self._route, self._running().pose(), speed, self._driving, times_s)

    @property
    def choice(self) -> Choice | None:
        """What the last `act` chose."""
        return self._choice

    def route(self) -> Array:
        """[n, 2]: the way ahead, m in the world, points 0.1 m apart."""
        return self._route.copy()

    def notes(self) -> Mapping[str, object]:
        """`waypoints`: `plan()`; `future`: the next 4 s as chosen, m in the base frame; `shift_m`: to the left."""
        if self._choice is None:
            return {}
        pose = self._running().pose()
        c, s = cos(pose.theta_rad), sin(pose.theta_rad)
        dx, dy = self._choice.future[::5, 0] - pose.x_m, self._choice.future[::5, 1] - pose.y_m
        future = np.stack((c * dx + s * dy, c * dy - s * dx), axis=1)
        return {
            "waypoints": [list(point) for point in self.plan()],
            "future": future.tolist(),
            "shift_m": self._choice.shift_m,
        }

    def close(self) -> None:
        """Forget the world."""
        self._world = None


def driving_of(robot: str) -> Driving:
    """How a robot drives; raises KeyError for an unknown one."""
    return _DRIVINGS[robot]


def along(route: Array, pose: SE2, speed_mps: float, driving: Driving, times_s: Sequence[float]) -> list[Vec2]:
    """Where one is at these times on a route, m in the frame of `pose`.

    `route` [n, 2] m in the world: points SPACING_M apart, from here on.
    """
    marks = np.arange(len(route)) * SPACING_M
    points = []
    for time_s in times_s:
        # Speeding up to the comfortable speed, then on at it.
        rise_s = min(max(driving.speed_mps - speed_mps, 0.0) / driving.accel_mps2, time_s)
        gone = (speed_mps + 0.5 * driving.accel_mps2 * rise_s) * rise_s + driving.speed_mps * (time_s - rise_s)
        x, y = float(np.interp(gone, marks, route[:, 0])), float(np.interp(gone, marks, route[:, 1]))
        there = pose.inverse() @ SE2(x, y, 0.0)
        points.append((there.x_m, there.y_m))
    return points


def from_here(route: Array, pose: SE2) -> Array:
    """The part of a route that is still ahead."""
    gaps = np.hypot(route[:15, 0] - pose.x_m, route[:15, 1] - pose.y_m)
    nearest = int(np.argmin(gaps))
    return route[nearest:] if len(route) - nearest >= 2 else route[-2:]
