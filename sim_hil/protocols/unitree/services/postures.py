"""Postures and shows of a standing Go2 as joint angles over time: sit, stretch, hello, dance, attitudes. Pure.

The feet stay in place; the body moves over them, and the leg angles follow by inverse kinematics.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from math import cos, sin
from types import MappingProxyType
from typing import Final, NamedTuple

from sim_hil.robots.go2.gait import GaitConfig
from sim_hil.robots.go2.kinematics import Vec3, joint_angles

Joints = tuple[float, ...]
Keyframe = tuple[float, Joints]  # duration to reach it, s; 12 joint angles, rad

MODE_POSE: Final = 2
MODE_SIT: Final = 10
# Limits of the maker's Euler request, rad.
ROLL_LIMIT_RAD: Final = 0.75
PITCH_LIMIT_RAD: Final = 0.75
YAW_LIMIT_RAD: Final = 0.6
_FR: Final = 0


class Script(NamedTuple):
    """Motion by keyframes; `mode`: reported meanwhile; `stays`: keep the last keyframe until another request."""

    keyframes: tuple[Keyframe, ...]
    mode: int
    stays: bool = False


def _rotated_back(vector: Vec3, roll: float, pitch: float, yaw: float) -> Vec3:
    """Express a level vector in the frame of a body rotated by yaw, then pitch, then roll."""
    x, y, z = vector
    x, y = cos(yaw) * x + sin(yaw) * y, cos(yaw) * y - sin(yaw) * x
    x, z = cos(pitch) * x - sin(pitch) * z, sin(pitch) * x + cos(pitch) * z
    return (x, cos(roll) * y + sin(roll) * z, cos(roll) * z - sin(roll) * y)


def body_over_feet(
    roll: float = 0.0,
    pitch: float = 0.0,
    yaw: float = 0.0,
    shift_m: Vec3 = (0.0, 0.0, 0.0),
    lifted: Mapping[int, Vec3] = MappingProxyType({}),
) -> Joints:
    """Return the joint angles for a body rotated (rad, positive pitch: nose down) and shifted over fixed feet.

    `lifted`: offset of a foot (0..3 = FR, FL, RR, RL) from its place on the ground, level frame, m.
    """
    angles: list[float] = []
    for leg, (x, y, z) in enumerate(GaitConfig().home):
        dx, dy, dz = lifted.get(leg, (0.0, 0.0, 0.0))
        level = (x + dx - shift_m[0], y + dy - shift_m[1], z + dz - shift_m[2])
        angles += joint_angles(leg, _rotated_back(level, roll, pitch, yaw))
    return tuple(angles)


STANDING: Final = body_over_feet()


def attitude(roll: float, pitch: float, yaw: float) -> Script:
    """Return the posture of an Euler request, clipped to its limits."""

    def within(value: float, limit: float) -> float:
        return max(-limit, min(limit, value))

    turned = body_over_feet(within(roll, ROLL_LIMIT_RAD), within(pitch, PITCH_LIMIT_RAD), within(yaw, YAW_LIMIT_RAD))
    return Script(((0.5, turned),), mode=1, stays=True)


def _hello() -> Script:
    leaning = partial(body_over_feet, pitch=-0.15, shift_m=(-0.07, 0.05, 0.0))
    raised = (0.08, -0.02, 0.20)
    out, back = (0.10, -0.14, 0.22), (0.10, 0.06, 0.22)
    waves = tuple((0.3, leaning(lifted={_FR: foot})) for foot in (out, back) * 3)
    lean = (0.6, leaning())
    lift = (0.5, leaning(lifted={_FR: raised}))
    return Script((lean, lift, *waves, lift, lean, (0.6, STANDING)), MODE_POSE)


def _swaying(*bodies: Joints, seconds: float) -> Script:
    return Script((*((seconds, body) for body in bodies), (0.6, STANDING)), MODE_POSE)


SIT: Final = Script(((1.2, body_over_feet(pitch=-0.5, shift_m=(-0.02, 0.0, -0.07))),), MODE_SIT, stays=True)
POSE: Final = Script(((0.4, STANDING),), MODE_POSE, stays=True)
SHOWS: Final[Mapping[str, Script]] = MappingProxyType(
    {
        "Hello": _hello(),
        "Stretch": Script(
            (
                (1.0, body_over_feet(pitch=0.42, shift_m=(-0.06, 0.0, -0.05))),
                (0.8, body_over_feet(pitch=0.42, shift_m=(-0.06, 0.0, -0.05))),
                (1.0, body_over_feet(pitch=-0.30, shift_m=(0.04, 0.0, -0.04))),
                (0.8, STANDING),
            ),
            MODE_POSE,
        ),
        "Content": _swaying(*(body_over_feet(yaw=sign * 0.25, roll=-sign * 0.1) for sign in (1, -1) * 3), seconds=0.3),
        "Dance1": _swaying(
            *(body_over_feet(roll=sign * 0.3, shift_m=(0.0, 0.0, -0.04 if sign > 0 else 0.0)) for sign in (1, -1) * 4),
            seconds=0.5,
        ),
        "Dance2": _swaying(
            *(body_over_feet(pitch=p, yaw=y) for p, y in ((0.25, 0.3), (-0.25, 0.3), (-0.25, -0.3), (0.25, -0.3)) * 2),
            seconds=0.45,
        ),
    }
)
