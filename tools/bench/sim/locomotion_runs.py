"""Courses and runs of the locomotion table, one deterministic function per run."""

from __future__ import annotations

import time
from dataclasses import dataclass
from math import cos, hypot, pi, radians, sin
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Final

import numpy as np

from sim_hil.robots.bullet import pybullet
from sim_hil.robots.go2.body import Go2
from sim_hil.robots.go2.gait import GRAVITY_MPS2, GaitConfig
from sim_hil.robots.go2.sport import MODE_DAMPING
from sim_hil.robots.go2.urdf import TORQUE_LIMITS_NM

Command = tuple[float, float, float]
Vec3 = tuple[float, float, float]

COMMAND_EVERY_S = 0.1  # a client repeats its command: the robot forgets one after a second
BUMP_M, BUMP_LENGTH_M, BUMP_EVERY_M = 0.05, 0.30, 0.9
RAMP_RAD = radians(8.0)
RAMP_START_M, RAMP_LENGTH_M, PLATEAU_M = 1.5, 6.0, 2.0
FRICTION = 0.9  # of every floor, see sim_hil/simulation/physics.py
GROUNDS = ("flat", "bumps", "ramp")
SETTLE_S, MEASURE_S = 2.5, 3.0
REL_BOUND = 0.10
# What ten per cent of nothing would be: a command of zero, or nearly, is kept when this close (m/s, m/s, rad/s).
ABS_BOUND: Final = (0.03, 0.03, 0.05)
# (name, ground, commands before measuring, measured command, seconds): a quarter turn is made at 0.6 rad/s.
_QUARTER_S = pi / 2 / 0.6
ROUTES: Final[dict[str, tuple[str, tuple[tuple[Command, float], ...], Command, float]]] = {
    "bumps forward": ("bumps", (((0.6, 0.0, 0.0), 3.0),), (0.6, 0.0, 0.0), 25.0),
    "bumps forward slow": ("bumps", (((0.3, 0.0, 0.0), 4.0),), (0.3, 0.0, 0.0), 25.0),
    "bumps sideways": ("bumps", (((0.6, 0.0, 0.0), 6.0), ((0.0, 0.0, 0.6), _QUARTER_S)), (0.0, -0.3, 0.0), 10.0),
    "ramp up": ("ramp", (((0.6, 0.0, 0.0), 5.0),), (0.6, 0.0, 0.0), 7.0),
    "ramp down": ("ramp", (((0.6, 0.0, 0.0), 19.0),), (0.6, 0.0, 0.0), 7.0),
    "ramp down backwards": ("ramp", (((0.6, 0.0, 0.0), 11.0), ((-0.4, 0.0, 0.0), 2.0)), (-0.4, 0.0, 0.0), 6.0),
    "ramp across": (
        "ramp", (((0.6, 0.0, 0.0), 7.5), ((0.0, 0.0, 0.6), _QUARTER_S), ((0.6, 0.0, 0.0), 2.0)), (0.6, 0.0, 0.0), 4.0,
    ),
    "ramp turning": ("ramp", (((0.6, 0.0, 0.0), 7.5), ((0.0, 0.0, 0.6), 1.0)), (0.0, 0.0, 0.6), 2 * pi / 0.6),
}  # fmt: skip
PUSH_S: Final = 0.1
# (name, command while pushed, force in the world frame, N; the robot faces x). It withstands small pushes and falls
# after large ones.
PUSHES: Final[tuple[tuple[str, Command, tuple[float, float, float], bool], ...]] = (
    ("standing, from the side", (0.0, 0.0, 0.0), (0.0, 80.0, 0.0), False),
    ("standing, from behind", (0.0, 0.0, 0.0), (100.0, 0.0, 0.0), False),
    ("walking, from the side", (0.6, 0.0, 0.0), (0.0, -80.0, 0.0), False),
    ("walking, from ahead", (0.6, 0.0, 0.0), (-100.0, 0.0, 0.0), False),
    ("standing, hard, left", (0.0, 0.0, 0.0), (0.0, 600.0, 300.0), True),
    ("standing, hard, right", (0.0, 0.0, 0.0), (0.0, -600.0, 300.0), True),
    ("walking, hard, left", (0.8, 0.0, 0.0), (0.0, 600.0, 300.0), True),
    ("running, hard, right", (1.4, 0.0, 0.0), (0.0, -600.0, 300.0), True),
)


def open_physics(rate_hz: int) -> int:
    """Return a deterministic physics client with gravity and `rate_hz` steps a second."""
    client = int(pybullet.connect(pybullet.DIRECT))
    pybullet.setPhysicsEngineParameter(
        fixedTimeStep=1.0 / rate_hz, numSubSteps=1, deterministicOverlappingPairs=1, physicsClientId=client
    )
    pybullet.setGravity(0, 0, -GRAVITY_MPS2, physicsClientId=client)
    return client


def add_box(client: int, centre: Vec3, size: Vec3, pitch_rad: float, friction: float) -> None:
    """Add a solid box; sizes in m, `pitch_rad` turns it about y."""
    half = [extent / 2 for extent in size]
    shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, physicsClientId=client)
    turn = pybullet.getQuaternionFromEuler((0.0, pitch_rad, 0.0))
    body = pybullet.createMultiBody(0, shape, -1, centre, turn, physicsClientId=client)
    pybullet.changeDynamics(body, -1, lateralFriction=friction, physicsClientId=client)


@dataclass(frozen=True)
class Walked:
    """Achieved motion of a command: means over the measured time (m/s, m/s, rad/s), and worst values."""

    achieved: Command
    tilt_rad: float
    """Largest roll or pitch."""
    torque_share: float
    """Largest share of a motor's torque limit."""
    fell: bool


class Course:
    """One Go2 in one physics client on one kind of ground, starting at the origin with heading 0. Deterministic.

    `bumps` are square-edged bars across the way from x = 1 m on; `ramp` rises at 8 degrees over 6 m from x = 1.5 m on,
    then a plateau of 2 m and the same way down. Raises ValueError for a ground it does not know.
    """

    def __init__(self, ground: str, rate_hz: int) -> None:
        if ground not in GROUNDS:
            raise ValueError(f"ground: expected one of {', '.join(GROUNDS)}, found {ground!r}")
        self.rate_hz = rate_hz
        self.time_s = 0.0
        self.fell = False
        self._steps = 0
        self.client = open_physics(rate_hz)
        try:
            self._box((0.0, 0.0, -0.5), (400.0, 400.0, 1.0))
            self._build(ground)
            with TemporaryDirectory(prefix="edge-locomotion-") as folder:
                self.robot = Go2(self.client, Path(folder), (0.0, 0.0, 0.0), 1.0 / rate_hz)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Course:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _build(self, ground: str) -> None:
        if ground == "bumps":
            for index in range(20):
                self._box((1.0 + BUMP_EVERY_M * index, 0.0, BUMP_M / 2), (BUMP_LENGTH_M, 4.0, BUMP_M))
        elif ground == "ramp":
            run, rise = RAMP_LENGTH_M * cos(RAMP_RAD), RAMP_LENGTH_M * sin(RAMP_RAD)
            top = RAMP_START_M + run
            self._slab(RAMP_START_M + run / 2, rise / 2, -RAMP_RAD)
            self._box((top + PLATEAU_M / 2, 0.0, rise / 2), (PLATEAU_M, 12.0, rise))
            self._slab(top + PLATEAU_M + run / 2, rise / 2, RAMP_RAD)

    def _slab(self, x_m: float, z_m: float, pitch_rad: float) -> None:
        """Add a slab 1 m thick with a ramp's length; its top is centred on (x, 0, z)."""
        centre = (x_m - 0.5 * sin(pitch_rad), 0.0, z_m - 0.5 * cos(pitch_rad))
        self._box(centre, (RAMP_LENGTH_M, 12.0, 1.0), pitch_rad)

    def _box(self, centre: Vec3, size: Vec3, pitch_rad: float = 0.0) -> None:
        add_box(self.client, centre, size, pitch_rad, FRICTION)

    def step(self) -> None:
        """Advance the physics by one step."""
        self.robot.drive()
        pybullet.stepSimulation(physicsClientId=self.client)
        self.robot.observe()
        self._steps += 1
        self.time_s = self._steps / self.rate_hz
        self.fell = self.fell or self.robot.up() < 0.5

    def wait(self, seconds: float) -> None:
        """Advance the simulation by `seconds`."""
        for _ in range(round(seconds * self.rate_hz)):
            self.step()

    def stand(self, timeout_s: float = 15.0) -> bool:
        """Request standing until the robot is ready; returns False if it is not after `timeout_s`."""
        until = self.time_s + timeout_s
        while not self.robot.ready and self.time_s < until:
            self.robot.stand()
            self.wait(0.1)
        return self.robot.ready

    def walk(self, command: Command, seconds: float) -> Walked:
        """Repeat a command for `seconds` and measure."""
        every = round(COMMAND_EVERY_S * self.rate_hz)
        sums, tilt, share = [0.0, 0.0, 0.0], 0.0, 0.0
        steps = round(seconds * self.rate_hz)
        for index in range(steps):
            if index % every == 0:
                self.robot.command(*command)
            self.step()
            body = self.robot.measured().body
            sums[0] += body.vx_mps
            sums[1] += body.vy_mps
            sums[2] += body.yaw_rate_radps
            tilt = max(tilt, abs(body.roll_rad), abs(body.pitch_rad))
            share = max(share, *(abs(t) / TORQUE_LIMITS_NM[i % 3] for i, t in enumerate(self.robot.torques_nm)))
        achieved = (sums[0] / steps, sums[1] / steps, sums[2] / steps)
        return Walked(achieved, tilt, share, self.fell)

    def push(self, force_n: tuple[float, float, float], seconds: float) -> None:
        """Push the trunk's centre with a force of the world frame for `seconds`."""
        for _ in range(round(seconds * self.rate_hz)):
            where = pybullet.getBasePositionAndOrientation(self.robot.body, physicsClientId=self.client)[0]
            pybullet.applyExternalForce(
                self.robot.body, -1, force_n, where, pybullet.WORLD_FRAME, physicsClientId=self.client
            )
            self.step()

    def close(self) -> None:
        """Release the physics."""
        if self.client >= 0:
            pybullet.disconnect(physicsClientId=self.client)
            self.client = -1


@dataclass(frozen=True)
class Row:
    """Command of the table (vx m/s, vy m/s, wz rad/s) with its result."""

    name: str
    commanded: Command
    achieved: Command
    error_share: float
    """Largest relative error of a component with a command above `ABS_BOUND`."""
    tilt_rad: float
    torque_share: float
    fell: bool
    kept: bool


@dataclass(frozen=True)
class Endured:
    """Result of a walk under random commands."""

    seed: int
    minutes: float
    commands: int
    path_m: float
    tilt_rad: float
    falls: int

    @property
    def kept(self) -> bool:
        """Whether it never fell."""
        return self.falls == 0


@dataclass(frozen=True)
class Pushed:
    """Result of a push: fall, time until the motors were limp, duration of RecoveryStand."""

    name: str
    impulse_ns: float
    fell: bool
    should_fall: bool
    limp_s: float
    recovered_s: float
    recovered: bool

    @property
    def kept(self) -> bool:
        """Whether the robot withstood the small push, or recovered from the large one."""
        return self.fell == self.should_fall and self.recovered


@dataclass(frozen=True)
class Speed:
    """Processor time of a trot at 0.6 m/s in this process, medians over its steps."""

    rate_hz: int
    sim_s_per_cpu_s: float
    step_us: float
    physics_us: float
    control_us: float


def as_row(name: str, commanded: Command, walked: Walked) -> Row:
    """Judge a walk."""
    off = [abs(got - want) for got, want in zip(walked.achieved, commanded, strict=True)]
    kept = all(
        error <= max(REL_BOUND * abs(want), floor) for error, want, floor in zip(off, commanded, ABS_BOUND, strict=True)
    )
    shares = [
        error / abs(want) for error, want, floor in zip(off, commanded, ABS_BOUND, strict=True) if abs(want) > floor
    ]
    return Row(
        name, commanded, walked.achieved, max(shares), walked.tilt_rad, walked.torque_share, walked.fell,
        kept and not walked.fell,
    )  # fmt: skip


def track(command: Command, rate_hz: int) -> Row:
    """Run one command on flat ground."""
    with Course("flat", rate_hz) as course:
        course.stand()
        course.walk(command, SETTLE_S)
        return as_row("flat", command, course.walk(command, MEASURE_S))


def travel(name: str, rate_hz: int) -> Row:
    """Run one of ROUTES."""
    ground, before, command, seconds = ROUTES[name]
    with Course(ground, rate_hz) as course:
        course.stand()
        for approach, duration in before:
            course.walk(approach, duration)
        return as_row(name, command, course.walk(command, seconds))


def endure(rate_hz: int, seed: int, seconds: float) -> Endured:
    """Run random commands of the whole envelope for 0.3 to 4 s each, a fifth of them stops; stand up after a fall."""
    rng = np.random.default_rng((seed, 20))
    config = GaitConfig()
    commands, falls, tilt, path = 0, 0, 0.0, 0.0
    with Course("flat", rate_hz) as course:
        course.stand()
        end_s = course.time_s + seconds
        (x, y, _), _ = course.robot.pose()
        while course.time_s < end_s:
            vx, vy, wz = rng.uniform(*config.vx_limits_mps), *rng.uniform(-1, 1, 2)
            command = (vx, vy * config.vy_limit_mps, wz * config.wz_limit_radps)
            if rng.random() < 0.2:
                command = (0.0, 0.0, 0.0)
            walked = course.walk(command, min(rng.uniform(0.3, 4.0), max(end_s - course.time_s, 0.1)))
            commands += 1
            tilt = max(tilt, walked.tilt_rad)
            (new_x, new_y, _), _ = course.robot.pose()
            path += hypot(new_x - x, new_y - y)
            x, y = new_x, new_y
            if course.fell:
                falls += 1
                course.wait(1.0)
                course.stand(30.0)
                course.fell = False
    return Endured(seed, seconds / 60.0, commands, path, tilt, falls)


def push_over(index: int, rate_hz: int) -> Pushed:
    """Run one of PUSHES, then RecoveryStand after a fall."""
    name, command, force, should_fall = PUSHES[index]
    impulse = PUSH_S * hypot(*force)
    with Course("flat", rate_hz) as course:
        course.stand()
        course.walk(command, 2.0)
        course.push(force, PUSH_S)
        pushed_s, limp_s = course.time_s, 0.0
        while course.time_s < pushed_s + 3.0:
            course.walk(command, 0.1)
            if limp_s == 0.0 and course.robot.sport.mode == MODE_DAMPING:
                limp_s = course.time_s - pushed_s
        fell, down_s = course.fell, course.time_s
        recovered = course.stand(30.0)
        recovered_s = course.time_s - down_s if fell else 0.0
        course.wait(1.0)
        recovered = recovered and course.robot.ready and course.robot.up() > 0.99
    return Pushed(name, impulse, fell, should_fall, limp_s, recovered_s, recovered)


def measure_speed(rate_hz: int, _repeat: int) -> Speed:
    """Trot for 8 s after standing up and time every step."""
    with Course("flat", rate_hz) as course:
        course.stand()
        course.walk((0.6, 0.0, 0.2), 2.0)
        robot, client = course.robot, course.client
        every, total, physics = round(0.1 * rate_hz), [], []
        clock = time.thread_time_ns
        for index in range(8 * rate_hz):
            if index % every == 0:
                robot.command(0.6, 0.0, 0.2)
            begin = clock()
            robot.drive()
            driven = clock()
            pybullet.stepSimulation(physicsClientId=client)
            stepped = clock()
            robot.observe()
            total.append(clock() - begin)
            physics.append(stepped - driven)
    step_us, physics_us = float(np.median(total)) / 1e3, float(np.median(physics)) / 1e3
    return Speed(rate_hz, len(total) / rate_hz / (sum(total) / 1e9), step_us, physics_us, step_us - physics_us)
