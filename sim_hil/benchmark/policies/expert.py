"""The privileged expert: it knows the scene's map and the position and velocity of every person.

It keeps distance to walls and people, and slows down, waits or backs off instead of pushing. Its success shows that an
episode is feasible, and it is the teacher of policies that receive only images.
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
from sim_hil.benchmark.policies.expert_route import SPACING_M, PlannerGround, RoutePlanner
from sim_hil.benchmark.policies.policy import Velocity
from sim_hil.benchmark.suite.episode import Episode
from sim_hil.benchmark.suite.robots import max_step_m
from sim_hil.scene.nav_grid import NavGrid

Array = NDArray[np.float64]
Vec2 = tuple[float, float]

PLAN_TIMES_S: Final = (3.0, 6.0, 9.0)  # times of the waypoints that the language model writes
_REPLAN_TICKS: Final = 5  # control periods between two searches of the route
_REACH_M: Final = 10.0  # length of the planned route: 9 s of driving, plus the look-ahead of the last steps
_SIGHT_M: Final = 7.0  # people beyond this distance are ignored when choosing a velocity
_VIEW_M: Final = 12.0  # the route avoids standing people within this distance
_STANDING_MPS: Final = 0.25  # mean speed below which a person counts as standing
_OFF_ROUTE_M: Final = 0.6  # distance from the route beyond which a new one replaces it
NEAR: Final = 0.8  # share of the goal threshold within which the expert may end its route
_END_M: Final = 0.4  # distance to the route's end at which it has arrived
_STUCK_S: Final = 6.0
_STUCK_M: Final = 0.5  # progress below this within _STUCK_S counts as stuck


# Driving parameters that the robot's own model does not contain.
_DRIVINGS: Final[Mapping[str, Driving]] = MappingProxyType(
    {"go2": Driving(), "carter": Driving(body_radius_m=0.31, body_reach_m=0.12, margin_m=0.17)}
)


class ExpertPolicy:
    """Privileged policy that plans on the episode's world; `reset` needs a world."""

    name = "expert"
    privileged = True
    needs_image = False

    def __init__(
        self, *, margin_m: float = 0.0, speed_mps: float | None = None, prescribed: Sequence[Vec2] = (),
        patient: bool = False, rests: bool = False, wall_m: float = 0.0, about_left: bool = False,
    ) -> None:  # fmt: skip
        """Create the benchmark's expert; a teacher sets further options.

        `margin_m`: distance kept to people in addition to the benchmark's. `speed_mps`: replaces the robot's
        comfortable speed. `prescribed`: the route of the student's instruction, points in m, followed even if another
        one is shorter. `patient`: keep the distance to people even after standing for long, because it is the student
        that stands. `rests`: stand at the route's end; in the benchmark the episode is over by then. `wall_m`: width
        added to each side of the robot where there is room, because a student drives less exactly. `about_left`: turn
        about to the left only (see `Motion`).
        """
        self._rests, self._wall_m, self._about_left = rests, wall_m, about_left
        self._patient = patient
        self._prescribed = prescribed
        self._margin_m = margin_m
        self._speed_mps = speed_mps
        self._world: EpisodeWorld | None = None
        self._choice: Choice | None = None

    def alike(self) -> ExpertPolicy:
        """Return a new expert with the same options, without a prescribed route."""
        return ExpertPolicy(
            margin_m=self._margin_m, speed_mps=self._speed_mps, patient=self._patient, wall_m=self._wall_m,
            about_left=self._about_left,
        )  # fmt: skip

    def reset(self, episode: Episode, instruction: str, world: EpisodeWorld | None, seed: int) -> None:
        """Plan the episode. Raises ValueError without a world or if the goal cannot be reached."""
        if world is None:
            raise ValueError("expert: expected the episode's world in reset(), found None")
        grid = NavGrid(world.scene, clearance_m=world.robot.radius_m, max_step_m=max_step_m(episode.robot))
        ground = PlannerGround(world.scene, grid)
        planner = RoutePlanner(ground, episode.goal_xy, NEAR * episode.threshold_m, self._prescribed)
        pose = world.pose()
        if not planner.reachable(pose.x_m, pose.y_m):
            raise ValueError(f"expert: episode {episode.id}: no path from the start to the goal for a {episode.robot}")
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
        self._motion = Motion(planner.grid, self._driving, about_left=self._about_left)
        self._route = np.array([(pose.x_m, pose.y_m)])
        self._ticks = 0
        self._choice = None
        self._left: list[float] = []
        self._paces = np.ones(episode.people)  # m/s; until observed, every person counts as walking

    def act(self, observation: Observation) -> Velocity:
        """Choose the next velocity from the world's current state."""
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
        """Return whether the robot is at the goal and at the end of its route."""
        (x, y), end = self._goal, self._route[-1]
        arrived = hypot(x - pose.x_m, y - pose.y_m) < self._threshold_m
        return arrived and hypot(end[0] - pose.x_m, end[1] - pose.y_m) < _END_M

    def _running(self) -> EpisodeWorld:
        if self._world is None:
            raise RuntimeError("expert: expected reset first")
        return self._world

    def _watch(self, world: EpisodeWorld) -> tuple[Array, Array]:
        """Return people's positions [k, 2] and velocities [k, 2]; update each one's mean speed over about 1 s."""
        people, velocities = world.people()[:, :2], world.people_velocities()
        self._paces += 0.1 * (np.hypot(velocities[:, 0], velocities[:, 1]) - self._paces)
        return people, velocities

    def _on_route(self, pose: SE2) -> bool:
        x, y = self._route[0]
        return hypot(x - pose.x_m, y - pose.y_m) < _OFF_ROUTE_M

    def _patience(self) -> float:
        """Return 1 while the robot makes progress; the longer it is stuck, the less, down to 0.3."""
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
        """Return the planned position at each time from now, m in the base frame (x forward, y left).

        Positions lie on the route, reached at the comfortable speed; they do not include avoiding people.
        """
        speed = self._choice.vx_mps if self._choice is not None else 0.0
        return along(self._route, self._running().pose(), speed, self._driving, times_s)

    @property
    def choice(self) -> Choice | None:
        """Result of the last `act`."""
        return self._choice

    def route(self) -> Array:
        """Return the route ahead [n, 2], m in the world frame, points 0.1 m apart."""
        return self._route.copy()

    def notes(self) -> Mapping[str, object]:
        """Return `waypoints` (`plan()`), `future` (chosen path of 4 s, m, base frame) and `shift_m` (to the left)."""
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
        """Release the world."""
        self._world = None


def driving_of(robot: str) -> Driving:
    """Return a robot's driving parameters. Raises KeyError for an unknown robot."""
    return _DRIVINGS[robot]


def along(route: Array, pose: SE2, speed_mps: float, driving: Driving, times_s: Sequence[float]) -> list[Vec2]:
    """Return the position on a route at each time from now, m in the frame of `pose`.

    `route` [n, 2]: points ahead, m in the world frame, SPACING_M apart.
    """
    marks = np.arange(len(route)) * SPACING_M
    points = []
    for time_s in times_s:
        # Accelerate to the comfortable speed, then keep it.
        rise_s = min(max(driving.speed_mps - speed_mps, 0.0) / driving.accel_mps2, time_s)
        gone = (speed_mps + 0.5 * driving.accel_mps2 * rise_s) * rise_s + driving.speed_mps * (time_s - rise_s)
        x, y = float(np.interp(gone, marks, route[:, 0])), float(np.interp(gone, marks, route[:, 1]))
        there = pose.inverse() @ SE2(x, y, 0.0)
        points.append((there.x_m, there.y_m))
    return points


def from_here(route: Array, pose: SE2) -> Array:
    """Return the part of a route that lies ahead of `pose`."""
    gaps = np.hypot(route[:15, 0] - pose.x_m, route[:15, 1] - pose.y_m)
    nearest = int(np.argmin(gaps))
    return route[nearest:] if len(route) - nearest >= 2 else route[-2:]
