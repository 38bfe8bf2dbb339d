"""Ground to walk the Go2 over, and what it does there: the physics of the locomotion table, nothing printed."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians, sin
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType

import pybullet

from sim_hil.robots.go2.body import Go2
from sim_hil.robots.go2.gait import GRAVITY_MPS2
from sim_hil.robots.go2.urdf import TORQUE_LIMITS_NM

Command = tuple[float, float, float]

COMMAND_EVERY_S = 0.1  # a client repeats its command: the robot forgets one after a second
BUMP_M, BUMP_LENGTH_M, BUMP_EVERY_M = 0.05, 0.30, 0.9
RAMP_RAD = radians(8.0)
RAMP_START_M, RAMP_LENGTH_M, PLATEAU_M = 1.5, 6.0, 2.0
FRICTION = 0.9  # of every floor of ours, see sim_hil/simulation/physics.py
GROUNDS = ("flat", "bumps", "ramp")


@dataclass(frozen=True)
class Walked:
    """What a command achieved: means over the measured time (m/s, m/s, rad/s), and the worst of it."""

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
        self.client = pybullet.connect(pybullet.DIRECT)
        try:
            pybullet.setPhysicsEngineParameter(
                fixedTimeStep=1.0 / rate_hz, numSubSteps=1, deterministicOverlappingPairs=1, physicsClientId=self.client
            )
            pybullet.setGravity(0, 0, -GRAVITY_MPS2, physicsClientId=self.client)
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
        """A slab 1 m thick of a ramp's length whose top is centred on (x, 0, z)."""
        centre = (x_m - 0.5 * sin(pitch_rad), 0.0, z_m - 0.5 * cos(pitch_rad))
        self._box(centre, (RAMP_LENGTH_M, 12.0, 1.0), (0.0, pitch_rad, 0.0))

    def _box(
        self,
        centre: tuple[float, float, float],
        size: tuple[float, float, float],
        rpy: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        half = [extent / 2 for extent in size]
        shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, physicsClientId=self.client)
        turn = pybullet.getQuaternionFromEuler(rpy)
        body = pybullet.createMultiBody(0, shape, -1, centre, turn, physicsClientId=self.client)
        pybullet.changeDynamics(body, -1, lateralFriction=FRICTION, physicsClientId=self.client)

    def step(self) -> None:
        """One step of physics."""
        self.robot.drive()
        pybullet.stepSimulation(physicsClientId=self.client)
        self.robot.observe()
        self._steps += 1
        self.time_s = self._steps / self.rate_hz
        self.fell = self.fell or self.robot.up() < 0.5

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        for _ in range(round(seconds * self.rate_hz)):
            self.step()

    def stand(self, timeout_s: float = 15.0) -> bool:
        """Ask it to stand until it is ready; False when it is not after `timeout_s`."""
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
