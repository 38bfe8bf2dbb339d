"""What a person looks like: a body of simple meshes and the pose of its limbs over one gait cycle."""

from __future__ import annotations

from math import cos, pi, sin

import numpy as np
from numpy.typing import NDArray

from sim_hil.mesh import Frame, MeshBuilder
from sim_hil.people import Appearance
from sim_hil.world_stage import Stage

_HIP_M, _SHOULDER_M, _THIGH_M = 0.90, 1.40, 0.43
_HIP_Y_M, _SHOULDER_Y_M = 0.09, 0.225
_THIGH_SWING_RAD, _KNEE_RAD, _ARM_SWING_RAD = 0.48, 0.85, 0.5


def _darker(colour: tuple[int, int, int], share: float) -> tuple[int, int, int]:
    return (round(colour[0] * share), round(colour[1] * share), round(colour[2] * share))


def _trunk(look: Appearance, k: float, detail: float) -> MeshBuilder:
    """Pelvis to hair; origin on the floor below the hips."""
    mesh, frame = MeshBuilder(detail), Frame()
    torso = ((0.88, 0.10, 0.155), (1.05, 0.105, 0.15), (1.28, 0.125, 0.19), (1.40, 0.11, 0.20), (1.46, 0.06, 0.09))
    mesh.prism(frame, tuple(((0, 0, z * k), rx * k, ry * k) for z, rx, ry in torso), look.shirt)
    mesh.prism(frame, (((0, 0, 0.82 * k), 0.10 * k, 0.15 * k), ((0, 0, 0.93 * k), 0.105 * k, 0.16 * k)), look.trousers)
    mesh.prism(frame, (((0, 0, 1.44 * k), 0.05 * k, 0.05 * k), ((0, 0, 1.52 * k), 0.05 * k, 0.05 * k)), look.skin, 6)
    mesh.ball(frame, (0.01 * k, 0, 1.60 * k), (0.095 * k, 0.08 * k, 0.12 * k), look.skin)
    mesh.ball(frame, (-0.018 * k, 0, 1.635 * k), (0.10 * k, 0.088 * k, 0.105 * k), look.hair)
    for side in (-1, 1):
        mesh.box(frame, (0.098 * k, side * 0.03 * k, 1.615 * k), (0.012, 0.02, 0.018), (30, 26, 26))
    mesh.box(frame, (0.105 * k, 0, 1.585 * k), (0.03, 0.022, 0.03), _darker(look.skin, 0.92))
    mesh.box(frame, (0.095 * k, 0, 1.545 * k), (0.012, 0.045, 0.012), (150, 70, 66))
    return mesh


def _thigh(look: Appearance, k: float, detail: float) -> MeshBuilder:
    mesh, frame = MeshBuilder(detail), Frame()
    mesh.prism(
        frame, (((0, 0, -_THIGH_M * k), 0.062 * k, 0.058 * k), ((0, 0, 0.02), 0.088 * k, 0.08 * k)), look.trousers, 7
    )
    return mesh


def _shin(look: Appearance, k: float, detail: float) -> MeshBuilder:
    mesh, frame = MeshBuilder(detail), Frame()
    shade = _darker(look.trousers, 0.93)
    mesh.prism(frame, (((0, 0, -0.41 * k), 0.048 * k, 0.045 * k), ((0, 0, 0.01), 0.062 * k, 0.058 * k)), shade, 7)
    mesh.box(frame, (0.05 * k, 0, -0.44 * k), (0.25 * k, 0.085 * k, 0.07 * k), look.shoes)
    return mesh


def _arm(look: Appearance, k: float, detail: float) -> MeshBuilder:
    """Slightly bent arm, one piece: sleeve, forearm, hand."""
    mesh, frame = MeshBuilder(detail), Frame()
    elbow, wrist, tip = (0.015 * k, 0, -0.29 * k), (0.09 * k, 0, -0.52 * k), (0.11 * k, 0, -0.61 * k)
    mesh.prism(frame, ((elbow, 0.042 * k, 0.04 * k), ((0, 0, 0.02), 0.056 * k, 0.052 * k)), look.shirt, 6)
    mesh.prism(frame, ((wrist, 0.034 * k, 0.032 * k), (elbow, 0.042 * k, 0.04 * k)), _darker(look.shirt, 0.9), 6)
    mesh.prism(frame, ((tip, 0.03 * k, 0.02 * k), (wrist, 0.036 * k, 0.028 * k)), look.skin, 6)
    return mesh


class PersonBody:
    """One person's meshes on a stage, put in place by `pose`; `detail` below 1 is for people seen from afar."""

    def __init__(self, stage: Stage, look: Appearance, detail: float = 1.0) -> None:
        self._stage, self._k = stage, look.scale
        parts = (
            _trunk(look, look.scale, detail),
            *(_thigh(look, look.scale, detail) for _ in range(2)),
            *(_shin(look, look.scale, detail) for _ in range(2)),
            *(_arm(look, look.scale, detail) for _ in range(2)),
        )
        self._parts = [stage.add(part) for part in parts]

    def pose(self, row: NDArray[np.float64]) -> None:
        """Place the body for one row of People.render_rows()."""
        x, y, heading, phase, swing = (float(value) for value in row[:5])
        k, c, s = self._k, cos(heading), sin(heading)
        bob = 0.02 * swing * k * cos(4 * pi * phase)  # highest when the legs pass each other
        self._put(0, x, y, bob, heading, 0.04 * swing)
        for side, leg in ((-1.0, 0), (1.0, 1)):
            angle = 2 * pi * (phase + (0.5 if leg else 0.0))
            hip = -_THIGH_SWING_RAD * swing * sin(angle) - 0.06 * swing
            # The knee bends while the foot swings forward (thigh rate positive), and is nearly straight on the ground.
            knee = swing * _KNEE_RAD * max(0.0, cos(angle)) ** 1.5 + 0.05
            hx, hy = x - s * side * _HIP_Y_M * k, y + c * side * _HIP_Y_M * k
            hz = _HIP_M * k + bob
            self._put(1 + leg, hx, hy, hz, heading, hip)
            reach = -sin(hip) * _THIGH_M * k
            self._put(3 + leg, hx + c * reach, hy + s * reach, hz - cos(hip) * _THIGH_M * k, heading, hip + knee)
            ax, ay = x - s * side * _SHOULDER_Y_M * k, y + c * side * _SHOULDER_Y_M * k
            self._put(5 + leg, ax, ay, _SHOULDER_M * k + bob, heading, _ARM_SWING_RAD * swing * sin(angle))

    def hide(self) -> None:
        """Take the body out of every picture until the next `pose`."""
        for part in self._parts:
            self._stage.hide(part)

    def _put(self, part: int, x: float, y: float, z: float, heading: float, pitch: float) -> None:
        cz, sz, cy, sy = cos(heading / 2), sin(heading / 2), cos(pitch / 2), sin(pitch / 2)
        turn = (-sz * sy, cz * sy, sz * cy, cz * cy)
        self._stage.place(self._parts[part], (x, y, z), turn)
