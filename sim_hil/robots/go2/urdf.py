"""The simulated Go2's body: one table of numbers, and the URDF written from it.

Inertias, geometry, limits, joint damping and joint friction are the maker's published ones (URDF and MJCF of the Go2);
the shapes are primitives of our own. PyBullet heeds neither effort nor velocity limits nor friction of a URDF's joint
that is driven by torques: the motors of sim_hil/robots/go2/sport.py keep the limits, sim_hil/robots/go2/body.py adds
the friction. The rotors' inertia (MJCF armature, 0.01 kg.m^2 a joint) is left out, as PyBullet has no such term. The
same table feeds the leg kinematics, so the model and the controller cannot drift apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sim_hil.robots.urdf import box, cylinder, inertial, shape, write_urdf, xyz

LEGS = ("FR", "FL", "RR", "RL")
JOINT_NAMES = tuple(f"{leg}_{joint}" for leg in LEGS for joint in ("hip", "thigh", "calf"))

HIP_X_M, HIP_Y_M = 0.1934, 0.0465  # hip joint in the base frame
THIGH_Y_M = 0.0955  # thigh joint sideways of the hip joint
THIGH_LENGTH_M = CALF_LENGTH_M = 0.213
FOOT_RADIUS_M = 0.022
TORQUE_LIMITS_NM = (23.7, 23.7, 45.43)
VELOCITY_LIMITS_RADPS = (30.1, 30.1, 15.7)
JOINT_DAMPING_NMS_PER_RAD, JOINT_FRICTION_NM = 0.1, 0.2
HIP_LIMITS_RAD = (-1.0472, 1.0472)
FRONT_THIGH_LIMITS_RAD = (-1.5708, 3.4907)
REAR_THIGH_LIMITS_RAD = (-0.5236, 4.5379)
CALF_LIMITS_RAD = (-2.7227, -0.83776)
BASE_COM_M = (0.021112, 0.0, -0.005366)
IMU_M = (-0.02557, 0.0, 0.04232)  # in the base frame
BASE_MASS_KG, HIP_MASS_KG, THIGH_MASS_KG, CALF_MASS_KG, FOOT_MASS_KG = 6.921, 0.678, 1.152, 0.201352, 0.04
TOTAL_MASS_KG = BASE_MASS_KG + 4 * (HIP_MASS_KG + THIGH_MASS_KG + CALF_MASS_KG + FOOT_MASS_KG)

_SILVER = "0.78 0.79 0.80 1"
_GREY = "0.33 0.34 0.36 1"
_BLACK = "0.10 0.10 0.11 1"
_LENS = "0.05 0.05 0.08 1"


@dataclass(frozen=True)
class LegGeometry:
    """Where a leg hangs on the base: +1/-1 for front/rear and left/right, and its joint limits, rad."""

    name: str
    front: int
    left: int

    @property
    def hip_m(self) -> tuple[float, float]:
        """Hip joint (x, y) in the base frame, m."""
        return (self.front * HIP_X_M, self.left * HIP_Y_M)

    @property
    def limits_rad(self) -> tuple[tuple[float, float], ...]:
        """Lower and upper limit of hip, thigh and calf."""
        thigh = FRONT_THIGH_LIMITS_RAD if self.front > 0 else REAR_THIGH_LIMITS_RAD
        return (HIP_LIMITS_RAD, thigh, CALF_LIMITS_RAD)


LEG_GEOMETRY = tuple(
    LegGeometry(name, front=1 if name[0] == "F" else -1, left=1 if name[1] == "L" else -1) for name in LEGS
)


def _base() -> str:
    quarter = 1.5708
    parts = [
        inertial(BASE_MASS_KG, BASE_COM_M, (0.02448, 0.098077, 0.107)),
        shape("visual", box(0.36, 0.10, 0.085), (0, 0, 0.0), rgba=_SILVER),
        shape("visual", box(0.30, 0.065, 0.03), (-0.02, 0, 0.052), rgba=_GREY),
        shape("visual", box(0.30, 0.085, 0.02), (0, 0, -0.05), rgba=_BLACK),
        shape("visual", cylinder(0.052, 0.10), (0.193, 0, 0), (quarter, 0, 0), _GREY),
        shape("visual", cylinder(0.052, 0.10), (-0.193, 0, 0), (quarter, 0, 0), _GREY),
        shape("visual", box(0.10, 0.085, 0.065), (0.262, 0, 0.018), rgba=_SILVER),
        shape("visual", box(0.012, 0.07, 0.045), (0.314, 0, 0.022), rgba=_LENS),
        shape("visual", '<sphere radius="0.04"/>', (0.289, 0, -0.046), rgba=_BLACK),
        shape("collision", box(0.3762, 0.0935, 0.114), (0, 0, 0)),
        # The head is what meets a wall first: without it the robot would bump with its feet.
        shape("collision", box(0.12, 0.09, 0.10), (0.262, 0, -0.005)),
    ]
    return f'<link name="base">{"".join(parts)}</link>'


def _joint(name: str, kind: str, parent: str, child: str, offset_m: tuple[float, ...], rest: str = "") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz(*offset_m)}"/>{rest}</joint>'
    )


def _motor(index: int, axis: str, limits: tuple[float, float]) -> str:
    return (
        f'<axis xyz="{axis}"/><limit lower="{limits[0]:g}" upper="{limits[1]:g}" effort="{TORQUE_LIMITS_NM[index]:g}" '
        f'velocity="{VELOCITY_LIMITS_RADPS[index]:g}"/>'
        f'<dynamics damping="{JOINT_DAMPING_NMS_PER_RAD:g}" friction="{JOINT_FRICTION_NM:g}"/>'
    )


def _leg(leg: LegGeometry) -> str:
    quarter, thigh_y = 1.5708, leg.left * THIGH_Y_M
    hip_x, hip_y = leg.hip_m
    name = leg.name
    hip = (
        inertial(HIP_MASS_KG, (-0.0054 * leg.front, 0.00194 * leg.left, -0.000105), (0.00048, 0.000884, 0.000596))
        + shape("visual", cylinder(0.046, 0.045), (0, leg.left * 0.058, 0), (quarter, 0, 0), _SILVER)
        + shape("visual", cylinder(0.036, 0.05), (leg.front * 0.03, leg.left * 0.01, 0), (0, quarter, 0), _BLACK)
        + shape("collision", cylinder(0.046, 0.04), (0, leg.left * 0.08, 0), (quarter, 0, 0))
    )
    thigh = (
        inertial(THIGH_MASS_KG, (-0.00374, -0.0223 * leg.left, -0.0327), (0.00584, 0.0058, 0.00103))
        + shape("visual", cylinder(0.044, 0.03), (0, 0, 0), (quarter, 0, 0), _GREY)
        + shape("visual", box(0.05, 0.03, 0.20), (0, 0, -0.105), rgba=_SILVER)
        + shape("collision", box(0.034, 0.0245, 0.213), (0, 0, -0.1065))
    )
    calf = (
        inertial(CALF_MASS_KG, (0.00548, -0.000975 * leg.left, -0.115), (0.00077, 0.00078, 4e-5))
        + shape("visual", cylinder(0.022, 0.03), (0, 0, 0), (quarter, 0, 0), _BLACK)
        + shape("visual", box(0.026, 0.022, 0.20), (0, 0, -0.10), rgba=_GREY)
        + shape("collision", box(0.02, 0.016, 0.16), (0, 0, -0.09))
    )
    foot = (
        inertial(FOOT_MASS_KG, (0, 0, 0), (9.6e-6, 9.6e-6, 9.6e-6))
        + shape("visual", f'<sphere radius="{FOOT_RADIUS_M}"/>', (0, 0, 0), rgba=_BLACK)
        + shape("collision", f'<sphere radius="{FOOT_RADIUS_M}"/>', (0, 0, 0))
    )
    limits = leg.limits_rad
    return "".join(
        (
            f'<link name="{name}_hip_link">{hip}</link><link name="{name}_thigh_link">{thigh}</link>',
            f'<link name="{name}_calf_link">{calf}</link><link name="{name}_foot_link">{foot}</link>',
            _joint(
                f"{name}_hip", "revolute", "base", f"{name}_hip_link", (hip_x, hip_y, 0), _motor(0, "1 0 0", limits[0])
            ),
            _joint(
                f"{name}_thigh", "revolute", f"{name}_hip_link", f"{name}_thigh_link", (0, thigh_y, 0),
                _motor(1, "0 1 0", limits[1]),
            ),
            _joint(
                f"{name}_calf", "revolute", f"{name}_thigh_link", f"{name}_calf_link", (0, 0, -THIGH_LENGTH_M),
                _motor(2, "0 1 0", limits[2]),
            ),
            _joint(f"{name}_foot", "fixed", f"{name}_calf_link", f"{name}_foot_link", (0, 0, -CALF_LENGTH_M)),
        )
    )  # fmt: skip


def write_go2_urdf(folder: Path) -> Path:
    """Write the Go2's URDF, the base and four legs of hip, thigh, calf and a fixed foot; return its path."""
    return write_urdf("go2", _base() + "".join(_leg(leg) for leg in LEG_GEOMETRY), folder)
