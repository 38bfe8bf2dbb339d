"""The camera shows what it claims: things where they are, the right way round, in their colours."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from math import cos, pi, radians, sin
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from sim_hil.crowd.people import RENDER_FIELDS
from sim_hil.scene.scene import load_scene
from sim_hil.simulation import renderer as world_renderer
from sim_hil.simulation.camera import CameraWorld
from sim_hil.simulation.physics import Simulation

WIDTH, HEIGHT = 320, 180
NOWHERE = (-100.0, -100.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def world() -> Iterator[CameraWorld]:
    world = CameraWorld(load_scene("corridor"), people=1, seed=0)
    yield world
    world.close()


@pytest.fixture(scope="module")
def bare_world() -> Iterator[CameraWorld]:
    scene = load_scene("corridor")
    rest = tuple(thing for thing in scene.objects if thing.label != "vending machine")
    world = CameraWorld(replace(scene, objects=rest), people=1, seed=0)
    yield world
    world.close()


def _state(x: float, y: float, theta: float, person: tuple[float, ...] = NOWHERE) -> np.ndarray:
    """A robot standing level at (x, y, theta)."""
    base = (x, y, 0.31, 0.0, 0.0, sin(theta / 2), cos(theta / 2))
    rest = (0.0,) * (RENDER_FIELDS - len(person))  # on level ground, upright, no gesture
    return np.array((*base, *(0.0, 0.85, -1.7) * 4, *person, *rest))


def _changed(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Where two pictures differ, bool [h, w]."""
    return np.abs(a.astype(int) - b.astype(int)).max(axis=2) > 20


def test_the_vending_machine_is_where_the_scene_puts_it(world: CameraWorld, bare_world: CameraWorld) -> None:
    # From 4 m before it, by the other wall: it must appear left of the middle, and nothing else may change.
    state = _state(20.0, 0.0, 0.2)
    changed = _changed(world.render(state, WIDTH, HEIGHT), bare_world.render(state, WIDTH, HEIGHT))
    _rows, columns = np.nonzero(changed)
    assert changed.sum() > 400
    assert columns.max() < 0.6 * WIDTH and columns.min() > 0.2 * WIDTH


def test_the_vending_machine_is_red_and_blue_not_blue_and_red(world: CameraWorld, bare_world: CameraWorld) -> None:
    state = _state(21.5, 0.0, 0.5)
    picture = world.render(state, WIDTH, HEIGHT).astype(int)
    machine = picture[_changed(picture, bare_world.render(state, WIDTH, HEIGHT))]
    red = ((machine[:, 0] > 120) & (machine[:, 2] < 80)).mean()
    blue = ((machine[:, 2] > 90) & (machine[:, 0] < 60)).mean()
    assert red > 0.3 and 0.05 < blue < red


@pytest.mark.parametrize(("side", "columns"), [(0.8, slice(0, WIDTH // 2)), (-0.8, slice(WIDTH // 2, WIDTH))])
def test_a_person_on_the_robots_left_appears_in_the_left_half(world: CameraWorld, side: float, columns: slice) -> None:
    empty = world.render(_state(10, 0, 0), WIDTH, HEIGHT)
    person = world.render(_state(10, 0, 0, (13.0, side, pi, 0.25, 1.0)), WIDTH, HEIGHT)
    changed = _changed(empty, person)
    assert changed.sum() > 300
    assert changed[:, columns].sum() == changed.sum()


def test_a_nearer_person_is_larger(world: CameraWorld) -> None:
    empty = world.render(_state(10, 0, 0), WIDTH, HEIGHT)
    sizes = [
        _changed(empty, world.render(_state(10, 0, 0, (10 + d, 0.0, pi, 0.25, 1.0)), WIDTH, HEIGHT)).sum()
        for d in (2.0, 4.0, 8.0)
    ]
    assert sizes[0] > 1.5 * sizes[1] > 2.5 * sizes[2] > 0


def test_pitching_down_moves_the_picture_up(world: CameraWorld) -> None:
    level = world.render(_state(10, 0, 0), WIDTH, HEIGHT)
    tilted = _state(10, 0, 0)
    tilted[3:7] = (0.0, sin(0.15), 0.0, cos(0.15))  # nose down
    down = world.render(tilted, WIDTH, HEIGHT)
    # Compare the middle columns, far down the corridor, row by row.
    far_level, far_down = (picture[:, 130:190].mean(axis=(1, 2)) for picture in (level, down))
    shifts = range(-60, 61, 2)
    likeness = [np.corrcoef(far_level[65:115], far_down[65 - shift : 115 - shift])[0, 1] for shift in shifts]
    assert 20 < shifts[int(np.argmax(likeness))] < 60


def test_the_simulations_state_fits_the_cameras_world() -> None:
    scene = load_scene("corridor")
    simulation = Simulation(scene, people=2, seed=4)
    camera = CameraWorld(scene, people=2, seed=4)
    picture = camera.render(simulation.render_state(), 160, 90)
    assert picture.shape == (90, 160, 3)
    with pytest.raises(ValueError, match="shape"):
        camera.render(simulation.render_state()[:-1], 160, 90)
    simulation.close()
    camera.close()
    camera.close()  # may be repeated


def test_a_squeezed_picture_shows_what_the_wide_one_shows(world: CameraWorld) -> None:
    person = (13.0, 0.6, pi, 0.25, 1.0)
    wide = world.render(_state(10, 0, 0, person), 320, 180)
    square = world.render(_state(10, 0, 0, person), 128, 128, aspect=16 / 9)
    squeezed = cv2.resize(wide, (128, 128), interpolation=cv2.INTER_AREA)
    assert np.abs(square.astype(int) - squeezed.astype(int)).mean() < 6
    assert np.abs(world.render(_state(10, 0, 0, person), 128, 128).astype(int) - squeezed.astype(int)).mean() > 12


@pytest.mark.slow
def test_two_processes_see_the_same_to_the_last_bit() -> None:
    program = (
        "import hashlib, numpy as np; from sim_hil.simulation.camera import CameraWorld;"
        "from sim_hil.scene.scene import load_scene;"
        "from sim_hil.crowd.people import RENDER_FIELDS;"
        "w = CameraWorld(load_scene('corridor'), people=1, seed=3);"
        "s = np.zeros(19 + RENDER_FIELDS); s[:7] = (9, 0.2, 0.3, 0, 0, 0, 1); s[19:24] = (12, 0.3, 2, 0.3, 1);"
        "print(hashlib.sha256(w.render(s, 128, 128, 16 / 9).tobytes()).hexdigest())"
    )
    runs = [subprocess.run([sys.executable, "-c", program], capture_output=True, text=True) for _ in range(2)]
    assert runs[0].returncode == 0, runs[0].stderr
    assert runs[0].stdout.splitlines()[-1] == runs[1].stdout.splitlines()[-1]


def test_the_wheeled_base_sees_from_its_mast_and_takes_its_own_state() -> None:
    scene = load_scene("corridor")
    carter = CameraWorld(scene, people=0, seed=0, robot="carter")
    go2 = CameraWorld(scene, people=0, seed=0)
    # Same eye: 0.45 m high, level; the Go2's is 0.327 m ahead of and 0.043 m above its base, and looks 2 degrees down.
    low = go2.render(
        np.array((5 + 0.25 - 0.327, 0, 0.407, 0, sin(radians(-1)), 0, cos(radians(-1)), *(0.0,) * 12)), 320, 180
    )
    mast = carter.render(np.array((5.0, 0, 0, 0, 0, 0, 1, 0, 0)), 320, 180)
    assert np.abs(low.astype(int) - mast.astype(int)).mean() < 3
    assert carter.state_size == 9
    for world in (carter, go2):
        world.close()


def test_an_unknown_robot_is_refused_by_naming_the_known_ones() -> None:
    with pytest.raises(ValueError, match="carter"):
        CameraWorld(load_scene("corridor"), people=0, seed=0, robot="hovercraft")


def test_without_its_system_library_the_renderer_names_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    class NoPipes:
        @staticmethod
        def get_global_ptr() -> SimpleNamespace:
            return SimpleNamespace(make_pipe=lambda _: None)

    monkeypatch.setattr(world_renderer.core, "GraphicsPipeSelection", NoPipes)
    with pytest.raises(world_renderer.RendererError, match="libx11-6"):
        CameraWorld(load_scene("corridor"), people=0, seed=0)
