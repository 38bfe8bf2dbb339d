"""The Go2 in PyBullet: loads the body, reads it, applies torques; the behaviour is in sim_hil/sport.py."""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, cos, sin
from pathlib import Path

import numpy as np
import pybullet
from numpy.typing import NDArray

from sim_hil.gait import GRAVITY_MPS2, BodyMotion
from sim_hil.go2_urdf import BASE_COM_M, JOINT_FRICTION_NM, JOINT_NAMES, LEGS, write_go2_urdf
from sim_hil.kinematics import Vec3, foot_position, foot_velocity
from sim_hil.robot import BaseTruth
from sim_hil.sport import LYING_RAD, Measured, SportAction, SportController

Array = NDArray[np.float64]
LYING_HEIGHT_M = 0.075
# From the table of sim_hil/go2_urdf.py: the head's corner, and a foot in mid-stride, reach this far from the origin.
RADIUS_M = 0.33
HALF_LENGTH_M = 0.345
RENDER_FIELDS = 19


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


def _cross(a: Vec3, b: Vec3) -> Vec3:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _rotate(quaternion_xyzw: tuple[float, float, float, float], v: Vec3) -> Vec3:
    x, y, z, w = quaternion_xyzw
    t = _cross((x, y, z), v)
    t = (2 * t[0], 2 * t[1], 2 * t[2])
    u = _cross((x, y, z), t)
    return (v[0] + w * t[0] + u[0], v[1] + w * t[1] + u[1], v[2] + w * t[2] + u[2])


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


def load_go2(client: int, folder: Path, position: tuple[float, float, float], yaw_rad: float) -> tuple[int, list[int]]:
    """Load the URDF into `client`; return the body id and the 12 joint indices in JOINT_NAMES' order."""
    path = write_go2_urdf(folder)
    body = pybullet.loadURDF(
        str(path),
        position,
        pybullet.getQuaternionFromEuler((0, 0, yaw_rad)),
        flags=pybullet.URDF_USE_INERTIA_FROM_FILE,
        physicsClientId=client,
    )
    index = {}
    for joint in range(pybullet.getNumJoints(body, physicsClientId=client)):
        index[pybullet.getJointInfo(body, joint, physicsClientId=client)[1].decode()] = joint
    for name, angle in zip(JOINT_NAMES, LYING_RAD, strict=True):
        pybullet.resetJointState(body, index[name], angle, physicsClientId=client)
    return body, [index[name] for name in JOINT_NAMES]


class Go2:
    """The robot's body in one physics client; implements sim_hil.robot.Robot."""

    radius_m = RADIUS_M
    half_length_m = HALF_LENGTH_M
    render_fields = RENDER_FIELDS

    def __init__(self, client: int, folder: Path, start: tuple[float, float, float], dt_s: float) -> None:
        self._client = client
        self._dt_s = dt_s
        self.body, self._joints = load_go2(client, folder, (start[0], start[1], LYING_HEIGHT_M), start[2])
        self.sport = SportController(dt_s)
        links = pybullet.getNumJoints(self.body, physicsClientId=client)
        names = {
            pybullet.getJointInfo(self.body, link, physicsClientId=client)[1].decode(): link for link in range(links)
        }
        self._feet = [names[f"{leg}_foot"] for leg in LEGS]
        # PyBullet drives every joint with a velocity motor by default; as weak as this it is the joint's dry friction.
        friction = [JOINT_FRICTION_NM] * 12
        pybullet.setJointMotorControlArray(
            self.body, self._joints, pybullet.VELOCITY_CONTROL, forces=friction, physicsClientId=client
        )
        for link in range(-1, links):
            grip = 0.9 if link in self._feet else 0.4
            pybullet.changeDynamics(
                self.body, link, lateralFriction=grip, linearDamping=0.0, angularDamping=0.0,
                physicsClientId=client,
            )  # fmt: skip
        self._torques: tuple[float, ...] = (0.0,) * 12
        self._accel = np.array((0.0, 0.0, GRAVITY_MPS2))
        self._last_velocity = np.zeros(3)
        self._read()

    def _read(self) -> None:
        states = pybullet.getJointStates(self.body, self._joints, physicsClientId=self._client)
        self._q = tuple(state[0] for state in states)
        self._dq = tuple(state[1] for state in states)
        # PyBullet speaks of the base's centre of mass; everybody else means the base frame between the hips.
        com, self._quaternion = pybullet.getBasePositionAndOrientation(self.body, physicsClientId=self._client)
        velocity, self._angular = pybullet.getBaseVelocity(self.body, physicsClientId=self._client)
        arm = _rotate(self._quaternion, BASE_COM_M)
        spin = _cross(self._angular, arm)
        self._position = (com[0] - arm[0], com[1] - arm[1], com[2] - arm[2])
        self._linear = (velocity[0] - spin[0], velocity[1] - spin[1], velocity[2] - spin[2])

    def measured(self) -> Measured:
        """What the controller sees: joints, attitude, and velocities in the level frame along the heading."""
        x, y, z, w = self._quaternion
        yaw = atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        up_x, up_y, up_z = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        c, s = cos(yaw), sin(yaw)
        vx, vy, _ = self._linear
        wx, wy, wz = self._angular
        body = BodyMotion(
            yaw_rad=yaw,
            roll_rad=atan2(up_y, up_z),
            pitch_rad=atan2(-up_x, (up_y * up_y + up_z * up_z) ** 0.5),
            roll_rate_radps=c * wx + s * wy,
            pitch_rate_radps=-s * wx + c * wy,
            yaw_rate_radps=wz,
            vx_mps=c * vx + s * vy,
            vy_mps=-s * vx + c * vy,
        )
        return Measured(self._q, self._dq, body, up_z)

    def drive(self) -> None:
        """Let the sport controller set this step's torques."""
        self._torques = self.sport.step(self.measured())
        pybullet.setJointMotorControlArray(
            self.body, self._joints, pybullet.TORQUE_CONTROL, forces=self._torques, physicsClientId=self._client
        )

    def observe(self) -> None:
        """Read the body after the step; the accelerometer is the change of velocity over it, low-passed at 40 Hz."""
        self._read()
        velocity = np.array(self._linear)
        specific = (velocity - self._last_velocity) / self._dt_s + (0.0, 0.0, GRAVITY_MPS2)
        self._last_velocity = velocity
        # Rigid contacts are impulses: the raw difference shows spikes of many g that no filtered IMU reports.
        self._accel += 0.4 * (rotation_matrix(self._quaternion).T @ specific - self._accel)

    def pose(self) -> tuple[tuple[float, float, float], float]:
        """Base position, m, and heading, rad."""
        return self._position, self.measured().body.yaw_rad

    def up(self) -> float:
        """World z of the base's up axis: 1 upright, -1 on its back."""
        x, y, _, _ = self._quaternion
        return 1.0 - 2.0 * (x * x + y * y)

    def command(self, vx_mps: float, vy_mps: float, wz_radps: float) -> None:
        """Take a velocity of the body frame, kept for 1 s; without effect unless `ready`."""
        self.sport.request_move(vx_mps, vy_mps, wz_radps)

    def stand(self) -> None:
        """Get up and balance, turning over first where it must (about 2 s from lying); may be repeated."""
        if self.sport.request(SportAction.BALANCE_STAND) != 0:
            self.sport.request(SportAction.RECOVERY_STAND)

    @property
    def ready(self) -> bool:
        """Whether it stands balanced, so that a velocity would be obeyed."""
        return self.sport.ready

    def base_and_joints(self) -> tuple[float, ...]:
        """`render_state` by its former name."""
        return self.render_state()

    def render_state(self) -> tuple[float, ...]:
        """Position, quaternion xyzw and joint angles: 19 numbers for a renderer."""
        return (*self._position, *self._quaternion, *self._q)

    def truth(self, time_s: float) -> RobotTruth:
        """Snapshot of everything the robot's services report."""
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
            gyro_radps=rotation_matrix(self._quaternion).T @ np.array(self._angular),
            accel_mps2=self._accel.copy(),
            joint_q_rad=np.array(self._q),
            joint_dq_radps=np.array(self._dq),
            joint_tau_nm=np.array(self._torques),
            foot_force_n=np.array(forces),
            foot_position_body_m=np.array([foot_position(leg, q) for leg, q, _ in legs]),
            foot_velocity_body_mps=np.array([foot_velocity(leg, q, dq) for leg, q, dq in legs]),
            mode=self.sport.mode,
            gait_type=self.sport.gait_type,
            body_height_m=self._position[2],
            commanded=self.sport.commanded,
        )


def place_go2(client: int, body: int, joints: list[int], state: Array) -> None:
    """Put a loaded Go2 into the pose of a render state (base frame, not centre of mass; then the joints)."""
    position, quaternion = tuple(float(v) for v in state[:3]), tuple(float(v) for v in state[3:7])
    arm = rotation_matrix(quaternion) @ BASE_COM_M
    centre = [position[axis] + float(arm[axis]) for axis in range(3)]
    pybullet.resetBasePositionAndOrientation(body, centre, quaternion, physicsClientId=client)
    for joint, angle in zip(joints, state[7:19], strict=True):
        pybullet.resetJointState(body, joint, float(angle), physicsClientId=client)
