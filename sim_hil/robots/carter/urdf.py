"""The simulated Carter's body: one table of numbers, and the URDF written from it.

Length, width, height, mass, wheel diameter and battery are those of NVIDIA's Nova Carter (docs.nvidia.com/isaac, page
"Nova Carter": 725 x 500 x 556 mm, 48 kg, drive wheels of 280 mm, over 3.3 m/s, 36 V, 1033 Wh, over 8 h). Our choice, as
that page does not say: track, masses of the parts, centre of mass, tyre width, ground clearance. One thing is unlike
the model on purpose: its driven axle lies under the front, ours under the middle, so that the base turns within its own
length and a planner may take it for a circle around the base frame. The casters are balls: they slide in every
direction with little friction, as swivelling wheels do once they have swivelled.

The base frame lies on the floor, midway between the driven wheels; x forward, y left, z up.
"""

from __future__ import annotations

from math import hypot, pi
from pathlib import Path
from typing import Final

from sim_hil.robots.urdf import box, cylinder, inertial, shape, write_urdf, xyz

LENGTH_M: Final = 0.725
WIDTH_M: Final = 0.500
HEIGHT_M: Final = 0.556
MASS_KG: Final = 48.0
WHEEL_RADIUS_M: Final = 0.140
TRACK_M: Final = 0.414  # between the middles of the tyres
TYRE_WIDTH_M: Final = 0.040
WHEEL_MASS_KG: Final = 3.5
# A flat tyre would touch with one edge only, and the base would turn about that; a crowned one touches in the middle.
_CONTACT_WIDTH_M: Final = 0.008
CASTER_RADIUS_M: Final = 0.065
CASTER_X_M, CASTER_Y_M = -0.29, 0.17
CASTERS_MASS_KG: Final = 2.0
BODY_MASS_KG: Final = MASS_KG - 2 * WHEEL_MASS_KG - CASTERS_MASS_KG
# Behind the axle, so that neither braking nor an 8 degree ramp lifts the casters; low, as batteries are.
BODY_COM_M: Final = (-0.10, 0.0, 0.21)
CLEARANCE_M: Final = 0.080  # under the nose: the foot of an 8 degree ramp passes below it
DECK_M: Final = 0.300  # height of the body without its mast
_NOSE_WIDTH_M: Final = 0.38  # the corners are cut off, which makes the turning circle smaller
_MIDDLE_LENGTH_M: Final = 0.605
RADIUS_M: Final = max(hypot(LENGTH_M / 2, _NOSE_WIDTH_M / 2), hypot(_MIDDLE_LENGTH_M / 2, WIDTH_M / 2))
WHEEL_INERTIA_KGM2: Final = WHEEL_MASS_KG * WHEEL_RADIUS_M**2 / 2

LINKS: Final = ("left_wheel", "right_wheel", "casters")

_SHELL = "0.23 0.24 0.26 1"
_DECK = "0.62 0.64 0.66 1"
_GREEN = "0.46 0.72 0.00 1"
_BLACK = "0.09 0.09 0.10 1"
_TYRE = "0.13 0.13 0.14 1"
_HUB = "0.72 0.73 0.75 1"
_LENS = "0.04 0.05 0.09 1"
_QUARTER = pi / 2  # lays a cylinder along y


def _box_inertia(mass_kg: float, x_m: float, y_m: float, z_m: float) -> tuple[float, float, float]:
    share = mass_kg / 12
    return (share * (y_m**2 + z_m**2), share * (x_m**2 + z_m**2), share * (x_m**2 + y_m**2))


def _base() -> str:
    tall, middle = DECK_M - CLEARANCE_M, (DECK_M + CLEARANCE_M) / 2
    mast = HEIGHT_M - 0.06 - DECK_M
    parts = [
        inertial(BODY_MASS_KG, BODY_COM_M, _box_inertia(BODY_MASS_KG, 0.66, 0.44, 0.30)),
        # Low shell with cut corners, a deck on it, and the mast that carries camera and lidar.
        shape("visual", box(LENGTH_M - 0.01, _NOSE_WIDTH_M, tall - 0.03), (0, 0, middle - 0.015), rgba=_SHELL),
        shape("visual", box(_MIDDLE_LENGTH_M, 0.36, tall - 0.03), (0, 0, middle - 0.015), rgba=_SHELL),
        shape("visual", box(0.13, WIDTH_M - 0.02, tall - 0.03), (-0.235, 0, middle - 0.015), rgba=_SHELL),
        shape("visual", box(0.13, WIDTH_M - 0.02, tall - 0.03), (0.235, 0, middle - 0.015), rgba=_SHELL),
        shape("visual", box(_MIDDLE_LENGTH_M, WIDTH_M - 0.02, 0.03), (0, 0, DECK_M - 0.015), rgba=_DECK),
        shape("visual", box(0.015, _NOSE_WIDTH_M - 0.04, 0.025), (LENGTH_M / 2 - 0.004, 0, 0.22), rgba=_GREEN),
        shape("visual", box(0.02, _NOSE_WIDTH_M + 0.01, 0.05), (LENGTH_M / 2 - 0.009, 0, 0.115), rgba=_BLACK),
        shape("visual", box(0.02, _NOSE_WIDTH_M + 0.01, 0.05), (-LENGTH_M / 2 + 0.009, 0, 0.115), rgba=_BLACK),
        shape("visual", box(0.10, 0.16, mast), (0.19, 0, DECK_M + mast / 2), rgba=_SHELL),
        shape("visual", box(0.012, 0.15, 0.045), (0.243, 0, 0.45), rgba=_DECK),
        shape("visual", cylinder(0.012, 0.012), (0.249, 0.05, 0.45), (0, _QUARTER, 0), _LENS),
        shape("visual", cylinder(0.012, 0.012), (0.249, -0.05, 0.45), (0, _QUARTER, 0), _LENS),
        shape("visual", cylinder(0.05, 0.06), (0.19, 0, HEIGHT_M - 0.03), rgba=_BLACK),
        shape("visual", box(0.03, 0.05, 0.02), (-0.25, 0, DECK_M + 0.01), rgba="0.80 0.10 0.08 1"),
        shape("collision", box(LENGTH_M, _NOSE_WIDTH_M, tall), (0, 0, middle)),
        shape("collision", box(_MIDDLE_LENGTH_M, WIDTH_M, tall), (0, 0, middle)),
        shape("collision", box(0.10, 0.16, HEIGHT_M - DECK_M), (0.19, 0, (HEIGHT_M + DECK_M) / 2)),
    ]
    return f'<link name="base">{"".join(parts)}</link>'


def _wheel(name: str, left: int) -> str:
    y = left * TRACK_M / 2
    roll = WHEEL_INERTIA_KGM2
    across = WHEEL_MASS_KG * (3 * WHEEL_RADIUS_M**2 + TYRE_WIDTH_M**2) / 12
    turned = (_QUARTER, 0.0, 0.0)
    link = (
        inertial(WHEEL_MASS_KG, (0, 0, 0), (across, roll, across))
        + shape("visual", cylinder(WHEEL_RADIUS_M, TYRE_WIDTH_M), (0, 0, 0), turned, _TYRE)
        + shape("visual", cylinder(0.085, TYRE_WIDTH_M + 0.008), (0, 0, 0), turned, _HUB)
        # A mark on the hub shows from outside whether the wheel turns.
        + shape("visual", box(0.02, TYRE_WIDTH_M + 0.012, 0.15), (0, 0, 0), rgba=_SHELL)
        + shape("collision", cylinder(WHEEL_RADIUS_M, _CONTACT_WIDTH_M), (0, 0, 0), turned)
    )
    return (
        f'<link name="{name}">{link}</link>'
        f'<joint name="{name}" type="continuous"><parent link="base"/><child link="{name}"/>'
        f'<origin xyz="{xyz(0, y, WHEEL_RADIUS_M)}"/><axis xyz="0 1 0"/></joint>'
    )


def _casters() -> str:
    ball = f'<sphere radius="{CASTER_RADIUS_M:g}"/>'
    parts = [inertial(CASTERS_MASS_KG, (0, 0, CASTER_RADIUS_M), (0.06, 0.003, 0.06))]
    for side in (-1, 1):
        at = (0.0, side * CASTER_Y_M, CASTER_RADIUS_M)
        parts += [
            shape("visual", cylinder(CASTER_RADIUS_M, 0.035), at, (_QUARTER, 0, 0), _TYRE),
            shape("visual", box(0.03, 0.05, 0.08), (0.0, at[1], CASTER_RADIUS_M + 0.03), rgba=_HUB),
            shape("collision", ball, at),
        ]
    return (
        f'<link name="casters">{"".join(parts)}</link>'
        '<joint name="casters" type="fixed"><parent link="base"/><child link="casters"/>'
        f'<origin xyz="{xyz(CASTER_X_M, 0, 0)}"/></joint>'
    )


def write_carter_urdf(folder: Path) -> Path:
    """Write the Carter's URDF, the base, two driven wheels and one link with both casters; return its path."""
    return write_urdf("carter", _base() + _wheel("left_wheel", 1) + _wheel("right_wheel", -1) + _casters(), folder)
