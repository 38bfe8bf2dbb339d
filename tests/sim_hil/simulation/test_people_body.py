"""What people look like: varied, dressed for where they are, and in postures that a body can hold."""

from __future__ import annotations

from itertools import pairwise
from math import sin

import numpy as np
import pytest

from sim_hil.crowd.people import appearances
from sim_hil.robots.go2.body import rotation_matrix
from sim_hil.simulation.person_body import PersonBody, limbs
from sim_hil.simulation.person_meshes import SHIN_M, THIGH_M, tail_m
from sim_hil.world.drawing.mesh import MeshBuilder

ROW = np.array((1.0, 2.0, 0.5, 0.3, 1.0, 0.0, 0.0, 0.0))


class FakeStage:
    """Remembers what was added, placed and hidden."""

    def __init__(self) -> None:
        self.meshes: list[MeshBuilder] = []
        self.shown: dict[int, tuple[tuple[float, float, float], tuple[float, float, float, float]]] = {}

    def add(self, mesh: MeshBuilder) -> int:
        self.meshes.append(mesh)
        return len(self.meshes) - 1

    def place(
        self, handle: int, position_m: tuple[float, float, float], quaternion_xyzw: tuple[float, float, float, float]
    ) -> None:
        self.shown[handle] = (position_m, quaternion_xyzw)

    def hide(self, handle: int) -> None:
        self.shown.pop(handle, None)

    def points(self) -> np.ndarray:
        """[n, 3]: every vertex that is shown, in the world."""
        found = []
        for handle, (position, quaternion) in self.shown.items():
            turn = rotation_matrix(quaternion)
            for surface in self.meshes[handle].surfaces():
                found.append(np.array(surface.vertices) @ turn.T + position)
        return np.concatenate(found)


def _row(**changes: float) -> np.ndarray:
    row = ROW.copy()
    for name, value in changes.items():
        row[("x", "y", "heading", "phase", "swing", "ground", "sitting", "gesture").index(name)] = value
    return row


def test_sixty_people_differ_in_appearance() -> None:
    looks = appearances(60, 0, "office")
    assert len({(look.shirt, look.trousers, look.hair, look.hair_style, look.top, look.legs) for look in looks}) > 55


@pytest.mark.parametrize(
    ("scene", "clothes", "share"),
    [
        ("hospital", {"scrubs", "lab_coat"}, (0.35, 0.65)),
        ("warehouse", {"vest"}, (0.6, 0.9)),
        ("office", {"vest"}, (0, 0)),
    ],
)
def test_clothes_fit_the_scene(scene: str, clothes: set[str], share: tuple[float, float]) -> None:
    worn = np.mean([look.top in clothes for look in appearances(200, 2, scene)])
    assert share[0] <= worn <= share[1]


@pytest.mark.parametrize("index", range(12))
def test_a_person_stands_on_the_ground_and_has_the_height_of_the_appearance(index: int) -> None:
    look = appearances(12, 4, "warehouse" if index % 2 else "hospital")[index]
    stage = FakeStage()
    PersonBody(stage, look).pose(_row(swing=0.0, ground=0.14))
    z = stage.points()[:, 2]
    assert z.min() == pytest.approx(0.14, abs=0.02)
    assert z.max() - 0.14 == pytest.approx(1.75 * look.scale, abs=0.06)


def test_no_shoe_sinks_in_or_hovers_in_any_phase_of_the_gait() -> None:
    stage = FakeStage()
    body = PersonBody(stage, appearances(1, 0, "office")[0])
    for phase in np.linspace(0, 1, 24, endpoint=False):
        body.pose(_row(phase=phase))
        assert -0.06 < stage.points()[:, 2].min() < 0.02  # a toe bends where a shoe of one piece dips in


def test_the_foot_on_the_ground_goes_back_as_fast_as_the_body_goes_on() -> None:
    # Over one cycle of a swing of 1 the body covers two steps of 0.71 m.
    phases = np.linspace(0.05, 0.55, 26)
    ahead = []
    for phase in phases:
        posture = limbs(float(phase), 1.0, 0.0, 0)
        ahead.append(-THIGH_M * sin(posture.thighs[0]) - SHIN_M * sin(posture.shins[0]))
    speed = -np.polyfit(phases, ahead, 1)[0]
    assert speed == pytest.approx(2 * 0.71, rel=0.15)


def test_legs_move_against_each_other_and_arms_against_legs() -> None:
    postures = [limbs(float(phase), 1.0, 0.0, 0) for phase in np.linspace(0, 1, 40, endpoint=False)]
    right, left = (np.array([posture.thighs[side] for posture in postures]) for side in (0, 1))
    arm = np.array([posture.upper_arms[0] for posture in postures])
    assert np.corrcoef(right, left)[0, 1] < -0.8
    assert np.corrcoef(right, arm)[0, 1] < -0.8


def test_postures_change_without_jumps() -> None:
    postures = [limbs(float(phase) % 1.0, 1.0, 0.0, 0) for phase in np.linspace(0, 1, 101)]
    for a, b in pairwise(postures):
        for before, after in zip((*a.thighs, *a.shins, *a.forearms), (*b.thighs, *b.shins, *b.forearms), strict=True):
            assert abs(after - before) < 0.2


def test_a_hidden_person_shows_nothing_until_posed_again() -> None:
    stage = FakeStage()
    body = PersonBody(stage, next(look for look in appearances(60, 0, "office") if tail_m(look)))
    body.pose(ROW)
    count = len(stage.shown)
    assert count == len(stage.meshes)
    body.hide()
    assert not stage.shown
    body.pose(ROW)
    assert len(stage.shown) == count


def test_a_person_far_away_has_half_the_parts_and_faces() -> None:
    look = appearances(1, 0, "office")[0]
    sizes = []
    for detail in (1.0, 0.5):
        stage = FakeStage()
        PersonBody(stage, look, detail).pose(ROW)
        faces = sum(len(surface.indices) // 3 for mesh in stage.meshes for surface in mesh.surfaces())
        sizes.append((len(stage.meshes), faces))
    assert sizes[1][0] <= 5 < sizes[0][0] and sizes[1][1] < 0.6 * sizes[0][1]
