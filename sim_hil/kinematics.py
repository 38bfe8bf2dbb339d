"""Closed-form leg kinematics of the Go2: forward, inverse and the Jacobian, one leg at a time.

Plain floats instead of arrays: a leg has three numbers, and this runs four times in every 2 ms step.
"""

from __future__ import annotations

from math import acos, atan2, cos, sin, sqrt

from sim_hil.go2_urdf import CALF_LENGTH_M, CALF_LIMITS_RAD, LEG_GEOMETRY, THIGH_LENGTH_M, THIGH_Y_M

Vec3 = tuple[float, float, float]

# Hip-to-foot distance that the calf's limits allow; both segments have the same length, hence the half-angle.
_REACH_MIN_M, _REACH_MAX_M = (2 * THIGH_LENGTH_M * cos(limit / 2) for limit in CALF_LIMITS_RAD)


def foot_position(leg: int, q: Vec3) -> Vec3:
    """Foot centre in the base frame, m, of leg 0..3 (FR, FL, RR, RL) at joint angles q, rad."""
    geometry = LEG_GEOMETRY[leg]
    hip_x, hip_y = geometry.hip_m
    side = THIGH_Y_M * geometry.left
    x = -THIGH_LENGTH_M * sin(q[1]) - CALF_LENGTH_M * sin(q[1] + q[2])
    z = -THIGH_LENGTH_M * cos(q[1]) - CALF_LENGTH_M * cos(q[1] + q[2])
    s, c = sin(q[0]), cos(q[0])
    return (hip_x + x, hip_y + side * c - z * s, side * s + z * c)


def joint_angles(leg: int, foot: Vec3) -> Vec3:
    """Joint angles, rad, that put the foot centre at `foot` (base frame, m).

    A target out of reach is replaced by the nearest one the leg's length allows, in the same direction.
    """
    geometry = LEG_GEOMETRY[leg]
    hip_x, hip_y = geometry.hip_m
    side = THIGH_Y_M * geometry.left
    x, y, z = foot[0] - hip_x, foot[1] - hip_y, foot[2]
    drop = -sqrt(max(y * y + z * z - side * side, 1e-6))
    hip = atan2(z, y) - atan2(drop, side)
    if hip > 3.141592653589793:
        hip -= 6.283185307179586
    elif hip < -3.141592653589793:
        hip += 6.283185307179586
    reach = sqrt(x * x + drop * drop)
    reach = min(max(reach, _REACH_MIN_M), _REACH_MAX_M)
    cosine = (reach * reach - THIGH_LENGTH_M**2 - CALF_LENGTH_M**2) / (2 * THIGH_LENGTH_M * CALF_LENGTH_M)
    calf = -acos(min(max(cosine, -1.0), 1.0))
    thigh = atan2(-x, -drop) - atan2(CALF_LENGTH_M * sin(calf), THIGH_LENGTH_M + CALF_LENGTH_M * cos(calf))
    return (hip, thigh, calf)


def jacobian(leg: int, q: Vec3) -> tuple[Vec3, Vec3, Vec3]:
    """Rows d(x, y, z)/d(hip, thigh, calf) of the foot position in the base frame, m/rad."""
    side = THIGH_Y_M * LEG_GEOMETRY[leg].left
    both = q[1] + q[2]
    calf_x, calf_z = -CALF_LENGTH_M * sin(both), -CALF_LENGTH_M * cos(both)
    x = -THIGH_LENGTH_M * sin(q[1]) + calf_x
    drop = -THIGH_LENGTH_M * cos(q[1]) + calf_z
    s, c = sin(q[0]), cos(q[0])
    return (
        (0.0, drop, calf_z),
        (-side * s - drop * c, x * s, calf_x * s),
        (side * c - drop * s, -x * c, -calf_x * c),
    )


def foot_velocity(leg: int, q: Vec3, dq: Vec3) -> Vec3:
    """Foot velocity relative to the base, base frame, m/s."""
    rows = jacobian(leg, q)
    return tuple(r[0] * dq[0] + r[1] * dq[1] + r[2] * dq[2] for r in rows)  # type: ignore[return-value]


def joint_torque(leg: int, q: Vec3, force: Vec3) -> Vec3:
    """Joint torques, N.m, with which the foot pushes on the world with `force` (base frame, N): the transposed map."""
    rx, ry, rz = jacobian(leg, q)
    fx, fy, fz = force
    return (
        rx[0] * fx + ry[0] * fy + rz[0] * fz,
        rx[1] * fx + ry[1] * fy + rz[1] * fz,
        rx[2] * fx + ry[2] * fy + rz[2] * fz,
    )
