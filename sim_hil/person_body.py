"""One person on a stage: the meshes of a look, put into the posture of a render row."""

from __future__ import annotations

from math import cos, sin

import numpy as np
from numpy.typing import NDArray

from sim_hil import people_mesh as parts
from sim_hil.people_gait import limbs
from sim_hil.people_looks import Appearance
from sim_hil.world_stage import Stage

_SIDES = (-1.0, 1.0)  # right, left


class PersonBody:
    """One person's meshes on a stage, put in place by `pose`; `detail` below 1 is for people seen from afar."""

    def __init__(self, stage: Stage, look: Appearance, detail: float = 1.0) -> None:
        self._stage, self._k = stage, look.scale
        self._shoulder_m = parts.SHOULDER_SIDE_M * look.scale * look.build
        self._trunk = stage.add(parts.trunk(look, detail))
        self._head = stage.add(parts.head(look, detail))
        self._thighs, self._shins, self._upper_arms, self._forearms = (
            [stage.add(build(look, detail)) for _ in _SIDES]
            for build in (parts.thigh, parts.shin, parts.upper_arm, parts.forearm)
        )
        hanging = parts.tail(look, detail)
        self._tail = None if hanging is None else stage.add(hanging)

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
        put(self._head, neck * lean_x, 0.0, hips + neck * lean_z, body.trunk + body.head)
        for index, side in enumerate(_SIDES):
            thigh, shin = body.thighs[index], body.shins[index]
            across = side * parts.HIP_SIDE_M * k
            put(self._thighs[index], 0.0, across, hips, thigh)
            knee = parts.THIGH_M * k
            put(self._shins[index], -sin(thigh) * knee, across, hips - cos(thigh) * knee, shin)
            upper, fore = body.upper_arms[index], body.forearms[index]
            ahead, up, across = shoulder * lean_x, hips + shoulder * lean_z, side * self._shoulder_m
            put(self._upper_arms[index], ahead, across, up, upper)
            elbow = parts.UPPER_ARM_M * k
            put(self._forearms[index], ahead - sin(upper) * elbow, across, up - cos(upper) * elbow, fore)
        if self._tail is not None:
            # Cloth follows both thighs: between them when one walks, over them when one sits.
            put(self._tail, 0.0, 0.0, hips, 0.5 * (body.thighs[0] + body.thighs[1]))

    def hide(self) -> None:
        """Take the body out of every picture until the next `pose`."""
        limbs_of = (*self._thighs, *self._shins, *self._upper_arms, *self._forearms)
        for part in (self._trunk, self._head, *limbs_of, *(() if self._tail is None else (self._tail,))):
            self._stage.hide(part)
