"""Walks of the simulated Go2 for the drift benchmark: truth, sensor readings and camera frames.

Full leg physics (sim_hil.Simulation): the body bobs, rolls, slips and sways as the trot makes it. The camera is
sim_hil's, drawn at the simulated instant, compressed as JPEG like the robot's own and decoded by the runner's code.
Added to the truth, since the simulator's sensors are ideal: the noise in `SensorNoise`. Time is the simulation's.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.core.geometry import SE2, wrap_angle
from edge.odometry.camera_geometry import Attitude, CameraGeometry
from edge.odometry.visual_odometry import VisualMotion, VisualOdometry, grey_frame
from sim_hil.robots.go2.body import RobotTruth
from sim_hil.scene.scene import Scene
from sim_hil.simulation.camera import CAMERA_HFOV_RAD, CAMERA_PITCH_RAD, CAMERA_POSITION_M, CameraWorld
from sim_hil.simulation.physics import Simulation, SportAction

STATE_NS = 20_000_000
FRAME_NS = 100_000_000
CAMERA_DELAY_NS = 100_000_000
"""Delay from the picture to the visual motion in the estimator (transport and computing)."""
SIZE_PX = (320, 180)
JPEG_QUALITY = 85
STAND_S = 3.0
CAMERA_HEIGHT_M = 0.3545
"""Where it is, not a fit: the trotting base is 0.3114 m up (mean of walks 901 and 902), the camera 0.043 m above it."""
CAMERA = CameraGeometry(
    hfov_rad=CAMERA_HFOV_RAD,
    height_m=CAMERA_HEIGHT_M,
    pitch_rad=CAMERA_PITCH_RAD,
    forward_m=CAMERA_POSITION_M[0],  # the renderer's optical axis meets the middle of the picture within 0.1 pixel
)


@dataclass(frozen=True)
class SensorNoise:
    """Noise added to the simulator's ideal sensors; every number is drawn per run or white.

    The gyro's white noise is twice, its bias four times what a BMI088's data sheet promises after zeroing
    (0.014 °/s/√Hz, 0.05 °/s-class drift); the mounting errors are what a hand calibration leaves.
    """

    gyro_radps_rthz: float = math.radians(0.03)
    gyro_bias_radps: float = math.radians(0.2)
    attitude_bias_rad: float = math.radians(0.1)
    attitude_rad: float = math.radians(0.05)
    camera_height: float = 0.003
    """Relative error of the height in the robot file."""
    stamp_ns: float = 2e6
    """Error of a frame's capture stamp."""


@dataclass(frozen=True)
class Sample:
    """State at 50 Hz: truth, and the sensors without odometry noise."""

    stamp_ns: int
    T_world_base: SE2
    gyro_wz_radps: float
    roll_rad: float
    pitch_rad: float
    foot_forces: tuple[float, ...]
    commanded: tuple[float, float, float]
    height_m: float


@dataclass(frozen=True)
class Walk:
    """Recorded walk with its visual motions."""

    seed: int
    samples: tuple[Sample, ...]
    visual: tuple[VisualMotion, ...]
    frames: int
    visual_ms: tuple[float, ...]
    distance_m: float
    refused: int


class Pilot:
    """Drives up and down a corridor along a random weaving line at changing speed, with rare stops."""

    def __init__(self, rng: np.random.Generator, x_range_m: tuple[float, float], half_width_m: float) -> None:
        self._rng = rng
        self._x_range_m = x_range_m
        self._half_width_m = half_width_m
        self._direction = 1.0
        self._target_y = 0.0
        self._speed = 0.5
        self._until_s = 0.0

    def command(self, pose: SE2, time_s: float) -> tuple[float, float, float]:
        """Return the body velocity (m/s, m/s, rad/s) for a pose."""
        if time_s >= self._until_s:
            self._target_y = float(self._rng.uniform(-self._half_width_m, self._half_width_m))
            self._speed = float(self._rng.uniform(0.4, 0.75))
            self._until_s = time_s + float(self._rng.uniform(2.0, 6.0))
        low, high = self._x_range_m
        if (pose.x_m > high and self._direction > 0) or (pose.x_m < low and self._direction < 0):
            self._direction = -self._direction
        ahead = 1.2
        wanted = math.atan2(self._target_y - pose.y_m, ahead * self._direction)
        error = wrap_angle(wanted - pose.theta_rad)
        turn = max(-0.7, min(0.7, 1.5 * error))
        return self._speed * max(0.0, math.cos(error)), 0.0, turn


def record_walk(scene: Scene, seed: int, *, distance_m: float, people: int, noise: SensorNoise) -> Walk:
    """Walk `distance_m` with the camera on. Raises RuntimeError if the robot falls."""
    rng = np.random.default_rng((seed, 1))
    simulation = Simulation(scene, people=people, seed=seed)
    world: CameraWorld | None = None
    try:
        world = CameraWorld(scene, people=people, seed=seed)
        return _record(simulation, world, scene, seed, distance_m, noise, rng)
    finally:
        simulation.close()
        if world is not None:
            world.close()


def _record(
    simulation: Simulation, world: CameraWorld, scene: Scene, seed: int, distance_m: float, noise: SensorNoise,
    rng: np.random.Generator,
) -> Walk:  # fmt: skip
    pilot = Pilot(rng, (scene.floor_min_m[0] + 3.0, scene.floor_max_m[0] - 4.0), 0.9)
    gyro_bias = rng.normal(0, noise.gyro_bias_radps)
    tilt = rng.normal(0, noise.attitude_bias_rad, 2)
    height = 1.0 + rng.normal(0, noise.camera_height)
    geometry = replace(CAMERA, height_m=CAMERA.height_m * height)
    eye = VisualOdometry(geometry)
    samples: list[Sample] = []
    motions: list[VisualMotion] = []
    visual_ms: list[float] = []
    frames = 0
    walked = 0.0
    _prepare(simulation)
    start_s = simulation.truth().time_s
    steps = round(STATE_NS / 1e9 / Simulation.DT_S)
    command = (0.0, 0.0, 0.0)
    while walked < distance_m:
        for _ in range(steps):
            simulation.step()
        truth = simulation.truth()
        assert isinstance(truth, RobotTruth)
        time_s = truth.time_s - start_s
        pose = SE2(float(truth.position_m[0]), float(truth.position_m[1]), float(truth.rpy_rad[2]))
        if simulation.fell:
            raise RuntimeError(f"walk {seed}: the robot fell after {walked:.1f} m")
        white = rng.normal(0, noise.gyro_radps_rthz / math.sqrt(STATE_NS / 1e9))
        roll, pitch = (float(v) for v in truth.rpy_rad[:2] + tilt + rng.normal(0, noise.attitude_rad, 2))
        sample = Sample(
            round(time_s * 1e9), pose, float(truth.gyro_radps[2]) + gyro_bias + white, roll, pitch,
            tuple(map(float, truth.foot_force_n)), command, float(truth.position_m[2]),
        )  # fmt: skip
        if samples:
            last = samples[-1].T_world_base
            walked += math.hypot(pose.x_m - last.x_m, pose.y_m - last.y_m)
        samples.append(sample)
        if time_s >= STAND_S:
            command = pilot.command(pose, time_s)
            simulation.command(*command)
        if sample.stamp_ns % FRAME_NS < STATE_NS:
            frames += 1
            picture = world.render(simulation.render_state(), *SIZE_PX)
            stamp_ns = sample.stamp_ns + round(rng.normal(0, noise.stamp_ns))
            motion, took_ms = look(eye, picture, stamp_ns, Attitude(roll, pitch))
            visual_ms.append(took_ms)
            if motion is not None:
                motions.append(motion)
    return Walk(seed, tuple(samples), tuple(motions), frames, tuple(visual_ms), walked, eye.refused)


def look(
    eye: VisualOdometry, picture: NDArray[np.uint8], stamp_ns: int, attitude: Attitude
) -> tuple[VisualMotion | None, float]:
    """Pass a frame through JPEG to the visual odometry; returns motion and computing time, ms of this thread."""
    bgr = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise RuntimeError("OpenCV could not encode a camera frame as JPEG")
    begin_s = time.thread_time()
    grey = grey_frame(data.tobytes())
    assert grey is not None
    motion = eye.step(grey, stamp_ns, attitude)
    return motion, (time.thread_time() - begin_s) * 1e3


def _prepare(simulation: Simulation) -> None:
    simulation.sport(SportAction.STAND_UP)
    for _ in range(round(2.0 / Simulation.DT_S)):
        simulation.step()
    simulation.sport(SportAction.BALANCE_STAND)
    for _ in range(round(0.5 / Simulation.DT_S)):
        simulation.step()
