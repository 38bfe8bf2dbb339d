"""A body that glides on the floor with the measured response of the robot that it stands for.

Legs and wheels cost a quarter of a drive's processor time and add nothing to a picture. Walls and people stop this
body as they stop the robot; it cannot fall, and it takes kerbs and ramps without effort. For training data: the
benchmark's robots walk and roll (how near it comes: `python -m tools.bench.sim.gliding`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from math import atan2, cos, exp, pi, sin
from types import MappingProxyType
from typing import Final

import numpy as np

from sim_hil.robots.bullet import pybullet
from sim_hil.robots.carter import drive as carter_drive
from sim_hil.robots.carter.urdf import RADIUS_M as CARTER_RADIUS_M
from sim_hil.robots.go2 import body as go2
from sim_hil.robots.go2.gait import GRAVITY_MPS2, GaitConfig, limit_command, start_gait
from sim_hil.robots.go2.kinematics import joint_angles
from sim_hil.robots.interface import BaseTruth

Vec3 = tuple[float, float, float]
HOLD_S: Final = 1.0  # a command's validity, the robots' contract (sim_hil/robots/interface.py)
_CLEAR_M: Final = 0.05  # between the body and the floor
_MASS_KG, _TILT_KGM2, _TURN_KGM2 = 15.0, 1e5, 0.5  # contacts turn the body about the vertical axis alone
_GAIT: Final = GaitConfig()


@dataclass(frozen=True)
class Glide:
    """Shape, response and sway of one robot's stand-in.

    `limit` clips a command; `accel` and `brake` bound the reference's change (vx, vy m/s², wz rad/s²), `lag_s` is the
    time constant with which the body follows the reference (vx, vy, wz). `sway`: amplitudes of the camera's platform at
    `paced_mps` and more: bob m, roll rad, pitch rad; `stride_s`: its period.
    """

    half_m: Vec3
    radius_m: float
    base_m: float
    """Height of the base frame above the floor, m."""
    limit: Callable[[Vec3], Vec3]
    accel: Vec3
    brake: Vec3
    lag_s: Vec3
    sway: Vec3
    stride_s: float
    rest: tuple[float, ...]
    """Joint angles of a render state."""
    paced_mps: float = 0.4


def _carter_limit(command: Vec3) -> Vec3:
    v, w = carter_drive.V_MAX_MPS, carter_drive.W_MAX_RADPS
    return (max(-v, min(v, command[0])), 0.0, max(-w, min(w, command[2])))


_FEET = start_gait(_GAIT, 0.0).feet
_GO2_ACCEL: Final = (_GAIT.accel_x_mps2, _GAIT.accel_y_mps2, _GAIT.alpha_radps2)
_TURN: Final = carter_drive.ALPHA_RADPS2
GLIDES: Final[Mapping[str, Glide]] = MappingProxyType(
    {
        "go2": Glide(
            half_m=(0.33, 0.15, 0.17),
            radius_m=go2.RADIUS_M,
            base_m=_GAIT.body_height_m,
            limit=lambda command: limit_command(_GAIT, command),
            accel=_GO2_ACCEL,
            brake=_GO2_ACCEL,
            lag_s=(0.05, 0.05, 0.01),
            sway=(0.004, 0.02, 0.02),
            stride_s=_GAIT.period_s,
            rest=tuple(angle for leg, foot in enumerate(_FEET) for angle in joint_angles(leg, foot)),
        ),
        "carter": Glide(
            half_m=(0.35, 0.29, 0.3),
            radius_m=CARTER_RADIUS_M,
            base_m=0.0,
            limit=_carter_limit,
            accel=(carter_drive.ACCEL_MPS2, 1.0, _TURN),
            brake=(carter_drive.BRAKE_MPS2, 1.0, _TURN),
            lag_s=(0.02, 0.02, 0.02),
            sway=(0.0, 0.0, 0.0),
            stride_s=1.0,
            rest=(0.0, 0.0),
        ),
    }
)
"""Available stand-ins by robot."""


class GlidingRobot:
    """The stand-in's body in one physics client; implements sim_hil.robots.interface.Robot."""

    def __init__(
        self, client: int, start: Vec3, dt_s: float, glide: Glide, ground_m: Callable[[float, float], float]
    ) -> None:
        """`start`: x m, y m, heading rad; `ground_m`: height of the ground at (x, y)."""
        self._client, self._dt_s, self._glide, self._ground_m = client, dt_s, glide, ground_m
        self.radius_m = glide.radius_m
        self._blend = tuple(1.0 - exp(-dt_s / lag) for lag in glide.lag_s)
        shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=glide.half_m, physicsClientId=client)
        self._above_m = _CLEAR_M + glide.half_m[2]
        self.body = int(
            pybullet.createMultiBody(
                _MASS_KG, shape, -1, (start[0], start[1], ground_m(start[0], start[1]) + self._above_m),
                pybullet.getQuaternionFromEuler((0, 0, start[2])), physicsClientId=client,
            )
        )  # fmt: skip
        pybullet.changeDynamics(self.body, -1, linearDamping=0.0, angularDamping=0.0, physicsClientId=client)
        inertia = (_TILT_KGM2, _TILT_KGM2, _TURN_KGM2)
        pybullet.changeDynamics(
            self.body, -1, lateralFriction=0.0, localInertiaDiagonal=inertia, physicsClientId=client
        )
        self._command: Vec3 = (0.0, 0.0, 0.0)
        self._hold = round(HOLD_S / dt_s)
        self._held = 0
        self._reference: Vec3 = (0.0, 0.0, 0.0)
        self._velocity: Vec3 = (0.0, 0.0, 0.0)
        self._steps = 0
        self.observe()

    @property
    def ready(self) -> bool:
        """Always: it needs no standing up."""
        return True

    def stand(self) -> None:
        """Do nothing."""

    def command(self, vx_mps: float, vy_mps: float, wz_radps: float) -> None:
        """Command a velocity in the body frame for 1 s."""
        self._command, self._held = self._glide.limit((vx_mps, vy_mps, wz_radps)), self._hold

    @property
    def _commanded(self) -> Vec3:
        return self._command if self._held > 0 else (0.0, 0.0, 0.0)

    def drive(self) -> None:
        """Set the velocity for the step that follows."""
        glide, dt_s = self._glide, self._dt_s
        wanted = self._commanded
        self._held = max(self._held - 1, 0)
        self._reference = _vec(
            carter_drive.towards(now, target, up * dt_s, down * dt_s)
            for now, target, up, down in zip(self._reference, wanted, glide.accel, glide.brake, strict=True)
        )
        self._velocity = vx, vy, wz = _vec(
            now + blend * (target - now)
            for now, target, blend in zip(self._velocity, self._reference, self._blend, strict=True)
        )
        (x, y, z), heading = self._centre, self._heading
        c, s = cos(heading), sin(heading)
        # The step's gravity takes away what is added here; height follows the ground.
        rise = (self._ground_m(x, y) + self._above_m - z) / dt_s + GRAVITY_MPS2 * dt_s
        pybullet.resetBaseVelocity(
            self.body, (c * vx - s * vy, s * vx + c * vy, rise), (0.0, 0.0, wz), physicsClientId=self._client
        )

    def observe(self) -> None:
        """Read the body after a step."""
        self._centre, (_, _, z, w) = pybullet.getBasePositionAndOrientation(self.body, physicsClientId=self._client)
        self._heading = 2.0 * atan2(z, w)
        self._steps += 1

    def pose(self) -> tuple[Vec3, float]:
        """Base position, m, and heading, rad."""
        x, y, z = self._centre
        return (x, y, z - self._above_m + self._glide.base_m), self._heading

    def up(self) -> float:
        """Upright always."""
        return 1.0

    def truth(self, time_s: float) -> BaseTruth:
        """Return the current ground truth, stamped `time_s`."""
        position, heading = self.pose()
        (vx, vy, vz), (_, _, wz) = pybullet.getBaseVelocity(self.body, physicsClientId=self._client)
        return BaseTruth(
            time_s=time_s,
            position_m=np.array(position),
            quaternion_wxyz=np.array((cos(heading / 2), 0.0, 0.0, sin(heading / 2))),
            rpy_rad=np.array((0.0, 0.0, heading)),
            velocity_world_mps=np.array((vx, vy, vz)),
            gyro_radps=np.array((0.0, 0.0, wz)),
            accel_mps2=np.array((0.0, 0.0, GRAVITY_MPS2)),
            commanded=self._commanded,
        )

    def render_state(self) -> tuple[float, ...]:
        """Position, quaternion xyzw and joint angles; the platform sways as with the robot's steps."""
        glide = self._glide
        (x, y, z), heading = self.pose()
        vx, vy, wz = self._velocity
        pace = min(1.0, (abs(vx) + abs(vy) + glide.radius_m * abs(wz)) / glide.paced_mps)
        phase = 2 * pi * self._steps * self._dt_s / glide.stride_s
        bob, roll, pitch = glide.sway
        bob, roll, pitch = pace * bob * sin(2 * phase), pace * roll * sin(phase), pace * pitch * sin(2 * phase + 1.0)
        turn = pybullet.getQuaternionFromEuler((roll, pitch, heading))
        return (x, y, z + bob, *turn, *glide.rest)


def _vec(values: Iterator[float]) -> Vec3:
    x, y, z = values
    return (x, y, z)
