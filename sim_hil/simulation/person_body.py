"""Body of one person on a stage: meshes for an appearance, and their posture from a render row.

Angles are pitches about the body's left axis, rad: positive tips what hangs down backwards and what stands up forwards.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import asin, cos, pi, sin

import numpy as np
from numpy.typing import NDArray

from sim_hil.crowd.looks import Appearance
from sim_hil.simulation import person_meshes as parts
from sim_hil.world.drawing.mesh import Frame, MeshBuilder
from sim_hil.world.drawing.stage import Stage

_SIDES = (-1.0, 1.0)  # right, left
_STANCE = 0.6  # share of a cycle that a foot is on the ground
_FULL_STEP_M = 0.71  # of a swing of 1
_SWING_KNEE_RAD, _ARM_RAD = 1.0, 0.5
_TOE_M, _HEEL_M = 0.16, 0.08  # from the ankle
_SEATED_THIGH_RAD = -1.45


class PersonBody:
    """Meshes of one person on a stage, placed by `pose`.

    `detail` below 1 is for distant people: fewer faces, and only the legs move.
    """

    def __init__(self, stage: Stage, look: Appearance, detail: float = 1.0) -> None:
        self._stage, self._look, self._detail, self._k = stage, look, detail, look.scale
        self._shoulder_m = parts.SHOULDER_SIDE_M * look.scale * look.build
        self._thighs, self._shins = ([self._add(build) for _ in _SIDES] for build in (parts.thigh, parts.shin))
        self._near = detail >= 1.0
        self._head = self._tail = -1
        self._upper_arms: list[int] = []
        self._forearms: list[int] = []
        if self._near:
            self._trunk, self._head = self._add(parts.trunk), self._add(parts.head)
            self._upper_arms, self._forearms = (
                [self._add(build) for _ in _SIDES] for build in (parts.upper_arm, parts.forearm)
            )
            if parts.tail_m(look):
                self._tail = self._add(parts.tail)
        else:
            self._trunk = self._add(self._upper_body)

    def _add(self, build: Callable[[MeshBuilder, Frame, Appearance], None]) -> int:
        mesh = MeshBuilder(self._detail)
        build(mesh, Frame(), self._look)
        return self._stage.add(mesh)

    def _upper_body(self, mesh: MeshBuilder, frame: Frame, look: Appearance) -> None:
        """All but the legs in one piece, the arms hanging."""
        k = self._k
        parts.trunk(mesh, frame, look)
        parts.head(mesh, frame.at((0.0, 0.0, (parts.NECK_M - parts.HIP_M) * k)), look, face=False)
        for side in _SIDES:
            shoulder = frame.at((0.0, side * self._shoulder_m, (parts.SHOULDER_M - parts.HIP_M) * k))
            parts.upper_arm(mesh, shoulder, look)
            parts.forearm(mesh, shoulder.at((0.0, 0.0, -parts.UPPER_ARM_M * k)), look)
        if parts.tail_m(look):
            parts.tail(mesh, frame, look)

    def pose(self, row: NDArray[np.float64]) -> None:
        """Place the body for one row of People.render_rows()."""
        x, y, heading, phase, swing, ground, sitting, gesture = row.tolist()
        body, k = limbs(phase, swing, sitting, int(gesture)), self._k
        c, s = cos(heading), sin(heading)
        cz, sz = cos(heading / 2), sin(heading / 2)
        hips = ground + body.hips_m * k

        def put(part: int, ahead: float, left: float, z: float, pitch: float) -> None:
            cy, sy = cos(pitch / 2), sin(pitch / 2)
            turn = (-sz * sy, cz * sy, sz * cy, cz * cy)
            self._stage.place(part, (x + c * ahead - s * left, y + s * ahead + c * left, z), turn)

        lean_x, lean_z = sin(body.trunk), cos(body.trunk)
        neck = (parts.NECK_M - parts.HIP_M) * k
        shoulder = (parts.SHOULDER_M - parts.HIP_M) * k
        put(self._trunk, 0.0, 0.0, hips, body.trunk)
        if self._near:
            put(self._head, neck * lean_x, 0.0, hips + neck * lean_z, body.trunk + body.head)
        for index, side in enumerate(_SIDES):
            thigh, shin = body.thighs[index], body.shins[index]
            across = side * parts.HIP_SIDE_M * k
            put(self._thighs[index], 0.0, across, hips, thigh)
            knee = parts.THIGH_M * k
            put(self._shins[index], -sin(thigh) * knee, across, hips - cos(thigh) * knee, shin)
            if self._near:
                upper, fore = body.upper_arms[index], body.forearms[index]
                ahead, up, across = shoulder * lean_x, hips + shoulder * lean_z, side * self._shoulder_m
                put(self._upper_arms[index], ahead, across, up, upper)
                elbow = parts.UPPER_ARM_M * k
                put(self._forearms[index], ahead - sin(upper) * elbow, across, up - cos(upper) * elbow, fore)
        if self._tail >= 0:
            # Cloth follows both thighs: between them when one walks, over them when one sits.
            put(self._tail, 0.0, 0.0, hips, 0.5 * (body.thighs[0] + body.thighs[1]))

    def hide(self) -> None:
        """Hide the body until the next `pose`."""
        moving = (*self._thighs, *self._shins, *self._upper_arms, *self._forearms, self._trunk, self._head, self._tail)
        for part in moving:
            if part >= 0:
                self._stage.hide(part)


@dataclass(frozen=True)
class Limbs:
    """Pitches of every part, rad, right side first, and the height of the hips over the ground, m (before scaling)."""

    hips_m: float
    trunk: float
    head: float
    thighs: tuple[float, float]
    shins: tuple[float, float]
    upper_arms: tuple[float, float]
    forearms: tuple[float, float]


def limbs(phase: float, swing: float, sitting: float, gesture: int) -> Limbs:
    """Return the posture for a gait phase 0..1, a swing (relative step length), sitting 0..1 and a gesture."""
    right, left = _leg(phase, swing), _leg((phase + 0.5) % 1.0, swing)
    thighs = tuple(hip + (_SEATED_THIGH_RAD - hip) * sitting for hip, _ in (right, left))
    shins = tuple((hip + knee) * (1.0 - sitting) for hip, knee in (right, left))
    reach = max(_reach(thigh, shin) for thigh, shin in zip(thighs, shins, strict=True))
    upper, fore = _arms(phase, swing, sitting, gesture)
    nod = 0.42 if gesture == 2 else 0.06 * sin(4 * pi * phase) if gesture == 1 else 0.0
    return Limbs(
        hips_m=reach,
        trunk=0.05 * swing - 0.08 * sitting,
        head=nod,
        thighs=(thighs[0], thighs[1]),
        shins=(shins[0], shins[1]),
        upper_arms=upper,
        forearms=fore,
    )


def _leg(phase: float, swing: float) -> tuple[float, float]:
    """Return hip pitch and knee bend of a leg whose foot touches down at phase 0."""
    # During stance the foot moves backwards at the body's speed, so it does not slide.
    most = asin(min(_STANCE * _FULL_STEP_M * swing / (parts.THIGH_M + parts.SHIN_M), 0.9))
    if phase < _STANCE:
        share = phase / _STANCE
        return most * (2.0 * share - 1.0), 0.04 + 0.12 * swing * sin(pi * share) ** 2
    share = (phase - _STANCE) / (1.0 - _STANCE)
    hip = most * cos(pi * share) - 0.12 * swing * sin(pi * share)
    return hip, 0.04 + _SWING_KNEE_RAD * swing * sin(pi * min(share * 1.15, 1.0)) ** 1.3


def _reach(thigh: float, shin: float) -> float:
    """From the hip down to the lowest point of the shoe, m; a toe may dip a little: shoes bend."""
    toe = _TOE_M * sin(shin) if shin > 0 else -_HEEL_M * sin(shin)
    return parts.THIGH_M * cos(thigh) + parts.SHIN_M * cos(shin) + parts.ANKLE_M * cos(shin) + 0.4 * toe


def _arms(phase: float, swing: float, sitting: float, gesture: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """Pitches of upper arms and forearms, right side first: each swings with the other side's leg."""
    uppers, fores = [], []
    for side in (0, 1):
        beat = cos(2 * pi * (phase + (0.5 if side == 0 else 0.0)))
        upper = -_ARM_RAD * swing * beat - 0.05
        fore = upper - 0.18 - 0.28 * swing * (1.0 + 0.6 * beat)
        upper += (-0.35 - upper) * sitting
        fore += (-1.35 - fore) * sitting
        if gesture == 2 and side == 0:
            upper, fore = -0.5, -2.15
        elif gesture == 1:
            wave = sin(2 * pi * phase + (0.0 if side == 0 else 1.9))
            raised = 1.0 if side == 0 else 0.45
            upper, fore = -0.15 * raised + 0.08 * wave, -1.35 * raised - 0.35 * wave * raised
        uppers.append(upper)
        fores.append(fore)
    return (uppers[0], uppers[1]), (fores[0], fores[1])
