"""Leaving out what walls hide changes no picture, and leaves out a good deal."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from math import cos, pi, sin

import numpy as np
import pytest

from sim_hil.crowd.people import RENDER_FIELDS
from sim_hil.scene.scene import Scene, Wall, load_scene
from sim_hil.simulation.camera import CameraWorld
from sim_hil.world.wall_visibility import Sight, Visibility

ROOMS = Scene(
    "rooms", (1.0, 1.0, 0.0), (2.0, 2.0), (0.0, 0.0), (20.0, 10.0), "vinyl", 2.6,
    (Wall("middle", (10.0, 0.0), (10.0, 8.0), 0.15, 2.6, "wall_office"),), (), (),
)  # fmt: skip
BOUNDS = [(1.0, 4.0, 3.0, 6.0), (12.0, 1.0, 14.0, 3.0), (18.0, 8.5, 19.5, 9.8)]
EAST = np.array((1.0, 0.0))


def _state(scene: Scene, x: float, y: float, theta: float, people: int) -> np.ndarray:
    rng = np.random.default_rng((round(100 * x), round(100 * y)))
    rows = np.zeros((people, RENDER_FIELDS))
    rows[:, :2] = rng.uniform(scene.floor_min_m, scene.floor_max_m, (people, 2))
    return np.array((x, y, 0.31, 0, 0, sin(theta / 2), cos(theta / 2), *(0.0, 0.85, -1.7) * 4, *rows.ravel()))


LOW = replace(ROOMS, walls=(Wall("low", (10.0, 0.0), (10.0, 8.0), 0.15, 1.2, "railing"),))


@pytest.mark.parametrize(
    ("scene", "bounds", "eye", "visible"),
    [
        pytest.param(ROOMS, BOUNDS, (1.0, 2.0), [0], id="a wall hides what is behind it"),
        pytest.param(ROOMS, BOUNDS, (1.0, 9.0), [2], id="beside the end of a wall"),
        pytest.param(LOW, BOUNDS, (1.0, 2.0), [0, 1, 2], id="a wall below the ceiling hides nothing"),
        pytest.param(
            ROOMS, [(1.0, 4.0, 2.0, 6.0), (5.5, 4.0, 7.0, 6.0)], (8.0, 5.0), [1], id="behind the eye only if very near"
        ),
    ],
)
def test_visible_pieces(
    scene: Scene, bounds: list[tuple[float, ...]], eye: tuple[float, float], visible: list[int]
) -> None:
    visibility = Visibility(scene, bounds)
    assert sorted(visibility.pieces(visibility.sight(np.array(eye), EAST, 1.2))) == visible


@pytest.fixture(scope="module")
def hospital() -> Iterator[tuple[CameraWorld, Scene]]:
    scene = load_scene("hospital")
    world = CameraWorld(scene, people=30, seed=0)
    yield world, scene
    world.close()


@pytest.mark.slow
@pytest.mark.parametrize("index", range(8))
def test_hidden_objects_do_not_change_the_picture_of_a_hospital(
    hospital: tuple[CameraWorld, Scene], index: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    world, scene = hospital
    rng = np.random.default_rng((index, 5))
    x, y = (float(v) for v in rng.uniform(scene.floor_min_m, scene.floor_max_m))
    state = _state(scene, x, y, float(rng.uniform(-pi, pi)), 30)
    picture = world.render(state, 320, 180)
    monkeypatch.setattr(Sight, "sees", lambda _, low, high: (np.ones(len(low), dtype=bool), np.zeros(len(low))))
    whole = world.render(state, 320, 180)
    # A person's elbow in the last column, or two surfaces in one plane, drawn in another order.
    differing = np.abs(picture.astype(int) - whole.astype(int)).max(axis=2) > 16
    assert differing.sum() < 30


def test_a_picture_does_not_depend_on_earlier_pictures(hospital: tuple[CameraWorld, Scene]) -> None:
    world, scene = hospital
    states = [_state(scene, *scene.start[:2], heading, 30) for heading in (0.0, 1.0, 2.5)]
    first = world.render(states[0], 128, 128, 16 / 9)
    for state in states:
        world.render(state, 128, 128, 16 / 9)
    assert np.array_equal(world.render(states[0], 128, 128, 16 / 9), first)
