"""One drive recorded: the world, who drives in it, and what is kept of every frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from math import hypot
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sim_hil.benchmark.env.observation import Observation
from sim_hil.benchmark.env.world import EpisodeWorld, WorldOptions
from sim_hil.benchmark.policies.expert import ExpertPolicy
from sim_hil.benchmark.suite.episode import Episode
from sim_hil.scene.scene import Scene
from tools.train.collect.detour import Detour, DetourDriver
from tools.train.collect.steering import Velocity
from tools.train.config.collect import RATE_HZ, TRACE_EVERY
from tools.train.drives.drive import NOISE, PICTURE_PX, PLAN_TIMES_S
from tools.train.drives.futures import chosen_future, label_futures

Steer = Callable[[Observation, Velocity], tuple[Velocity, int]]
"""From what is observed and what the expert wants to what is commanded, and whose that is (EXPERT, NOISE, POLICY)."""
Tell = Callable[[EpisodeWorld, NDArray[np.float64]], Mapping[str, Any]]
"""From the world and what the expert has chosen ([50, 3]) to the trace of this instant; asked once a second."""

LEAST_FRAMES: Final = 30  # a shorter drive teaches nothing
_BEFORE_CRASH: Final = 20  # frames: what led to a collision or a fall is not to be learned
_PUPIL_STUCK_S: Final = 15.0
_EXPERT_STUCK_S: Final = 40.0  # it may wait for people; for longer than this there is nothing to see
_STUCK_M: Final = 0.5
_OFF_M: Final = 6.0


class NothingToLearnError(Exception):
    """A drive of which there is nothing to keep; its text says why, in a few words that many drives share."""


@dataclass(frozen=True)
class Look:
    """How the pictures of a drive are made: rendered at `render_px` (square), shrunk to 128, kept as JPEG."""

    render_px: int = PICTURE_PX
    jpeg_quality: int = 90

    def __post_init__(self) -> None:
        if not PICTURE_PX <= self.render_px <= 1024 or not 1 <= self.jpeg_quality <= 100:
            raise ValueError(f"expected pictures of {PICTURE_PX} to 1024 px and a quality of 1 to 100, found {self}")


@dataclass
class Recorded:
    """Frames of a drive that has ended; what `finish` keeps of them goes into a Drive."""

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
    """What is driven: the episode in its scene, and how it is looked at.

    `path` [n, 2]: the told way, m. With `pupil` a policy drives: what goes wrong is kept, as there is something to
    learn from it, until it has gone 6 m from the way or has stayed where it is for 15 s. The expert's drives are kept
    up to their trouble, and none that goes further than `off_m` from the way: it would not be what the words say.
    `linger_s`: for so long it is looked at after it has arrived. `detour`: it leaves its way for a while, if it can.
    """

    episode: Episode
    scene: Scene
    path: NDArray[np.float64]
    look: Look
    drift: str
    pupil: bool = False
    off_m: float = 4.0
    linger_s: float = 0.0
    detour: Detour | None = None


def record(plan: DrivePlan, expert: ExpertPolicy, steer: Steer, tell: Tell) -> Recorded:
    """Drive and record. Raises NothingToLearnError where less than 3 s can be learned from, SceneError, ValueError."""
    frames = _Frames()
    options = WorldOptions(camera=(plan.look.render_px,) * 2, drift=plan.drift, linger_s=plan.linger_s)
    first_collision: int | None = None
    with EpisodeWorld(plan.episode, options, scene=plan.scene) as world:
        try:
            expert.reset(plan.episode, plan.episode.instructions[0], world, plan.episode.seed)
        except ValueError as error:
            raise NothingToLearnError("the expert sees no way") from error
        aside = _aside(plan, world, expert)
        try:
            while not world.done:
                observation = _shrunk(world.observe())
                wanted = expert.act(observation)
                command, by = steer(observation, wanted)
                if aside is not None and (elsewhere := aside.command(observation)) is not None:
                    command, by = elsewhere, NOISE
                _keep(frames, plan, world, observation, expert, by)
                if len(frames.traces) * TRACE_EVERY < len(frames.pose):
                    frames.traces.append(tell(world, frames.chosen[-1]))
                world.step(command)
                if first_collision is None and world.collided:
                    first_collision = len(frames.pose)
                if not world.done and is_hopeless(np.array(frames.pose), plan):
                    world.stop()
        finally:
            expert.close()
            if aside is not None:
                aside.close()
        end, collided = world.end, world.collided
    outcome = "cut" if end == "stopped" else str(end)
    return _finish(frames, plan, outcome, collided, first_collision)


def _aside(plan: DrivePlan, world: EpisodeWorld, expert: ExpertPolicy) -> DetourDriver | None:
    if plan.detour is None:
        return None
    try:
        return DetourDriver(plan.detour, plan.episode, world, expert)
    except ValueError:  # there is no way to that place
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
        raise ValueError("recording: expected a picture and a choice in every frame")
    done, jpeg = cv2.imencode(".jpg", observation.image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, plan.look.jpeg_quality])
    if not done:
        raise ValueError("recording: a picture could not be compressed")
    frames.jpegs.append(np.asarray(jpeg, np.uint8).ravel())
    frames.pose.append(pose.as_tuple())
    frames.pose_odom.append(observation.T_odom_base.as_tuple())
    frames.state.append(observation.state)
    frames.chosen.append(chosen_future(pose, choice, expert.route()))
    frames.plan_xy.append(expert.plan(PLAN_TIMES_S))
    frames.by.append(by)


def is_hopeless(pose: NDArray[np.float64], plan: DrivePlan) -> bool:
    """Whether a drive is to be cut; `pose` [N, 3] so far: it has stayed within 0.5 m, or a pupil is 6 m off the way."""
    if plan.pupil and off_way_m(pose[-1, :2], plan.path) > _OFF_M:
        return True
    frames = round((_PUPIL_STUCK_S if plan.pupil else _EXPERT_STUCK_S) * RATE_HZ)
    if len(pose) <= frames:
        return False
    lately = pose[-frames:, :2]
    return float(np.max(np.hypot(*(lately - lately[0]).T))) < _STUCK_M


def off_way_m(point: NDArray[np.float64], path: NDArray[np.float64]) -> float:
    """Distance from a point to a polyline [n, 2], m."""
    if len(path) < 2:
        return float(hypot(*(point - path[0])))
    a, way = path[:-1], np.diff(path, axis=0)
    share = np.sum((point - a) * way, axis=1) / np.maximum(np.sum(way * way, axis=1), 1e-12)
    nearest = a + np.clip(share, 0.0, 1.0)[:, None] * way
    return float(np.min(np.hypot(*(point - nearest).T)))


def _finish(frames: _Frames, plan: DrivePlan, outcome: str, collided: bool, first_collision: int | None) -> Recorded:
    count = kept_frames(np.array(frames.pose), outcome, first_collision, pupil=plan.pupil)
    if count < LEAST_FRAMES:
        trouble = outcome if first_collision is None or plan.pupil else "collided"
        raise NothingToLearnError(f"less than {LEAST_FRAMES / RATE_HZ:g} s before trouble ({trouble})")
    if not plan.pupil and max(off_way_m(point, plan.path) for point in np.array(frames.pose)[:count, :2]) > plan.off_m:
        raise NothingToLearnError("it left the way that it was told")
    pose, by = np.array(frames.pose)[:count], np.array(frames.by, np.uint8)[:count]
    whole = outcome == "reached" and count == len(frames.pose)
    future, steps = label_futures(pose, np.array(frames.chosen)[:count], by, goes_on=whole or plan.pupil)
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


def kept_frames(pose: NDArray[np.float64], outcome: str, first_collision: int | None, *, pupil: bool = False) -> int:
    """How many frames of a drive are learned from: those before its trouble; `pose` [N, 3].

    `first_collision`: the frame by which it had collided, if it did. A pupil's trouble is what it learns from, but for
    a fall, out of which nobody drives.
    """
    count = len(pose) - (_BEFORE_CRASH if outcome == "fell" else 0)
    if pupil:
        return max(count, 0)
    if outcome in ("timeout", "cut"):  # the time it stood at the end, waiting for what never came
        gaps = np.hypot(*(pose[:, :2] - pose[-1, :2]).T)
        count = min(count, int(np.max(np.flatnonzero(gaps > _STUCK_M), initial=-1)) + 1 + RATE_HZ)
    if first_collision is not None:
        count = min(count, first_collision - _BEFORE_CRASH)
    return max(count, 0)
