"""Go2 in PyBullet: loads the body, reads its state, applies torques; sim_hil/robots/go2/sport.py has the behaviour."""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, exp, pi, sqrt
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim_hil.robots.bullet import pybullet
from sim_hil.robots.go2.gait import GRAVITY_MPS2, BodyMotion
from sim_hil.robots.go2.kinematics import Vec3, foot_position, foot_velocity
from sim_hil.robots.go2.sport import LYING_RAD, Measured, SportAction, SportController
from sim_hil.robots.go2.urdf import BASE_COM_M, IMU_M, JOINT_FRICTION_NM, JOINT_NAMES, LEGS, write_go2_urdf
from sim_hil.robots.interface import BaseTruth

Array = NDArray[np.float64]
LYING_HEIGHT_M = 0.075
# From the table of sim_hil/robots/go2/urdf.py: the head's corner, and a foot in mid-stride, reach this far from the
# origin.
RADIUS_M = 0.33
HALF_LENGTH_M = 0.36
RENDER_FIELDS = 19
ACCEL_CUTOFF_HZ = 40.0  # our choice
FOOT_GRIP, SHELL_GRIP = 0.9, 0.4  # our choice: rubber feet, hard plastic everywhere else
# A moving joint's dry friction, as a torque: rises over this range of speed instead of at once.
_FRICTION_FULL_RADPS = 0.2
_FRICTION_SLOPE = JOINT_FRICTION_NM / _FRICTION_FULL_RADPS


@dataclass(frozen=True)
class RobotTruth(BaseTruth):
    """Ground truth of one instant of the Go2; joints in the order FR, FL, RR, RL x hip, thigh, calf.

    Feet are relative to the base in the body frame; mode and gait_type are SportModeState's numbers.
    """

    joint_q_rad: Array
    joint_dq_radps: Array
    joint_tau_nm: Array
    foot_force_n: Array
    foot_position_body_m: Array
    foot_velocity_body_mps: Array
    mode: int
    gait_type: int
    body_height_m: float


def rotation_matrix(quaternion_xyzw: tuple[float, ...]) -> Array:
    """Rotation matrix [3, 3] body -> world of a PyBullet quaternion."""
    x, y, z, w = quaternion_xyzw
    return np.array(
        (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
    )


class Go2:
    """The robot's body in one physics client; implements sim_hil.robots.interface.Robot.

    The envelope holds with steps of 1/500 and 1/480 s; with 1/240 s the trot tracks up to 1 m/s, and topples now and
    then when it is thrown about at 1.5 m/s (tools/bench/locomotion.py).
    """

    radius_m = RADIUS_M
    _forward: Vec3  # the base's x and z axes in the world
    _upward: Vec3

    def __init__(self, client: int, folder: Path, start: tuple[float, float, float], dt_s: float) -> None:
        self._client = client
        self._dt_s = dt_s
        self.body = pybullet.loadURDF(
            str(write_go2_urdf(folder)),
            (start[0], start[1], LYING_HEIGHT_M),
            pybullet.getQuaternionFromEuler((0, 0, start[2])),
            flags=pybullet.URDF_USE_INERTIA_FROM_FILE,
            physicsClientId=client,
        )
        links = pybullet.getNumJoints(self.body, physicsClientId=client)
        names = {
            pybullet.getJointInfo(self.body, link, physicsClientId=client)[1].decode(): link for link in range(links)
        }
        self._joints = [names[name] for name in JOINT_NAMES]
        for joint, angle in zip(self._joints, LYING_RAD, strict=True):
            pybullet.resetJointState(self.body, joint, angle, physicsClientId=client)
        self.sport = SportController(dt_s)
        self._feet = [names[f"{leg}_foot"] for leg in LEGS]
        self._set_friction(JOINT_FRICTION_NM)
        self._trotting = False
        pybullet.changeDynamics(self.body, -1, linearDamping=0.0, angularDamping=0.0, physicsClientId=client)
        # In a call of its own: beside a damping, PyBullet gives the base the friction that is meant for the link.
        for link in range(-1, links):
            grip = FOOT_GRIP if link in self._feet else SHELL_GRIP
            pybullet.changeDynamics(self.body, link, lateralFriction=grip, physicsClientId=client)
        self.torques_nm: tuple[float, ...] = (0.0,) * 12  # of the latest step
        self._accel: Vec3 = (0.0, 0.0, GRAVITY_MPS2)
        self._accel_blend = 1.0 - exp(-2.0 * pi * ACCEL_CUTOFF_HZ * dt_s)
        self._read()
        self._last_imu_velocity = self._imu_velocity()

    def _set_friction(self, friction_nm: float) -> None:
        # PyBullet drives every joint with a velocity motor by default; as weak as this it is the joint's dry friction.
        pybullet.setJointMotorControlArray(
            self.body, self._joints, pybullet.VELOCITY_CONTROL, forces=[friction_nm] * 12, physicsClientId=self._client
        )

    def _read(self) -> None:
        client = self._client
        states = pybullet.getJointStates(self.body, self._joints, physicsClientId=client)
        self._q = tuple([state[0] for state in states])
        self._dq = tuple([state[1] for state in states])
        # PyBullet's pose is that of the base's centre of mass; here the base frame lies between the hips.
        com, self._quaternion = pybullet.getBasePositionAndOrientation(self.body, physicsClientId=client)
        velocity, self._angular = pybullet.getBaseVelocity(self.body, physicsClientId=client)
        x, y, z, w = self._quaternion
        self._forward = fx, fy, fz = (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y))
        self._upward = ux, uy, uz = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
        forward, _, upward = BASE_COM_M
        ax, ay, az = forward * fx + upward * ux, forward * fy + upward * uy, forward * fz + upward * uz
        wx, wy, wz = self._angular
        self._position = (com[0] - ax, com[1] - ay, com[2] - az)
        self._linear = (
            velocity[0] - wy * az + wz * ay,
            velocity[1] - wz * ax + wx * az,
            velocity[2] - wx * ay + wy * ax,
        )
        self._measured: Measured | None = None

    def _imu_velocity(self) -> Vec3:
        fx, fy, fz = self._forward
        ux, uy, uz = self._upward
        forward, _, upward = IMU_M
        ax, ay, az = forward * fx + upward * ux, forward * fy + upward * uy, forward * fz + upward * uz
        vx, vy, vz = self._linear
        wx, wy, wz = self._angular
        return (vx + wy * az - wz * ay, vy + wz * ax - wx * az, vz + wx * ay - wy * ax)

    def measured(self) -> Measured:
        """Inputs of the controller: joints, attitude, and velocities in the level frame along the heading."""
        if self._measured is not None:
            return self._measured
        fx, fy, fz = self._forward
        ux, uy, up = self._upward
        across = sqrt(fx * fx + fy * fy)
        c, s = (fx / across, fy / across) if across > 1e-9 else (1.0, 0.0)
        # The left axis' rise, from forward and up: left = up x forward.
        left_z = ux * fy - uy * fx
        vx, vy, _ = self._linear
        wx, wy, wz = self._angular
        body = BodyMotion(
            atan2(fy, fx),
            atan2(left_z, up),
            atan2(-fz, sqrt(left_z * left_z + up * up)),
            c * wx + s * wy,
            -s * wx + c * wy,
            wz,
            c * vx + s * vy,
            -s * vx + c * vy,
        )
        self._measured = Measured(self._q, self._dq, body, up)
        return self._measured

    def drive(self) -> None:
        """Apply the sport controller's torques for this step."""
        sport = self.sport
        self.torques_nm = forces = sport.step(self.measured())
        if sport.trotting != self._trotting:
            self._trotting = sport.trotting
            self._set_friction(0.0 if self._trotting else JOINT_FRICTION_NM)
        if self._trotting:
            # At rest the engine holds the joints by their dry friction, which doubles the price of a step. A trotting
            # joint hardly ever rests: there the friction is a torque against its motion.
            forces = tuple(
                [
                    torque
                    - (
                        JOINT_FRICTION_NM
                        if speed > _FRICTION_FULL_RADPS
                        else -JOINT_FRICTION_NM
                        if speed < -_FRICTION_FULL_RADPS
                        else speed * _FRICTION_SLOPE
                    )
                    for torque, speed in zip(forces, self._dq, strict=True)
                ]
            )
        pybullet.setJointMotorControlArray(
            self.body, self._joints, pybullet.TORQUE_CONTROL, forces=forces, physicsClientId=self._client
        )

    def observe(self) -> None:
        """Read the body after the step; accelerometer: change of velocity, low-pass filtered at 40 Hz."""
        self._read()
        vx, vy, vz = velocity = self._imu_velocity()
        was_x, was_y, was_z = self._last_imu_velocity
        self._last_imu_velocity = velocity
        dt_s = self._dt_s
        raw = self._to_body(((vx - was_x) / dt_s, (vy - was_y) / dt_s, (vz - was_z) / dt_s + GRAVITY_MPS2))
        # Rigid contacts are impulses: the raw difference shows spikes of many g that no filtered IMU reports.
        blend = self._accel_blend
        x, y, z = self._accel
        self._accel = (x + blend * (raw[0] - x), y + blend * (raw[1] - y), z + blend * (raw[2] - z))

    def _to_body(self, world: Vec3) -> Vec3:
        """A vector of the world in the base frame, whose y axis is z cross x."""
        x, y, z = world
        fx, fy, fz = self._forward
        ux, uy, uz = self._upward
        return (
            fx * x + fy * y + fz * z,
            (uy * fz - uz * fy) * x + (uz * fx - ux * fz) * y + (ux * fy - uy * fx) * z,
            ux * x + uy * y + uz * z,
        )

    def pose(self) -> tuple[tuple[float, float, float], float]:
        """Base position, m, and heading, rad."""
        return self._position, self.measured().body.yaw_rad

    def up(self) -> float:
        """World z of the base's up axis: 1 upright, -1 on its back."""
        return self._upward[2]

    def command(self, vx_mps: float, vy_mps: float, wz_radps: float) -> None:
        """Command a velocity in the body frame, valid for 1 s; ignored unless `ready`."""
        self.sport.request_move(vx_mps, vy_mps, wz_radps)

    def stand(self) -> None:
        """Stand up and balance, turning over first if necessary (about 2 s from lying); may be repeated."""
        if self.sport.request(SportAction.BALANCE_STAND) != 0:
            self.sport.request(SportAction.RECOVERY_STAND)

    @property
    def ready(self) -> bool:
        """Whether the robot stands balanced and would obey a velocity."""
        return self.sport.ready

    def render_state(self) -> tuple[float, ...]:
        """Position, quaternion xyzw and joint angles: 19 numbers for a renderer."""
        return (*self._position, *self._quaternion, *self._q)

    def truth(self, time_s: float) -> RobotTruth:
        """Return the ground truth that the robot's services report."""
        measured = self.measured()
        forces = [0.0] * 4
        for contact in pybullet.getContactPoints(bodyA=self.body, physicsClientId=self._client):
            if contact[3] in self._feet:
                forces[self._feet.index(contact[3])] += contact[9]
        legs = [(leg, self._q[3 * leg : 3 * leg + 3], self._dq[3 * leg : 3 * leg + 3]) for leg in range(4)]
        x, y, z, w = self._quaternion
        body = measured.body
        return RobotTruth(
            time_s=time_s,
            position_m=np.array(self._position),
            quaternion_wxyz=np.array((w, x, y, z)),
            rpy_rad=np.array((body.roll_rad, body.pitch_rad, body.yaw_rad)),
            velocity_world_mps=np.array(self._linear),
            gyro_radps=np.array(self._to_body(self._angular)),
            accel_mps2=np.array(self._accel),
            joint_q_rad=np.array(self._q),
            joint_dq_radps=np.array(self._dq),
            joint_tau_nm=np.array(self.torques_nm),
            foot_force_n=np.array(forces),
            foot_position_body_m=np.array([foot_position(leg, q) for leg, q, _ in legs]),
            foot_velocity_body_mps=np.array([foot_velocity(leg, q, dq) for leg, q, dq in legs]),
            mode=self.sport.mode,
            gait_type=self.sport.gait_type,
            body_height_m=self._position[2],
            commanded=self.sport.commanded,
        )
