"""The single runs of the locomotion table: one function each, deterministic, one Go2 in one physics client."""

from __future__ import annotations

import time
from dataclasses import dataclass
from math import hypot, pi
from typing import Final

import numpy as np
import pybullet

from sim_hil.robots.go2.gait import GaitConfig
from sim_hil.robots.go2.sport import MODE_DAMPING
from tools.bench.sim.locomotion_course import Command, Course, Walked

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
# (name, command while pushed, force in the world frame, N; the robot looks along x): small ones it takes, large ones
# topple it.
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


@dataclass(frozen=True)
class Row:
    """One command of the table (vx m/s, vy m/s, wz rad/s), and what came of it."""

    name: str
    commanded: Command
    achieved: Command
    error_share: float
    """The worst component's error as a share of its command; of components commanded more than `ABS_BOUND`."""
    tilt_rad: float
    torque_share: float
    fell: bool
    kept: bool


@dataclass(frozen=True)
class Endured:
    """One walk under random commands."""

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
    """One push: whether it fell, when it had gone limp, and how long RecoveryStand took from the ground."""

    name: str
    impulse_ns: float
    fell: bool
    should_fall: bool
    limp_s: float
    recovered_s: float
    recovered: bool

    @property
    def kept(self) -> bool:
        """Whether the small push was taken, or the large one recovered from."""
        return self.fell == self.should_fall and self.recovered


@dataclass(frozen=True)
class Speed:
    """What a trot at 0.6 m/s costs this process, medians over its steps; the processor's time, not the wall's."""

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
    """One command on flat ground."""
    with Course("flat", rate_hz) as course:
        course.stand()
        course.walk(command, SETTLE_S)
        return as_row("flat", command, course.walk(command, MEASURE_S))


def travel(name: str, rate_hz: int) -> Row:
    """One of ROUTES."""
    ground, before, command, seconds = ROUTES[name]
    with Course(ground, rate_hz) as course:
        course.stand()
        for approach, duration in before:
            course.walk(approach, duration)
        return as_row(name, command, course.walk(command, seconds))


def endure(rate_hz: int, seed: int, seconds: float) -> Endured:
    """Random commands of the whole envelope, each kept for 0.3 to 4 s, a fifth a stop; stands up after a fall."""
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
    """One of PUSHES, then RecoveryStand if it fell."""
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
