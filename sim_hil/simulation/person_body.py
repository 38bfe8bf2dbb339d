"""Body of one person on a stage: meshes for an appearance, posed from a render row."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, sin

import numpy as np
from numpy.typing import NDArray

from sim_hil.crowd.looks import Appearance
from sim_hil.simulation import person_meshes as parts
from sim_hil.simulation.person_posture import limbs
from sim_hil.world.drawing.mesh import Frame, MeshBuilder
from sim_hil.world.drawing.stage import Stage

_SIDES = (-1.0, 1.0)  # right, left


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
