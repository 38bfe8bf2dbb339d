"""Recording of one drive: the simulated world, the source of commands, and the data of every frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import hypot
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.core.geometry import SE2
from sim_hil.benchmark.env.observation import Observation
from sim_hil.benchmark.env.world import EpisodeWorld, WorldOptions
from sim_hil.benchmark.policies.expert import ExpertPolicy
from sim_hil.benchmark.suite.episode import Episode
from sim_hil.scene.scene import Scene, Vec2
from tools.train.collect.steering import Detour, DetourDriver, Velocity
from tools.train.config.collect import RATE_HZ, TRACE_EVERY
from tools.train.drives.drive import EXPERT, NOISE, PICTURE_PX, PLAN_TIMES_S
from tools.train.drives.futures import chosen_future, label_futures

Steer = Callable[[Observation, Velocity], tuple[Velocity, int]]
"""Maps (observation, the expert's command) to (command, its source: EXPERT, NOISE or POLICY)."""
TraceAt = Callable[[EpisodeWorld, NDArray[np.float64], Sequence[Vec2]], Mapping[str, Any]]
"""Maps (world, the expert's chosen future [50, 3], positions on its route in 3, 6 and 9 s) to the trace of an instant.

Called once a second.
"""

LEAST_FRAMES: Final = 30
"""Shortest usable drive, frames."""
_BEFORE_CRASH: Final = 20  # frames before a collision or fall that are discarded: they lead into it
_POLICY_STUCK_S: Final = 15.0
_EXPERT_STUCK_S: Final = 40.0  # longer than the policy's, because the expert waits for people
_STUCK_M: Final = 0.5  # the robot is stuck if it stays within this distance for that time
GLIDE_HZ: Final = 120
"""Steps a second of a world whose robot glides: the least that `Simulation` takes."""
_OFF_M: Final = 20.0  # a policy's drive ends at this distance from the route
_RESCUED_M: Final = (6.0, 1.0)  # distances from the route at which the expert takes over, and gives back to a policy


class NothingToLearnError(Exception):
    """A drive without usable frames; its text is a short reason, by which drives are counted."""


@dataclass(frozen=True)
class CameraSettings:
    """Rendering of a drive's images: `render_px` square, reduced to 128 px, stored as JPEG."""

    render_px: int = PICTURE_PX
    jpeg_quality: int = 90

    def __post_init__(self) -> None:
        if not PICTURE_PX <= self.render_px <= 1024 or not 1 <= self.jpeg_quality <= 100:
            raise ValueError(f"expected images of {PICTURE_PX} to 1024 px and a quality of 1 to 100, found {self}")


@dataclass
class Recorded:
    """Outcome and usable frames of a finished drive."""

    outcome: str
    collided: bool
    arrays: Mapping[str, NDArray[Any]]
    traces: tuple[Mapping[str, Any], ...]


@dataclass
class _Frames:
    jpegs: list[NDArray[np.uint8]] = field(default_factory=list)
    pose: list[tuple[float, float, float]] = field(default_factory=list)
    pose_odom: list[tuple[float, float, float]] = field(default_factory=list)
    state: list[tuple[float, float, float]] = field(default_factory=list)
    chosen: list[NDArray[np.float64]] = field(default_factory=list)
    plan_xy: list[list[tuple[float, float]]] = field(default_factory=list)
    by: list[int] = field(default_factory=list)
    traces: list[Mapping[str, Any]] = field(default_factory=list)


@dataclass(frozen=True)
class DrivePlan:
    """One drive to record: episode, scene, cameras and conditions.

    `path` [n, 2]: the described route, m. With `policy_drives` a policy commands: its mistakes are recorded, until it
    is stuck for 15 s. From 6 m off the route the expert drives it back. The expert's drives end before a collision or
    fall; those farther than `off_m` from the route are rejected, because the instruction would not describe them.
    `linger_s`: recording after arrival, s. `detour`: temporary departure from the route, if it is possible. `legs`: as
    CollectConfig.legs.
    """

    episode: Episode
    scene: Scene
    path: NDArray[np.float64]
    camera: CameraSettings
    drift: str
    policy_drives: bool = False
    off_m: float = 4.0
    linger_s: float = 0.0
    detour: Detour | None = None
    legs: bool = True


def record(plan: DrivePlan, expert: ExpertPolicy, steer: Steer, trace_at: TraceAt) -> Recorded:
    """Drive and record. Raises NothingToLearnError if less than 3 s are usable, SceneError, ValueError."""
    frames = _Frames()
    options = WorldOptions(
        camera=(plan.camera.render_px,) * 2,
        drift=plan.drift,
        linger_s=plan.linger_s,
        rate_hz=WorldOptions.rate_hz if plan.legs else GLIDE_HZ,
        glides=not plan.legs,
    )
    first_collision: int | None = None
    rescue = Rescue(plan)
    with EpisodeWorld(plan.episode, options, scene=plan.scene) as world:
        try:
            expert.reset(plan.episode, plan.episode.instructions[0], world, plan.episode.seed)
        except ValueError as error:
            raise NothingToLearnError("the expert finds no path") from error
        detour = _detour_driver(plan, world, expert)
        try:
            while not world.done:
                observation = _shrunk(world.observe())
                wanted = expert.act(observation)
                command, by = steer(observation, wanted)
                if rescue.is_needed(world.pose()):
                    command, by = wanted, EXPERT
                if detour is not None and (departing := detour.command(observation)) is not None:
                    command, by = departing, NOISE
                _keep(frames, plan, world, observation, expert, by)
                if len(frames.traces) * TRACE_EVERY < len(frames.pose):
                    frames.traces.append(trace_at(world, frames.chosen[-1], frames.plan_xy[-1]))
                world.step(command)
                if first_collision is None and world.collided:
                    first_collision = len(frames.pose)
                if not world.done and is_hopeless(np.array(frames.pose), plan):
                    world.stop()
        finally:
            expert.close()
            if detour is not None:
                detour.close()
        end, collided = world.end, world.collided
    outcome = "cut" if end == "stopped" else str(end)
    return _finish(frames, plan, outcome, collided, first_collision)


class Rescue:
    """Tells whether the expert drives a policy's robot back to the route."""

    def __init__(self, plan: DrivePlan) -> None:
        self._plan, self._active = plan, False

    def is_needed(self, pose: SE2) -> bool:
        """Return whether the expert drives now; call it once per frame."""
        if self._plan.policy_drives:
            far_m, near_m = _RESCUED_M
            off_m = off_way_m(np.array((pose.x_m, pose.y_m)), self._plan.path)
            self._active = off_m > (near_m if self._active else far_m)
        return self._active


def _detour_driver(plan: DrivePlan, world: EpisodeWorld, expert: ExpertPolicy) -> DetourDriver | None:
    if plan.detour is None:
        return None
    try:
        return DetourDriver(plan.detour, plan.episode, world, expert)
    except ValueError:  # there is no path to the place
        return None


def _shrunk(observation: Observation) -> Observation:
    image = observation.image
    if image is None or image.shape[0] == PICTURE_PX:
        return observation
    small = cv2.resize(image, (PICTURE_PX, PICTURE_PX), interpolation=cv2.INTER_AREA)
    return replace(observation, image=np.asarray(small, np.uint8))


def _keep(
    frames: _Frames, plan: DrivePlan, world: EpisodeWorld, observation: Observation, expert: ExpertPolicy, by: int
) -> None:
    pose, choice = world.pose(), expert.choice
    if observation.image is None or choice is None:
        raise ValueError("recording: expected an image and an expert's choice in every frame")
    quality = [cv2.IMWRITE_JPEG_QUALITY, plan.camera.jpeg_quality]
    done, jpeg = cv2.imencode(".jpg", observation.image[..., ::-1], quality)
    if not done:
        raise ValueError("recording: an image could not be compressed")
    frames.jpegs.append(np.asarray(jpeg, np.uint8).ravel())
    frames.pose.append(pose.as_tuple())
    frames.pose_odom.append(observation.T_odom_base.as_tuple())
    frames.state.append(observation.state)
    frames.chosen.append(chosen_future(pose, choice, expert.route()))
    frames.plan_xy.append(expert.plan(PLAN_TIMES_S))
    frames.by.append(by)


def is_hopeless(pose: NDArray[np.float64], plan: DrivePlan) -> bool:
    """Return whether to end a drive: stuck within 0.5 m, or a policy is 20 m off the route. `pose` [N, 3] so far."""
    if plan.policy_drives and off_way_m(pose[-1, :2], plan.path) > _OFF_M:
        return True
    frames = round((_POLICY_STUCK_S if plan.policy_drives else _EXPERT_STUCK_S) * RATE_HZ)
    if len(pose) <= frames:
        return False
    lately = pose[-frames:, :2]
    return float(np.max(np.hypot(*(lately - lately[0]).T))) < _STUCK_M


def off_way_m(point: NDArray[np.float64], path: NDArray[np.float64]) -> float:
    """Return the distance from a point to a polyline [n, 2], m."""
    if len(path) < 2:
        return float(hypot(*(point - path[0])))
    a, way = path[:-1], np.diff(path, axis=0)
    share = np.sum((point - a) * way, axis=1) / np.maximum(np.sum(way * way, axis=1), 1e-12)
    nearest = a + np.clip(share, 0.0, 1.0)[:, None] * way
    return float(np.min(np.hypot(*(point - nearest).T)))


def _finish(frames: _Frames, plan: DrivePlan, outcome: str, collided: bool, first_collision: int | None) -> Recorded:
    count = kept_frames(np.array(frames.pose), outcome, first_collision, policy_drives=plan.policy_drives)
    if count < LEAST_FRAMES:
        reason = outcome if first_collision is None or plan.policy_drives else "collided"
        raise NothingToLearnError(f"less than {LEAST_FRAMES / RATE_HZ:g} s are usable ({reason})")
    farthest_m = max(off_way_m(point, plan.path) for point in np.array(frames.pose)[:count, :2])
    if not plan.policy_drives and farthest_m > plan.off_m:
        raise NothingToLearnError("it left the described route")
    pose, by = np.array(frames.pose)[:count], np.array(frames.by, np.uint8)[:count]
    whole = outcome == "reached" and count == len(frames.pose)
    future, steps = label_futures(pose, np.array(frames.chosen)[:count], by, goes_on=whole or plan.policy_drives)
    jpegs = frames.jpegs[:count]
    arrays: dict[str, NDArray[Any]] = {
        "jpeg": np.concatenate(jpegs),
        "jpeg_end": np.cumsum([len(jpeg) for jpeg in jpegs]).astype(np.int64),
        "pose": pose,
        "pose_odom": np.array(frames.pose_odom)[:count],
        "state": np.array(frames.state, np.float32)[:count],
        "future": future.astype(np.float32),
        "future_steps": steps.astype(np.int16),
        "plan_xy": np.array(frames.plan_xy, np.float32)[:count],
        "by": by,
    }
    traces = tuple(frames.traces[: (count - 1) // TRACE_EVERY + 1])
    return Recorded(outcome, collided, arrays, traces)


def kept_frames(
    pose: NDArray[np.float64], outcome: str, first_collision: int | None, *, policy_drives: bool = False
) -> int:
    """Return the number of usable frames of a drive; `pose` [N, 3].

    `first_collision`: first frame after a collision, None without one. Of a policy's drive all frames are usable,
    except those before a fall, from which no command recovers.
    """
    count = len(pose) - (_BEFORE_CRASH if outcome == "fell" else 0)
    if policy_drives:
        return max(count, 0)
    if outcome in ("timeout", "cut"):  # discard the standing at the end, except 1 s of it
        gaps = np.hypot(*(pose[:, :2] - pose[-1, :2]).T)
        count = min(count, int(np.max(np.flatnonzero(gaps > _STUCK_M), initial=-1)) + 1 + RATE_HZ)
    if first_collision is not None:
        count = min(count, first_collision - _BEFORE_CRASH)
    return max(count, 0)
