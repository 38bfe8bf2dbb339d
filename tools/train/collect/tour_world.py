"""Tours: a robot without physics follows a described route; its images and true reasoning texts are recorded.

A drive needs physics, an expert that evaluates futures at 10 Hz, and ten images per second. The language model needs
one image per second from a body that moves roughly as a walking robot: it sways, changes speed, stops, and sometimes
leaves the route and comes back.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import atan2, cos, hypot, pi, sin, sqrt
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.core.geometry import SE2
from sim_hil.benchmark.env.observation import Odometer
from sim_hil.benchmark.language.visibility import ASPECT
from sim_hil.benchmark.policies.expert import NEAR, along, driving_of, from_here
from sim_hil.benchmark.policies.expert_motion import Driving
from sim_hil.benchmark.policies.expert_route import RoutePlanner
from sim_hil.benchmark.suite.episode import Episode
from sim_hil.crowd.people import UPDATE_HZ, People
from sim_hil.crowd.spots import Destinations
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.simulation.camera import CameraWorld
from tools.train.collect.record import CameraSettings, NothingToLearnError, Recorded
from tools.train.collect.steering import DetourProgress, draw_detour
from tools.train.config.collect import RATE_HZ, TRACE_EVERY, CollectConfig, TourConfig
from tools.train.drives.drive import FUTURE_STEPS, PICTURE_PX, PLAN_TIMES_S
from tools.train.drives.scenarios import Scenario, Site
from tools.train.drives.trace_sentences import aspects_json
from tools.train.drives.traces import Tracer, turning_first
from tools.train.encoder.worker import body_state
from tools.train.samples.augment import encoded

Array = NDArray[np.float64]
Vec2 = tuple[float, float]

_STEP_S: Final = 1.0 / RATE_HZ
_REACH_M: Final = 10.0  # planned length of a route: 9 s of driving
_VIEW_M: Final = 12.0  # the route avoids people who stand within this distance
_STANDING_MPS: Final = 0.25  # speed below which a person counts as standing
_OFF_ROUTE_M: Final = 0.6  # the previous route is reused within this distance
_BLOCKED_M, _BLOCKED_RAD = 1.1, 1.0  # the robot waits for a person within this distance and bearing
_PATIENCE_S: Final = 4.0  # longest wait; then the robot goes on, because people give way
_SWAY_RADPS, _SWAY_S = 0.15, 1.5  # standard deviation and correlation time of the yaw rate's noise
_PACE_S: Final = (1.0, 6.0)  # range of the time between two changes of pace
_HALT_SHARE: Final = 0.1  # share of these changes that are a halt
_HALT_S: Final = 2.5  # longest halt
_SLOWEST: Final = 0.6  # slowest pace as a share of the expert's speed
_ALLOWED_MPS: Final = 0.35  # a tour with a lower mean speed is given up
_SPARE_S: Final = 30.0  # time allowed in addition
_DECOYS: Final = 8  # attempts to draw a detour
_TAG: Final = 0x7055
_THERE_M: Final = 0.25  # distance to the end of a route at which it counts as reached


class TourWorld:
    """People and cameras of one layout, reused by its tours.

    The people's appearance and the places they go to are the same in all tours; their positions and paths are each
    tour's own.
    """

    def __init__(self, site: Site, people: int) -> None:
        """`people`: upper limit of their number; a small layout has room for fewer."""
        self.site = site
        self._destinations: Destinations | None = None
        if people:
            try:
                rng = np.random.default_rng((site.layout_seed, _TAG))
                self._destinations = Destinations.of(site.scene, people, rng)
            except ValueError:  # no floor that people can walk on
                people = 0
        while people and not self._has_room(people):
            people //= 2
        self.count = people
        self._people = People(site.scene, 0, 0)
        self._cameras: dict[str, CameraWorld] = {}

    def fill(self, episode: Episode) -> None:
        """Place new people, none near the start. Raises NothingToLearnError if there is no room."""
        try:
            scene = replace(self.site.scene, start=episode.start)
            self._people = People(scene, self.count, episode.seed, self._destinations)
        except ValueError as error:
            raise NothingToLearnError("no room for its people") from error

    def _has_room(self, people: int) -> bool:
        try:
            People(self.site.scene, people, self.site.layout_seed, self._destinations)
        except ValueError:
            return False
        return True

    def people(self) -> Array:
        """Return the people's poses [n, 3]: x m, y m, heading rad."""
        return self._people.poses()

    def velocities(self) -> Array:
        """Return the people's velocities [n, 2], m/s in the world."""
        return self._people.velocities()

    def wait(self, pose: SE2) -> None:
        """Advance the people by 0.1 s with the robot at `pose`."""
        for _ in range(UPDATE_HZ // RATE_HZ):
            self._people.step(pose.x_m, pose.y_m, pose.theta_rad)

    def picture(self, robot: str, pose: SE2, settings: CameraSettings, rng: np.random.Generator) -> NDArray[np.uint8]:
        """Render the robot's image from a pose as JPEG bytes."""
        if robot not in self._cameras:
            self._cameras[robot] = CameraWorld(
                self.site.scene, people=self.count, seed=self.site.layout_seed, robot=robot
            )
        camera = self._cameras[robot]
        rows = self._people.render_rows().ravel()
        state = np.zeros(camera.state_size)
        state[:7] = body_state(self.site.scene, robot, pose.as_tuple(), rng)
        state[len(state) - len(rows) :] = rows
        picture = camera.render(state, settings.render_px, settings.render_px, ASPECT)
        if settings.render_px != PICTURE_PX:
            small = cv2.resize(picture, (PICTURE_PX, PICTURE_PX), interpolation=cv2.INTER_AREA)
            picture = np.asarray(small, np.uint8)
        return encoded(picture, settings.jpeg_quality)

    def close(self) -> None:
        """Release the renderers."""
        for camera in self._cameras.values():
            camera.close()
        self._cameras.clear()


@dataclass
class KinematicBase:
    """A body without physics that is steered along routes and stops at walls."""

    pose: SE2
    driving: Driving
    grid: NavGrid
    rng: np.random.Generator
    speed_mps: float = 0.0
    turn_radps: float = 0.0
    _sway: float = 0.0
    _pace: float = 1.0
    _kept_s: float = 0.0

    def step(self, route: Array, *, halted: bool = False) -> float:
        """Move for 0.1 s along `route` [n, 2], whose points are 0.1 m apart; return the distance moved, m."""
        self._change_pace()
        left_m = 0.1 * (len(route) - 1)
        at = min(round((0.45 + 0.45 * self.speed_mps) * 10), len(route) - 1)
        aim = self.pose.inverse() @ SE2(float(route[at, 0]), float(route[at, 1]), 0.0)
        error = atan2(aim.y_m, aim.x_m)
        noise = float(self.rng.standard_normal())
        self._sway += -self._sway * _STEP_S / _SWAY_S + _SWAY_RADPS * sqrt(2 * _STEP_S / _SWAY_S) * noise
        stands = halted or self._pace == 0.0 or hypot(aim.x_m, aim.y_m) < _THERE_M
        driving = self.driving
        pace_mps = min(driving.speed_mps * self._pace, sqrt(driving.brake_mps2 * left_m))
        wanted_mps = 0.0 if stands else pace_mps * max(cos(error), 0.0) ** 2
        top = driving.turn_radps
        wanted_radps = 0.0 if stands else min(max(1.8 * error, -top), top) + self._sway
        self.speed_mps = _slew(self.speed_mps, wanted_mps, driving.brake_mps2, driving.accel_mps2)
        self.turn_radps = _slew(
            self.turn_radps, wanted_radps, driving.turn_accel_radps2, driving.turn_accel_radps2
        )  # fmt: skip
        return self._glide()

    def _change_pace(self) -> None:
        self._kept_s -= _STEP_S
        if self._kept_s > 0:
            return
        halts, pace, kept = (float(value) for value in self.rng.uniform(size=3))
        longest = _HALT_S if halts < _HALT_SHARE else _PACE_S[1]
        self._pace = 0.0 if halts < _HALT_SHARE else _SLOWEST + (1.0 - _SLOWEST) * pace
        self._kept_s = _PACE_S[0] + kept * (longest - _PACE_S[0])

    def _glide(self) -> float:
        x, y, theta = self.pose.as_tuple()
        middle = theta + 0.5 * self.turn_radps * _STEP_S
        gone = self.speed_mps * _STEP_S
        there = (x + gone * cos(middle), y + gone * sin(middle))
        if not self.grid.is_free(*there) and self.grid.is_free(x, y):
            self.speed_mps, gone, there = 0.0, 0.0, (x, y)
        self.pose = SE2(*there, theta + self.turn_radps * _STEP_S)
        return gone


def record_tour(
    scenario: Scenario, world: TourWorld, config: TourConfig, camera: CameraSettings, drift: str,
    collect: CollectConfig, rng: np.random.Generator,
) -> Recorded:  # fmt: skip
    """Move a robot along a scenario's route and record it. `drift`: name of the odometry drift.

    Raises NothingToLearnError if there is no path, or the robot does not arrive in time.
    """
    world.fill(scenario.episode)
    tour = _Tour(scenario, world, config, collect, rng)
    odometer = Odometer(drift, scenario.episode.seed, tour.body.pose)
    jpegs: list[NDArray[np.uint8]] = []
    ends: list[int] = []
    rows: dict[str, list[Any]] = {"pose": [], "pose_odom": [], "state": [], "plan_xy": []}
    traces: list[Mapping[str, Any]] = []
    while not tour.over:
        tour.look_ahead()
        if len(ends) % TRACE_EVERY == 0:
            jpegs.append(world.picture(scenario.episode.robot, tour.body.pose, camera, rng))
            traces.append(tour.trace())
        ends.append((ends[-1] if ends else 0) + (len(jpegs[-1]) if len(ends) % TRACE_EVERY == 0 else 0))
        rows["pose"].append(tour.body.pose.as_tuple())
        rows["pose_odom"].append(odometer.pose.as_tuple())
        rows["state"].append(odometer.velocity())
        rows["plan_xy"].append(tour.plan)
        tour.step()
        odometer.step(tour.body.pose, _STEP_S)
    count = len(ends)
    arrays: dict[str, NDArray[Any]] = {
        "jpeg": np.concatenate(jpegs),
        "jpeg_end": np.array(ends, np.int64),
        "pose": np.array(rows["pose"]),
        "pose_odom": np.array(rows["pose_odom"]),
        "state": np.array(rows["state"], np.float32),
        "future": np.zeros((count, FUTURE_STEPS, 3), np.float32),
        "future_steps": np.zeros(count, np.int16),
        "plan_xy": np.array(rows["plan_xy"], np.float32),
        "by": np.zeros(count, np.uint8),
    }
    return Recorded("reached", False, arrays, tuple(traces))


class _Tour:
    """A tour while it is recorded."""

    def __init__(
        self, scenario: Scenario, world: TourWorld, config: TourConfig, collect: CollectConfig,
        rng: np.random.Generator,
    ) -> None:  # fmt: skip
        episode, site = scenario.episode, scenario.site
        self._world, self._config, self._rng, self._site = world, config, rng, site
        self._robot, self._goal, self._task = episode.robot, episode.goal_xy, scenario.task
        self._near_m = collect.arrive_share * episode.threshold_m
        self._driving = driving_of(episode.robot)
        self._speed_mps = collect.speed_mps
        self._planner = self._planner_to(self._goal, NEAR * self._near_m, scenario.task.path)
        if not self._planner.reachable(*episode.start[:2]):
            raise NothingToLearnError("the expert finds no path")
        self._tracer = Tracer(scenario)
        paced = replace(self._driving, speed_mps=collect.speed_mps)
        self.body = KinematicBase(SE2(*episode.start), paced, site.robot_grid(episode.robot), rng)
        self._route = np.array([episode.start[:2]])
        self._ticks, self._blocked_s = 0, 0.0
        self._left_s = self._tracer.progress.length_m / _ALLOWED_MPS + _SPARE_S
        self._detour, self._detour_route = self._drawn_detour(), self._route
        self._linger_s: float | None = None
        self.plan: list[Vec2] = []

    def _planner_to(self, goal: Vec2, near_m: float, described: tuple[Vec2, ...] = ()) -> RoutePlanner:
        return RoutePlanner(self._site.planner_ground(self._robot), goal, near_m, described)

    def _drawn_detour(self) -> tuple[DetourProgress, RoutePlanner] | None:
        """Draw a detour and its planner; None if the tour has none."""
        if float(self._rng.uniform()) >= self._config.stray_share:
            return None
        for _ in range(_DECOYS):
            detour = draw_detour(
                self._site, self._robot, self._task, self._config.stray_m, self._rng, into_m=self._config.stray_into_m
            )
            planner = None if detour is None else self._planner_to(detour.to, 0.5)
            if detour is not None and planner is not None and planner.reachable(*self._here):
                self._left_s += 2 * detour.for_m / _ALLOWED_MPS
                return DetourProgress(detour), planner
        return None

    @property
    def _here(self) -> Vec2:
        return (self.body.pose.x_m, self.body.pose.y_m)

    @property
    def over(self) -> bool:
        """Whether the robot has arrived and the recording after arrival is done. Raises NothingToLearnError if late."""
        if self._left_s <= 0:
            raise NothingToLearnError("it did not arrive in time")
        return self._linger_s is not None and self._linger_s <= 0

    def look_ahead(self) -> None:
        """Update the planned route from the current pose."""
        pose = self.body.pose
        self._route = from_here(self._route, pose)
        self._detour_route = from_here(self._detour_route, pose)
        if self._ticks % TRACE_EVERY == 0:
            standing = self._standing()
            kept = self._route if hypot(*(self._route[0] - self._here)) < _OFF_ROUTE_M else None
            self._route = self._planner.route(self._here, standing, _REACH_M, kept)
            if self._detour is not None and self._detour[0].active:
                self._detour_route = self._detour[1].route(self._here, standing, _REACH_M)
            # Kept until the next frame with a picture: only those are learned from.
            self.plan = along(self._route, pose, self.body.speed_mps, self.body.driving, PLAN_TIMES_S)

    def _standing(self) -> Array:
        people, velocities, pose = self._world.people()[:, :2], self._world.velocities(), self.body.pose
        gaps = np.hypot(people[:, 0] - pose.x_m, people[:, 1] - pose.y_m)
        return people[(gaps < _VIEW_M) & (np.hypot(velocities[:, 0], velocities[:, 1]) < _STANDING_MPS)]

    def trace(self) -> Mapping[str, object]:
        """Return the true reasoning text of this instant."""
        means = [turning_first(self.plan[0], self._driving.turn_radps, self._speed_mps)]
        people, velocities = self._world.people(), self._world.velocities()
        text = self._tracer.trace(self.body.pose, people, velocities, means)
        return {**aspects_json(text), "off_m": self._tracer.off_m(self.body.pose)}

    def step(self) -> None:
        """Advance robot and people by 0.1 s."""
        arrived = hypot(self.body.pose.x_m - self._goal[0], self.body.pose.y_m - self._goal[1]) < self._near_m
        if arrived and self._linger_s is None:
            self._linger_s = float(self._rng.uniform(0.5, 1.0)) * self._config.linger_s
        detour = None if self._detour is None else self._detour[0]
        departed = detour is not None and detour.active and len(self._detour_route) > 1
        gone = self.body.step(self._detour_route if departed else self._route, halted=self._halted())
        if detour is not None:
            detour.advance(gone, self.body.pose)
        self._world.wait(self.body.pose)
        self._ticks += 1
        self._left_s -= _STEP_S
        if self._linger_s is not None:
            self._linger_s -= _STEP_S

    def _halted(self) -> bool:
        """Whether the robot waits for a person directly ahead."""
        people, pose = self._world.people(), self.body.pose
        dx, dy = people[:, 0] - pose.x_m, people[:, 1] - pose.y_m
        bearings = (np.arctan2(dy, dx) - pose.theta_rad + pi) % (2 * pi) - pi
        blocked = bool(np.any((np.hypot(dx, dy) < _BLOCKED_M) & (np.abs(bearings) < _BLOCKED_RAD)))
        self._blocked_s = self._blocked_s + _STEP_S if blocked else 0.0
        return 0.0 < self._blocked_s < _PATIENCE_S


def _slew(value: float, target: float, down: float, up: float) -> float:
    return value + min(max(target - value, -down * _STEP_S), up * _STEP_S)
