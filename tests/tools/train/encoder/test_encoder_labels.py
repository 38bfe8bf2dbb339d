"""The twin shows what the camera shows, and labels say of it what anybody could measure in the scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import closing
from math import atan, hypot, pi, radians, sin, tan

import cv2
import numpy as np
import pytest

from sim_hil.benchmark.suite.robots import robot_grid
from sim_hil.crowd.people import RENDER_FIELDS, appearances
from sim_hil.layouts.builder import COLOURS
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Area, Scene, SceneObject, Wall
from sim_hil.simulation.camera import CAMERA_POSITION_M, CameraWorld
from tools.train.encoder.ids import IdWorld, view_of
from tools.train.encoder.labels import (
    CLASSES,
    COLOUR_WORDS,
    COLUMNS,
    FAR_M,
    LANDMARK,
    NONE,
    OPENINGS,
    PERSON,
    PIXELS,
    SOMEBODY,
    Labels,
    SceneLabels,
    bearing_rad,
    mirrored_label,
)
from tools.train.encoder.worker import quaternion_xyzw

SIDE = 8
AWAY = (-1e5, -1e5, 0.0)
EYE = CAMERA_POSITION_M[0]
"""The robot stands at the origin and looks along x: its camera is so far ahead."""


def wall(label: str, start: tuple[float, float], end: tuple[float, float]) -> Wall:
    return Wall(label, start, end, 0.15, 3.0, "wall_office")


def rectangle(x0: float, x1: float) -> tuple[tuple[float, float], ...]:
    return ((x0, -2.0), (x1, -2.0), (x1, 2.0), (x0, 2.0))


def small_scene() -> Scene:
    """A corridor along x to a doorway at x = 8, a room behind it; a red machine on the left, a bin on the right."""
    machine = SceneObject(
        "machine", "vending_machine", (5.0, 1.4, 0.0), -pi / 2, (0.8, 1.1, 1.9), COLOURS["red"], "", "red machine"
    )
    bin_ = SceneObject("bin", "trash_bin", (3.0, -1.4, 0.0), pi / 2, (0.36, 0.36, 0.75), (0.15, 0.35, 0.62), "", "")
    door = SceneObject("door", "door", (6.5, -1.92, 0.0), pi / 2, (0.05, 1.0, 2.1), (0.5, 0.32, 0.18), "", "")
    walls = (
        wall("north", (-2.0, 2.0), (12.0, 2.0)),
        wall("south", (-2.0, -2.0), (12.0, -2.0)),
        wall("end", (12.0, -2.0), (12.0, 2.0)),
        wall("right of the doorway", (8.0, -2.0), (8.0, -0.6)),
        wall("left of the doorway", (8.0, 0.6), (8.0, 2.0)),
    )
    areas = (
        Area("corridor 1", "corridor", rectangle(-2.0, 8.0), "corridor"),
        Area("room 1", "room", rectangle(8.0, 12.0), "store"),
    )
    return Scene(
        "office-test", (0.0, 0.0, 0.0), (10.0, 0.0), (-2.0, -2.0), (12.0, 2.0), "floor_tiles", 3.0,
        walls, (machine, bin_, door), (), areas=areas,
    )  # fmt: skip


SCENE = small_scene()


@pytest.fixture(scope="module")
def grid() -> NavGrid:
    return robot_grid(SCENE, "go2")


@pytest.fixture(scope="module")
def twin() -> Iterator[IdWorld]:
    with closing(IdWorld(SCENE, appearances(1, 3, SCENE.name), "go2")) as world:
        yield world


@pytest.fixture(scope="module")
def camera() -> Iterator[CameraWorld]:
    with closing(CameraWorld(SCENE, people=1, seed=3)) as world:
        yield world


def state(
    person: tuple[float, float, float] = AWAY, x: float = 0.0, y: float = 0.0, turn: float = 0.0, pitch: float = 0.0
) -> np.ndarray:
    """A standing Go2 and one person (x, y, heading)."""
    body = np.concatenate(((x, y, 0.31), quaternion_xyzw(0.0, pitch, turn), np.zeros(12)))
    return np.concatenate((body, person, np.zeros(RENDER_FIELDS - 3)))


def labelled(twin: IdWorld, grid: NavGrid, robot: np.ndarray, side: int = SIDE) -> Labels:
    """Labels of what the robot sees."""
    people = robot[twin.mount.fields :].reshape(1, -1)
    ids = twin.ids(robot, PIXELS)
    return SceneLabels(SCENE, grid, side).of(ids, view_of(robot, twin.mount), people, (robot[0], robot[1]))


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def changed(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Where two pictures differ, in a picture of the twin's size."""
    off = (np.abs(a.astype(int) - b.astype(int)).max(axis=2) > 12).astype(np.float32)
    return cv2.resize(off, (PIXELS, PIXELS), interpolation=cv2.INTER_AREA) >= 0.5


@pytest.mark.parametrize(("turn", "pitch"), [(0.0, 0.0), (0.4, 0.1), (-0.2, -0.08)])
def test_the_twin_shows_a_thing_where_the_picture_changes_when_it_is_taken_away(
    twin: IdWorld, camera: CameraWorld, turn: float, pitch: float
) -> None:
    robot = state(x=2.5, turn=turn, pitch=pitch)
    rest = tuple(thing for thing in SCENE.objects if thing.label != "machine")
    with closing(CameraWorld(dataclasses.replace(SCENE, objects=rest), people=1, seed=3)) as bare:
        seen = changed(camera.render(robot, 128, 128, 16 / 9), bare.render(robot, 128, 128, 16 / 9))
    number = twin.first_person - len(SCENE.objects)
    assert seen.sum() > 100
    assert overlap(seen, twin.ids(robot, PIXELS) == number) > 0.85


def test_the_twin_shows_a_person_where_the_picture_changes_when_they_leave(twin: IdWorld, camera: CameraWorld) -> None:
    with_somebody, without = state((3.0, -0.5, 1.0)), state()
    seen = changed(camera.render(with_somebody, 128, 128, 16 / 9), camera.render(without, 128, 128, 16 / 9))
    number = twin.first_person
    assert overlap(seen, twin.ids(with_somebody, PIXELS) == number) > 0.75
    assert not (twin.ids(without, PIXELS) == number).any()


def test_the_machine_is_on_the_left_with_its_colour_and_distance(twin: IdWorld, grid: NavGrid) -> None:
    found = labelled(twin, grid, state())
    there = found["thing"] == CLASSES.index("vending_machine")
    columns = np.flatnonzero(there.any(axis=0))
    assert len(columns) and columns.max() < SIDE / 2
    assert set(found["rank"][there]) == {LANDMARK}
    assert set(found["colour"][there]) == {COLOUR_WORDS.index("red")}
    assert found["thing_m"][there].min() == pytest.approx(hypot(4.45 - EYE, 1.0), rel=0.03)


def test_the_floor_is_as_far_away_as_it_looks_down_on_it(twin: IdWorld, grid: NavGrid) -> None:
    robot = state()
    view = view_of(robot, twin.mount)
    down = radians(2.0) + atan((1 - 1 / PIXELS) * tan(radians(50.0)) / (16 / 9))
    nearest = labelled(twin, grid, robot)["near_m"][-1, SIDE // 2]
    assert nearest == pytest.approx(view.eye[2] / tan(down), rel=0.05)


def test_the_way_ahead_leads_through_the_doorway_into_the_room(twin: IdWorld, grid: NavGrid) -> None:
    found = labelled(twin, grid, state(x=3.0))
    ahead = slice(COLUMNS // 2 - 1, COLUMNS // 2 + 1)
    assert {OPENINGS[kind] for kind in found["open_kind"][ahead]} == {"room"}
    assert found["open_m"][ahead] == pytest.approx(8.0 - 3.0 - EYE, abs=0.15)
    assert found["free_m"][ahead] == pytest.approx(12.0 - 0.075 - 0.2 - 3.0 - EYE, abs=0.2)
    assert OPENINGS[int(found["place"])] == "corridor"


def test_beside_the_way_the_floor_ends_at_the_wall(twin: IdWorld, grid: NavGrid) -> None:
    found = labelled(twin, grid, state())
    for column, wall_y in ((0, 2.0), (COLUMNS - 1, -2.0)):
        angle = bearing_rad(tan(radians(50.0)), column, COLUMNS)
        assert np.sign(angle) == np.sign(wall_y)
        assert found["free_m"][column] == pytest.approx((2.0 - 0.075 - 0.2) / abs(sin(angle)), abs=0.2)
        assert found["open_kind"][column] == 0


@pytest.mark.parametrize(("heading", "octant"), [(0.0, 0), (pi / 2, 2), (pi, 4), (-pi / 2, 6)])
def test_a_persons_heading_is_relative_to_the_camera(twin: IdWorld, grid: NavGrid, heading: float, octant: int) -> None:
    for turn in (0.0, 0.5):
        where = (3.0 * np.cos(turn), 3.0 * np.sin(turn) * 0.4, heading)
        found = labelled(twin, grid, state(where, turn=turn * 0.4))
        there = found["thing"] == PERSON
        assert there.any() and set(found["rank"][there]) == {SOMEBODY}
        bearing = np.arctan2(where[1], where[0] - EYE)
        assert set(found["facing"][there]) == {round((heading - bearing) / (pi / 4)) % 8}
        assert turn or set(found["facing"][there]) == {octant}
        assert (found["facing"][~there] == NONE).all()


def test_a_person_in_front_of_a_machine_is_what_matters(twin: IdWorld, grid: NavGrid) -> None:
    found = labelled(twin, grid, state((3.5, 0.9, 0.0)))
    alone = labelled(twin, grid, state())
    machine = CLASSES.index("vending_machine")
    both = (alone["thing"] == machine) & (found["thing"] == PERSON)
    assert both.any()
    assert found["thing_m"][both].max() < alone["thing_m"][both].min()


def test_distances_never_leave_their_bounds(twin: IdWorld, grid: NavGrid) -> None:
    for robot in (state(turn=pi / 2, y=1.4), state(x=11.5), state(pitch=0.3), state(turn=pi)):
        found = labelled(twin, grid, robot)
        for name in ("near_m", "thing_m"):
            assert np.isfinite(found[name]).all() and found[name].min() >= 0.09 and found[name].max() <= FAR_M
        assert (found["near_m"] <= found["thing_m"]).all()


def test_a_doorway_far_ahead_at_the_side_is_an_opening(twin: IdWorld) -> None:
    walls = [each for each in SCENE.walls if each.label != "north"]
    walls += [wall("north 1", (-2.0, 2.0), (4.5, 2.0)), wall("north 2", (5.7, 2.0), (12.0, 2.0))]
    walls += [wall(f"side {x}", (x, 2.0), (x, 6.0)) for x in (2.0, 8.0)] + [wall("back", (2.0, 6.0), (8.0, 6.0))]
    room = Area("room 2", "room", ((2.0, 2.0), (8.0, 2.0), (8.0, 6.0), (2.0, 6.0)), "office")
    scene = dataclasses.replace(
        SCENE, floor_max_m=(12.0, 6.0), walls=tuple(walls), areas=(*SCENE.areas, room), objects=()
    )
    robot = state(x=0.5, y=-0.5)
    ids = np.zeros((PIXELS, PIXELS), np.uint16)
    seen = SceneLabels(scene, robot_grid(scene, "go2"), SIDE).of(
        ids, view_of(robot, twin.mount), np.zeros((0, RENDER_FIELDS)), (0.5, -0.5)
    )
    left = np.flatnonzero(seen["open_kind"][: COLUMNS // 2 - 2] == OPENINGS.index("room"))
    assert len(left)
    assert seen["open_m"][left] == pytest.approx(5.0, abs=1.0)


def test_labels_of_the_mirrored_picture_are_those_of_the_mirrored_place(twin: IdWorld, grid: NavGrid) -> None:
    there = labelled(twin, grid, state((3.0, 0.6, 0.4)))
    mirrored = {name: mirrored_label(name, label) for name, label in there.items()}
    assert np.array_equal(mirrored["main"], there["main"][:, ::-1])
    assert np.array_equal(mirrored["free_m"], there["free_m"][::-1])
    assert mirrored["place"] == there["place"]
    facing, other = there["facing"][:, ::-1], mirrored["facing"]
    assert np.array_equal(other == NONE, facing == NONE)
    assert set((facing[facing != NONE].astype(int) + other[other != NONE]) % 8) == {0}
    again = {name: mirrored_label(name, label) for name, label in mirrored.items()}
    assert all(np.array_equal(again[name], label) for name, label in there.items())
