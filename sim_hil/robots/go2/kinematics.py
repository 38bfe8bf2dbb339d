"""Closed-form leg kinematics of the Go2: forward, inverse and the Jacobian, one leg at a time.

Plain floats instead of arrays: a leg has three numbers, and this runs four times in every 2 ms step.
"""

from __future__ import annotations

from math import acos, atan2, cos, pi, sin, sqrt

from sim_hil.robots.go2.urdf import CALF_LENGTH_M, CALF_LIMITS_RAD, LEG_GEOMETRY, THIGH_LENGTH_M, THIGH_Y_M

Vec3 = tuple[float, float, float]

# Hip-to-foot distance that the calf's limits allow; both segments have the same length, hence the half-angle.
_REACH_MIN_M, _REACH_MAX_M = (2 * THIGH_LENGTH_M * cos(limit / 2) for limit in CALF_LIMITS_RAD)
# Per leg: hip joint x and y in the base frame, and the thigh joint sideways of it; m.
_HIPS = tuple((*geometry.hip_m, THIGH_Y_M * geometry.left) for geometry in LEG_GEOMETRY)
_SIDE2_M2 = THIGH_Y_M * THIGH_Y_M
_PER_BOTH = 0.5 / THIGH_LENGTH_M


def foot_position(leg: int, q: Vec3) -> Vec3:
    """Foot centre in the base frame, m, of leg 0..3 (FR, FL, RR, RL) at joint angles q, rad."""
    hip_x, hip_y, side = _HIPS[leg]
    x = -THIGH_LENGTH_M * sin(q[1]) - CALF_LENGTH_M * sin(q[1] + q[2])
    z = -THIGH_LENGTH_M * cos(q[1]) - CALF_LENGTH_M * cos(q[1] + q[2])
    s, c = sin(q[0]), cos(q[0])
    return (hip_x + x, hip_y + side * c - z * s, side * s + z * c)


def joint_angles(leg: int, foot: Vec3) -> Vec3:
    """Joint angles, rad, that put the foot centre at `foot` (base frame, m).

    A target out of reach is replaced by the nearest one the leg's length allows, in the same direction.
    """
    hip_x, hip_y, side = _HIPS[leg]
    x, y, z = foot[0] - hip_x, foot[1] - hip_y, foot[2]
    drop2 = y * y + z * z - _SIDE2_M2
    drop = sqrt(drop2) if drop2 > 1e-6 else 1e-3
    hip = atan2(z, y) - atan2(-drop, side)
    if hip > pi:
        hip -= 2 * pi
    elif hip < -pi:
        hip += 2 * pi
    reach = sqrt(x * x + drop * drop)
    reach = _REACH_MIN_M if reach < _REACH_MIN_M else _REACH_MAX_M if reach > _REACH_MAX_M else reach
    # Thigh and calf are equally long: the knee's triangle has two equal angles, each half of the calf's.
    half = acos(reach * _PER_BOTH)
    return (hip, atan2(-x, drop) + half, -2.0 * half)


def jacobian(leg: int, q: Vec3) -> tuple[Vec3, Vec3, Vec3]:
    """Rows d(x, y, z)/d(hip, thigh, calf) of the foot position in the base frame, m/rad."""
    side = _HIPS[leg][2]
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
    x, y, z = (r[0] * dq[0] + r[1] * dq[1] + r[2] * dq[2] for r in rows)
    return x, y, z


def joint_torque(leg: int, q: Vec3, force: Vec3) -> Vec3:
    """Joint torques, N.m, with which the foot pushes on the world with `force` (base frame, N): the transposed map."""
    hip, thigh, calf = q
    fx, fy, fz = force
    side = _HIPS[leg][2]
    both = thigh + calf
    calf_x, calf_z = -CALF_LENGTH_M * sin(both), -CALF_LENGTH_M * cos(both)
    x, drop = calf_x - THIGH_LENGTH_M * sin(thigh), calf_z - THIGH_LENGTH_M * cos(thigh)
    s, c = sin(hip), cos(hip)
    # The columns of `jacobian` times the force, with what they share computed once.
    along, across = fy * s - fz * c, fy * c + fz * s
    return (
        side * (fz * c - fy * s) - drop * across,
        fx * drop + x * along,
        fx * calf_z + calf_x * along,
    )
