"""Carter in PyBullet: two driven wheels and casters; only wheel torques move it."""

from __future__ import annotations

from dataclasses import dataclass
from math import asin, atan2, exp, pi, radians
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sim_hil.robots.battery import BatteryReading
from sim_hil.robots.bullet import pybullet
from sim_hil.robots.carter.battery import CarterBattery, load_w
from sim_hil.robots.carter.drive import DriveController, OdometrySample, WheelCalibration, WheelOdometry
from sim_hil.robots.carter.urdf import BODY_COM_M, LINKS, RADIUS_M, write_carter_urdf
from sim_hil.robots.go2.gait import GRAVITY_MPS2
from sim_hil.robots.interface import BaseTruth

Array = NDArray[np.float64]

RENDER_FIELDS: Final = 9  # position, quaternion xyzw, left and right wheel's angle
# Where the camera sits on the base frame, which lies on the floor, and how it looks; a lens like the Go2's, so that one
# policy serves both robots (the maker's own front camera sees 121.5 degrees).
CAMERA_POSITION_M: Final = (0.25, 0.0, 0.45)
CAMERA_PITCH_RAD: Final = 0.0
CAMERA_HFOV_RAD: Final = radians(100.0)
# Our choice: rubber on a clean floor (multiplied by the floor's own 0.9), casters that roll, a shell that slides.
TYRE_GRIP: Final = 0.9
CASTER_GRIP: Final = 0.05
SHELL_GRIP: Final = 0.3
WHEEL_FRICTION_NM: Final = 0.4
_IMU_S: Final = 0.01
_IMU_CORNER_HZ: Final = 40.0
_BUMPER_HOLD_S: Final = 0.2  # as a switch with a debounced contact
_MIN_BUMP_N: Final = 5.0


@dataclass(frozen=True)
class Bumpers:
    """Sides of the shell that were pushed within the last 0.2 s."""

    front: bool = False
    rear: bool = False
    left: bool = False
    right: bool = False


@dataclass(frozen=True)
class CarterTruth(BaseTruth):
    """Ground truth plus the base's own measurements: angle, speed and torque of both wheels, odometry."""

    wheel_q_rad: tuple[float, float]
    wheel_dq_radps: tuple[float, float]
    wheel_tau_nm: tuple[float, float]
    odometry: OdometrySample
    battery: BatteryReading
    bumpers: Bumpers
    powered: bool
    estop: bool
    saturated: bool


Vec3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


def _rotate(quaternion_xyzw: Quaternion, v: Vec3) -> Vec3:
    """Transform a vector from the base frame to the world; plain floats, because numpy is slow for three numbers."""
    x, y, z, w = quaternion_xyzw
    tx, ty, tz = 2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])
    return (
        v[0] + w * tx + y * tz - z * ty,
        v[1] + w * ty + z * tx - x * tz,
        v[2] + w * tz + x * ty - y * tx,
    )


def _unrotate(quaternion_xyzw: Quaternion, v: Vec3) -> Vec3:
    """Transform a vector from the world to the base frame."""
    x, y, z, w = quaternion_xyzw
    return _rotate((-x, -y, -z, w), v)


class Carter:
    """The robot's body in one physics client (a `sim_hil.robots.interface.Robot`)."""

    radius_m = RADIUS_M

    def __init__(
        self, client: int, folder: Path, start: Vec3, dt_s: float, *, calibration: WheelCalibration | None = None
    ) -> None:
        """Load the robot. `start`: x m, y m, heading rad; `calibration`: wheel dimensions assumed by odometry."""
        self._client = client
        self._dt_s = dt_s
        self.body = pybullet.loadURDF(
            str(write_carter_urdf(folder)),
            (start[0], start[1], 0.0),
            pybullet.getQuaternionFromEuler((0, 0, start[2])),
            # Round wheels: without the flag a cylinder becomes a prism, and its edges hammer the tyres off the floor.
            flags=pybullet.URDF_USE_INERTIA_FROM_FILE | pybullet.URDF_USE_IMPLICIT_CYLINDER,
            physicsClientId=client,
        )
        links = {
            pybullet.getJointInfo(self.body, link, physicsClientId=client)[12].decode(): link
            for link in range(pybullet.getNumJoints(self.body, physicsClientId=client))
        }
        self._wheels = [links[LINKS[0]], links[LINKS[1]]]
        self.controller = DriveController(dt_s)
        self._odometry = WheelOdometry(calibration)
        self._battery = CarterBattery()
        pybullet.setJointMotorControlArray(
            self.body, self._wheels, pybullet.VELOCITY_CONTROL, forces=[WHEEL_FRICTION_NM] * 2, physicsClientId=client
        )
        pybullet.changeDynamics(self.body, -1, linearDamping=0.0, angularDamping=0.0, physicsClientId=client)
        # In a call of its own: beside a damping, PyBullet gives the base the friction that is meant for the link.
        for link in range(-1, len(LINKS)):
            grip = SHELL_GRIP if link < 0 else TYRE_GRIP if link in self._wheels else CASTER_GRIP
            pybullet.changeDynamics(self.body, link, lateralFriction=grip, physicsClientId=client)
        self._torques = (0.0, 0.0)
        self._imu_steps = max(1, round(_IMU_S / dt_s))
        self._imu_share = 1.0 - exp(-2 * pi * _IMU_CORNER_HZ * self._imu_steps * dt_s)
        self._accel: Vec3 = (0.0, 0.0, GRAVITY_MPS2)
        self._bumped_steps = dict.fromkeys(("front", "rear", "left", "right"), -(10**9))
        self._steps = 0
        self._base: tuple[Vec3, Quaternion, Vec3, Vec3] | None = None
        self._read_wheels()
        self._last_velocity = self._read_base()[2]

    def _read_wheels(self) -> None:
        left, right = pybullet.getJointStates(self.body, self._wheels, physicsClientId=self._client)
        self._q = (left[0], right[0])
        self._dq = (left[1], right[1])

    def _read_base(self) -> tuple[Vec3, Quaternion, Vec3, Vec3]:
        """Position, quaternion xyzw, velocity and angular velocity of the base frame; read once a step, if at all."""
        if self._base is None:
            (x, y, z), quaternion = pybullet.getBasePositionAndOrientation(self.body, physicsClientId=self._client)
            (vx, vy, vz), angular = pybullet.getBaseVelocity(self.body, physicsClientId=self._client)
            # PyBullet's pose is that of the base's centre of mass.
            ax, ay, az = _rotate(quaternion, BODY_COM_M)
            wx, wy, wz = angular
            velocity = (vx - (wy * az - wz * ay), vy - (wz * ax - wx * az), vz - (wx * ay - wy * ax))
            self._base = ((x - ax, y - ay, z - az), quaternion, velocity, angular)
        return self._base

    @property
    def ready(self) -> bool:
        """Whether the base would follow a velocity command now."""
        return self.controller.ready

    def drive(self) -> None:
        """Set the wheel torques for the next step."""
        self._torques = self.controller.step(*self._dq)
        pybullet.setJointMotorControlArray(
            self.body, self._wheels, pybullet.TORQUE_CONTROL, forces=self._torques, physicsClientId=self._client
        )

    def observe(self) -> None:
        """Read the wheels after a step; accelerometer and bumpers every 10 ms."""
        self._base = None
        self._read_wheels()
        self._odometry.step(*self._q)
        self._battery.draw(load_w(self._torques[0], self._dq[0], self._torques[1], self._dq[1]), self._dt_s)
        self._steps += 1
        if self._steps % self._imu_steps == 0:
            self._feel()

    def _feel(self) -> None:
        _, quaternion, velocity, _ = self._read_base()
        last, self._last_velocity = self._last_velocity, velocity
        time_s = self._imu_steps * self._dt_s
        ax, ay, az = ((now - before) / time_s for now, before in zip(velocity, last, strict=True))
        felt = _unrotate(quaternion, (ax, ay, az + GRAVITY_MPS2))
        share, (bx, by, bz) = self._imu_share, self._accel
        self._accel = (bx + share * (felt[0] - bx), by + share * (felt[1] - by), bz + share * (felt[2] - bz))
        # Only the shell: tyres and casters touch the floor all the time.
        for contact in pybullet.getContactPoints(bodyA=self.body, linkIndexA=-1, physicsClientId=self._client):
            if contact[9] >= _MIN_BUMP_N:
                self._bump(_unrotate(quaternion, contact[7]))

    def _bump(self, normal: Vec3) -> None:
        """Register a push along `normal` in the base frame; pushes from below do not trigger a bumper."""
        x, y, z = normal
        if abs(z) > max(abs(x), abs(y)):
            return
        side = ("front" if x < 0 else "rear") if abs(x) > abs(y) else ("left" if y < 0 else "right")
        self._bumped_steps[side] = self._steps

    def bumpers(self) -> Bumpers:
        """Return the sides of the shell that were pushed within the last 0.2 s."""
        since = self._steps - round(_BUMPER_HOLD_S / self._dt_s)
        return Bumpers(**{side: step > since for side, step in self._bumped_steps.items()})

    def pose(self) -> tuple[tuple[float, float, float], float]:
        """Base position, m, and heading, rad."""
        position, (x, y, z, w), _, _ = self._read_base()
        heading = atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return position, heading

    def up(self) -> float:
        """World z of the base's up axis."""
        x, y, _, _ = self._read_base()[1]
        return 1 - 2 * (x * x + y * y)

    def command(self, vx_mps: float, vy_mps: float, wz_radps: float) -> None:
        """Command a velocity, valid for 1 s; `vy` is ignored. Raises ValueError for a non-finite number."""
        self.controller.command(vx_mps, wz_radps)

    def stand(self) -> None:
        """Power the drive on; an emergency stop must be released first."""
        self.controller.powered = not self.controller.estop

    def rest(self) -> None:
        """Brake and power the drive off; commands are ignored until `stand`."""
        self.controller.powered = False

    def press_estop(self) -> None:
        """Brake at full torque until `release_estop`; afterwards the drive is off."""
        self.controller.estop = True
        self.controller.powered = False

    def release_estop(self) -> None:
        """Allow `stand` to power the drive again."""
        self.controller.estop = False

    def odometry(self) -> OdometrySample:
        """Current wheel odometry."""
        return self._odometry.sample(*self._dq)

    def truth(self, time_s: float) -> CarterTruth:
        """Return the current ground truth, stamped `time_s`."""
        position, quaternion, velocity, angular = self._read_base()
        x, y, z, w = quaternion
        pitch = asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
        roll = atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        v, wz = self.controller.commanded
        return CarterTruth(
            time_s=time_s,
            position_m=np.array(position),
            quaternion_wxyz=np.array((w, x, y, z)),
            rpy_rad=np.array((roll, pitch, self.pose()[1])),
            velocity_world_mps=np.array(velocity),
            gyro_radps=np.array(_unrotate(quaternion, angular)),
            accel_mps2=np.array(self._accel),
            commanded=(v, 0.0, wz),
            wheel_q_rad=self._q,
            wheel_dq_radps=self._dq,
            wheel_tau_nm=self._torques,
            odometry=self.odometry(),
            battery=self._battery.read(),
            bumpers=self.bumpers(),
            powered=self.controller.powered,
            estop=self.controller.estop,
            saturated=self.controller.saturated,
        )

    def render_state(self) -> tuple[float, ...]:
        """Base position m, quaternion xyzw, left and right wheel's angle."""
        position, quaternion, _, _ = self._read_base()
        return (*position, *quaternion, *self._q)
