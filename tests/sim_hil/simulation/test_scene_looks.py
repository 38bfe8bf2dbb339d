"""How scenes look: every kind has a form that fits its size and its boxes, floors and walls show what the file says."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from math import hypot, pi

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_hil.scene.scene import KINDS, TEXTURES, Box, Floor, Scene, SceneObject, Terrain, Wall, load_scene
from sim_hil.simulation.renderer import Renderer
from sim_hil.world.drawing.mesh import MeshBuilder
from sim_hil.world.drawing.surfaces import SURFACES
from sim_hil.world.drawing.textures import sign
from sim_hil.world.scene_meshes import BUILDERS, add_object, build_scene, counter_clockwise, split

OPEN = Scene("open", (0.0, 0.0, 0.0), (1.0, 1.0), (-12.0, -12.0), (12.0, 12.0), "asphalt", 0.0, (), (), ())
UP = np.array((0.0, 0.0, 1.0))
# Cloth and roofs that reach out over people's heads, and a counter's edge, beyond the object's own size.
OVERHANG_M = {"storefront": 1.01, "kiosk": 0.3, "reception_desk": 0.12, "building": 0.1, "tree": 0.15}
# A rail at the top of what it is given, and a post: the rest is air.
SLENDER = ("handrail", "sign_post")
Corners = list[tuple[float, float]]


@contextmanager
def _shown(scene: Scene) -> Iterator[Renderer]:
    renderer = Renderer(scene.sky)
    build_scene(renderer, scene)
    yield renderer
    renderer.close()


def _down(renderer: Renderer, x: float, y: float, high: float, width_m: float = 0.5) -> np.ndarray:
    """Mean colour of the square of floor (at height 0) below a point."""
    hfov = 2 * float(np.arctan(width_m / 2 / high))
    north = np.array((0.0, 1.0, 0.0))
    picture = renderer.picture(np.array((x, y, high)), np.array((0.0, 0.0, -1.0)), north, hfov, 16, 16, 1.0)
    return picture.reshape(-1, 3).astype(float).mean(axis=0)


def _vertices(kind: str) -> tuple[SceneObject, np.ndarray]:
    mesh = MeshBuilder()
    thing = SceneObject("it", kind, (0.0, 0.0, 0.0), 0.0, KINDS[kind].size_m, KINDS[kind].colour, "A1")
    add_object(mesh, thing)
    return thing, np.concatenate([np.array(surface.vertices) for surface in mesh.surfaces()])


def _gap(box: Box, x: float, y: float) -> float:
    dx, dy = x - box.centre_m[0], y - box.centre_m[1]
    u = abs(dx * box.axis[0] + dy * box.axis[1]) - box.size_m[0] / 2
    v = abs(dy * box.axis[0] - dx * box.axis[1]) - box.size_m[1] / 2
    return hypot(max(u, 0.0), max(v, 0.0))


def test_every_kind_has_a_form_and_every_texture_a_picture() -> None:
    assert set(BUILDERS) == set(KINDS)
    assert set(SURFACES) == TEXTURES


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_an_object_is_as_large_as_the_scene_says(kind: str) -> None:
    thing, vertices = _vertices(kind)
    slack = OVERHANG_M.get(kind, 0.07)
    for axis, size in enumerate(thing.size_m):
        low, high = (0.0, size) if axis == 2 else (-size / 2, size / 2)
        assert low - slack <= vertices[:, axis].min() and vertices[:, axis].max() <= high + slack
        assert kind in SLENDER or np.ptp(vertices[:, axis]) > 0.5 * size


@pytest.mark.parametrize("kind", sorted(name for name, kind in KINDS.items() if kind.solid))
def test_visible_parts_at_the_height_of_a_robot_are_obstacles(kind: str) -> None:
    thing, vertices = _vertices(kind)
    for x, y, z in vertices:
        if 0.03 < z < 0.5:
            assert min(_gap(box, x, y) for box in thing.boxes) < 0.06


def test_a_patch_of_floor_shows_its_own_texture_and_the_rest_the_floors() -> None:
    grass = Floor(((0.0, 0.0), (5.0, 0.0), (5.0, 5.0), (0.0, 5.0)), "grass")
    with _shown(replace(OPEN, floors=(grass,))) as renderer:
        green, grey = _down(renderer, 2.5, 2.5, 2.0), _down(renderer, -2.5, 2.5, 2.0)
    assert green[1] > 1.3 * green[2] and green[1] > 1.2 * green[0]
    assert np.ptp(grey) < 15


def test_a_later_patch_lies_over_an_earlier_one() -> None:
    under = Floor(((-4.0, -4.0), (4.0, -4.0), (4.0, 4.0), (-4.0, 4.0)), "carpet_blue")
    over = Floor(((-1.0, -1.0), (1.0, -1.0), (0.0, 1.5)), "grass")
    with _shown(replace(OPEN, floors=(under, over))) as renderer:
        middle, beside = _down(renderer, 0.0, 0.0, 2.0), _down(renderer, 3.0, 0.0, 2.0)
    assert middle[1] > middle[2] and beside[2] > 1.3 * beside[0]


def test_bars_of_a_zebra_crossing_lie_across_its_heading() -> None:
    zebra = Floor(((-4.0, -4.0), (4.0, -4.0), (4.0, 4.0), (-4.0, 4.0)), "zebra_crossing", pi / 2)
    with _shown(replace(OPEN, floors=(zebra,))) as renderer:
        hfov = 2 * float(np.arctan(2.0 / 6.0))
        picture = renderer.picture(
            np.array((0.0, 0.0, 6.0)), np.array((0.0, 0.0, -1.0)), np.array((0.0, 1.0, 0.0)), hfov, 64, 64, 1.0
        ).astype(float)
    # People walk along y, up in the picture: rows differ, columns do not.
    assert picture.mean(axis=(1, 2)).std() > 5 * picture.mean(axis=(0, 2)).std()


@pytest.mark.parametrize("kind", ["kerb", "platform", "ramp", "bump"])
def test_raised_ground_is_seen_as_high_as_it_is_walked_on(kind: str) -> None:
    terrain = Terrain("it", kind, (0.0, 0.0, 0.0), 0.0, (2.0, 2.0), 0.4, "grass")
    scene = replace(OPEN, terrain=(terrain,))
    with _shown(scene) as renderer:
        eye, ahead = np.array((0.0, -8.0, 0.2)), np.array((0.0, 1.0, 0.0))
        picture = renderer.picture(eye, ahead, UP, 0.5, 256, 128, 2.0).astype(float)
    empty_sky = np.array(scene.sky) * 255
    for u in (-0.6, 0.0, 0.6):
        # The nearer upper edge of its side, 7 m away, against the sky or the asphalt behind.
        height = scene.ground_height_m(u, -0.99)
        column = round(128 + u / 7.0 / np.tan(0.25) * 128)
        row = round(64 - (height - 0.2) / 7.0 / np.tan(0.25) * 128)
        above, below = picture[row - 5, column], picture[row + 3, column]
        assert below[1] > 1.15 * below[2]
        assert np.abs(above - empty_sky).max() < 12 or np.ptp(above) < 25


def test_no_sky_shines_through_where_walls_meet_floor_and_ceiling() -> None:
    walls = tuple(
        Wall(f"{i}", a, b, 0.15, 2.6, "wall_hospital")
        for i, (a, b) in enumerate(
            zip(
                ((-5.1, -5.1), (5.1, -5.1), (5.1, 5.1), (-5.1, 5.1)),
                ((5.1, -5.1), (5.1, 5.1), (-5.1, 5.1), (-5.1, -5.1)),
                strict=True,
            )
        )
    )
    room = replace(
        OPEN, floor_min_m=(-5.0, -5.0), floor_max_m=(5.0, 5.0), ceiling_height_m=2.6, walls=walls, sky=(1.0, 0.0, 1.0)
    )
    with _shown(room) as renderer:
        for heading in np.linspace(0, 2 * pi, 9):
            ahead = np.array((np.cos(heading), np.sin(heading), 0.0))
            picture = renderer.picture(np.array((0.5, -0.3, 0.4)), ahead, UP, 1.7, 320, 180, 16 / 9).astype(int)
            purple = (picture[..., 0] > picture[..., 1] + 60) & (picture[..., 2] > picture[..., 1] + 60)
            assert not purple.any()


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.floats(-6, 6), st.floats(-6, 6)), min_size=3, max_size=7),
    st.lists(st.tuples(st.floats(-6, 6), st.floats(-6, 6)), min_size=3, max_size=7),
)
def test_cutting_a_polygon_keeps_its_area(first: Corners, second: Corners) -> None:
    hulls = [cv2.convexHull(np.array(points, np.float32)) for points in (first, second)]
    if any(hull is None or len(hull) < 3 for hull in hulls):
        return
    subject, cutter = ([tuple(map(float, p)) for p in hull[:, 0]] for hull in hulls)
    subject, cutter = counter_clockwise(subject), counter_clockwise(cutter)
    areas = [cv2.contourArea(np.array(part, np.float32)) for part in (subject, cutter)]
    if min(areas) < 0.05:
        return
    inside, outside = split(subject, cutter)
    parts = [*outside, *([inside] if inside else [])]
    assert sum(cv2.contourArea(np.array(part, np.float32)) for part in parts) == pytest.approx(areas[0], abs=1e-2)


def test_lettering_is_upright_and_not_mirrored() -> None:
    scene = load_scene("corridor")
    plate = next(thing for thing in scene.objects if thing.label == "exit sign")
    # A camera 1 m before the sign, as high as its middle, sees nothing but the sign and the wall.
    with _shown(scene) as renderer:
        eye, ahead, hfov_rad = (
            np.array((26.9, 0.0, 2.35)),
            np.array((1.0, 0.0, 0.0)),
            2 * float(np.arctan(0.45 / 1.035)),
        )
        seen = renderer.picture(eye, ahead, UP, hfov_rad, 240, 80, 3.0).astype(float)[..., 0]
    drawn = cv2.resize(sign(plate), (240, 80)).astype(float)[..., 0]
    likeness = [np.corrcoef(view.ravel(), seen.ravel())[0, 1] for view in (drawn, drawn[:, ::-1], drawn[::-1])]
    assert likeness[0] > 0.7
    assert likeness[0] > max(likeness[1:]) + 0.1


def test_the_top_of_a_wall_is_seen_from_above() -> None:
    scene = load_scene("corridor")
    left = next(wall for wall in scene.walls if wall.label == "left wall").box
    with _shown(scene) as renderer:
        red, green, blue = _down(renderer, 10.3, left.centre_m[1], left.size_m[2] + 1.5, 0.03)
    assert red > green > blue > 100
    assert (red / blue, green / blue) == pytest.approx((206 / 186, 200 / 186), abs=0.04)
