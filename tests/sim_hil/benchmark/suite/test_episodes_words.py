"""Instructions: told from geometry, worded in thousands of ways, read back, split between benchmark and training."""

from __future__ import annotations

from dataclasses import replace
from math import cos, pi, radians, sin

import numpy as np
import pytest

from edge.reasoning.told_turn import split_turn
from sim_hil import layouts
from sim_hil.benchmark.language.instruction_reading import Claim, read, untrue
from sim_hil.benchmark.language.instruction_words import AROUND
from sim_hil.benchmark.language.instructions import WordingError, is_held_out, pattern, wordings
from sim_hil.benchmark.language.route import RouteDescription, RouteError
from sim_hil.benchmark.language.tasks import Task, facing, make_task, sample_task
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Area, Scene, SceneObject, Wall

KINDS = layouts.KINDS


def wall(label: str, x0: float, y0: float, x1: float, y1: float) -> Wall:
    return Wall(label, (x0, y0), (x1, y1), 0.15, 2.6, "wall_office")


def box(x0: float, y0: float, x1: float, y1: float) -> tuple[tuple[float, float], ...]:
    return ((x0, y0), (x1, y0), (x1, y1), (x0, y1))


def comb() -> Scene:
    """A corridor along x (y 0..2.4) with three side corridors to its left at x = 4, 10 and 16, and a room to its right.

    The last side corridor is where the corridor ends. A machine stands at the far end of the second one.
    """
    sides = [4.0, 10.0, 16.0]
    walls = [wall("west", 0, 0, 0, 2.4), wall("east", 18, 0, 18, 8), wall("top", 0, 8, 18, 8)]
    edges = [0.0, *(v for x in sides for v in (x, x + 2.0)), 18.0]
    for index, (a, b) in enumerate(zip(edges[::2], edges[1::2], strict=True)):
        if b - a > 0.1:
            walls.append(wall(f"left {index}", a, 2.4, b, 2.4))
            walls += [wall(f"side {index} {x}", x, 2.4, x, 8) for x in (a, b) if 0 < x < 18]
    walls += [wall("right 1", 0, 0, 12, 0), wall("right 2", 13.2, 0, 18, 0), wall("room", 8, -4, 17, -4)]
    walls += [wall("room west", 8, -4, 8, 0), wall("room east", 17, -4, 17, 0)]
    areas = [Area("corridor 1", "corridor", box(0, 0, 18, 2.4), "corridor"),
             Area("room 1", "room", box(8, -4, 17, 0), "office")]  # fmt: skip
    areas += [Area(f"corridor {i + 2}", "corridor", box(x, 2.4, x + 2, 8), "corridor") for i, x in enumerate(sides)]
    things = [
        SceneObject("machine", "vending_machine", (11.0, 7.4, 0.0), -pi / 2, (0.8, 1.1, 1.9), (0.8, 0.1, 0.1), "",
                    "red vending machine"),
        SceneObject("plant", "plant", (7.0, 0.4, 0.0), pi / 2, (0.4, 0.4, 1.2), (0.1, 0.5, 0.1), "", "potted plant"),
        SceneObject("shelf", "shelf", (8.4, -2.0, 0.0), 0.0, (0.35, 1.2, 1.9), (0.6, 0.4, 0.2), "", "bookshelf"),
    ]  # fmt: skip
    return Scene("comb", (1.0, 1.2, 0.0), (11.0, 6.0), (-0.1, -4.1), (18.1, 8.1), "floor_tiles", 2.6, tuple(walls),
                 tuple(things), (), areas=tuple(areas))  # fmt: skip


@pytest.fixture(scope="module")
def way() -> RouteDescription:
    scene = comb()
    machine = next(thing for thing in scene.objects if thing.label == "machine")
    return make_task(scene, NavGrid(scene, clearance_m=0.4), (1.0, 1.2, 0.0), machine).route


def test_a_route_is_described_by_turn_count_and_landmarks(way: RouteDescription) -> None:
    (step,) = way.steps
    assert (step.side, step.kind, step.ordinal, step.at_end) == ("left", "corridor", 2, False)
    assert [(thing.name, thing.side) for thing in step.passed] == [("potted plant", "right")]
    assert (way.goal_name, way.goal_bare) == ("red vending machine", "vending machine")
    assert way.goal_at_end


def test_doors_are_counted_apart_from_corridors() -> None:
    scene = comb()
    shelf = next(thing for thing in scene.objects if thing.label == "shelf")
    route = make_task(scene, NavGrid(scene, clearance_m=0.4), (1.0, 1.2, 0.0), shelf).route
    (step,) = route.steps
    assert (step.side, step.kind, step.ordinal) == ("right", "room", 1)


def test_a_turn_at_the_end_of_a_corridor_is_described_as_such() -> None:
    scene = comb()
    moved = [replace(thing, position_m=(17.0, 7.4, 0.0)) if thing.label == "machine" else thing
             for thing in scene.objects]  # fmt: skip
    scene = replace(scene, objects=tuple(moved))
    route = make_task(scene, NavGrid(scene, clearance_m=0.4), (1.0, 1.2, 0.0), moved[0]).route
    assert (route.steps[0].ordinal, route.steps[0].at_end) == (3, True)


def test_a_start_right_beside_an_opening_that_counts_is_refused() -> None:
    scene = comb()
    machine = scene.objects[0]
    with pytest.raises(RouteError, match="beside the start"):
        make_task(scene, NavGrid(scene, clearance_m=0.4), (5.0, 1.2, 0.0), machine)


def tee(door_x: float) -> Scene:
    """A corridor north (x 4..6) into one along x (y 8..10.4), which has a corridor back south (x 15..17) to its right.

    To its left there are two rooms: one with its door from door_x, and one with its door at x = 12.
    """
    edges = [0.0, door_x, door_x + 1.2, 12.0, 13.2, 18.0]
    walls = [wall(f"north {a}", a, 10.4, b, 10.4) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    walls += [wall(f"south {a}", a, 8, b, 8) for a, b in ((0, 4), (6, 15), (17, 18))]
    walls += [wall(f"side {x}", x, 0, x, 8) for x in (4, 6, 15, 17)]
    walls += [wall(f"room {x}", x, 10.4, x, 14) for x in (0, 8, 18)] + [wall("top", 0, 14, 18, 14)]
    walls += [wall("west", 0, 8, 0, 10.4), wall("east", 18, 8, 18, 10.4), wall("bottom", 4, 0, 17, 0)]
    areas = (Area("corridor 1", "corridor", box(4, 0, 6, 8), "corridor"),
             Area("corridor 2", "corridor", box(0, 8, 18, 10.4), "corridor"),
             Area("corridor 3", "corridor", box(15, 0, 17, 8), "corridor"),
             Area("room 1", "room", box(0, 10.4, 8, 14), "office"),
             Area("room 2", "room", box(8, 10.4, 18, 14), "office"))  # fmt: skip
    things = (SceneObject("machine", "vending_machine", (16.0, 0.6, 0.0), pi / 2, (0.8, 1.1, 1.9), (0.8, 0.1, 0.1), "",
                          "red vending machine"),
              SceneObject("shelf", "shelf", (17.4, 12.5, 0.0), pi, (0.35, 1.2, 1.9), (0.6, 0.4, 0.2), "",
                          "bookshelf"))  # fmt: skip
    return Scene("tee", (5.0, 1.0, pi / 2), (16.0, 2.0), (-0.1, -0.1), (18.1, 14.1), "floor_tiles", 2.6, tuple(walls),
                 things, (), areas=areas)  # fmt: skip


def told_in_tee(door_x: float, goal: str) -> RouteDescription:
    scene = tee(door_x)
    thing = next(thing for thing in scene.objects if thing.label == goal)
    return make_task(scene, NavGrid(scene, clearance_m=0.4), (5.0, 1.0, pi / 2), thing).route


def test_a_door_straight_across_from_where_one_comes_out_is_counted_by_some_and_refused() -> None:
    with pytest.raises(RouteError, match="room 1 opens right beside"):
        told_in_tee(4.4, "shelf")


def test_a_door_behind_is_not_counted() -> None:
    assert [(step.side, step.ordinal) for step in told_in_tee(1.0, "shelf").steps] == [("right", 1), ("left", 1)]


def test_the_opening_that_the_route_leaves_is_not_counted() -> None:
    assert [(step.side, step.ordinal) for step in told_in_tee(4.4, "machine").steps] == [("right", 1), ("right", 1)]


def test_an_ambiguous_goal_is_refused() -> None:
    scene = comb()
    twin = replace(scene.objects[0], label="twin", position_m=(2.5, 0.5, 0.0), heading_rad=pi / 2)
    scene = replace(scene, objects=(*scene.objects, twin))
    with pytest.raises(RouteError, match="another red vending machine"):
        make_task(scene, NavGrid(scene, clearance_m=0.4), (0.8, 1.2, 0.0), scene.objects[0])


@pytest.mark.parametrize(
    "text",
    [
        "Take the second left and stop at the vending machine.",
        "Please pass the potted plant on your right, turn left into the second corridor, then stop at the machine's "
        "side by the red vending machine.",
        "Find the red vending machine: take the second hallway on the left, follow the hallway to its end and stop.",
    ],
)  # fmt: skip
def test_true_words_are_accepted(text: str, way: RouteDescription) -> None:
    assert untrue(text, way) == []


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("Take the second right and stop at the vending machine.", "expected left, found right"),
        ("Take the first left and stop at the vending machine.", "expected number 2, found 1"),
        ("Take the second door on the left and stop at the vending machine.", "found room"),
        ("Turn left and stop at the vending machine.", "is ambiguous"),
        ("At the end of the corridor turn left, stop at the vending machine.", "is not at the end"),
        ("Take the second left, then turn left, stop at the vending machine.", "one turn too many"),
        ("Stop at the vending machine.", "leaves out"),
        ("Take the second left.", "names no goal"),
        ("Take the second left and stop at the bookshelf.", "found bookshelf"),
        ("Pass the potted plant on your left, take the second left, stop at the vending machine.", "on the right"),
        ("Take the second left and stop at the vending machine on your right.", "side of the goal: expected"),
        ("Leave the room, take the second left, stop at the vending machine.", "start is in none"),
        ("Take the second left, mind the third step, stop at the vending machine.", "cannot be read"),
    ],
)  # fmt: skip
def test_a_false_description_is_found(text: str, problem: str, way: RouteDescription) -> None:
    assert any(problem in line for line in untrue(text, way)), untrue(text, way)


def test_a_description_is_read_as_ordered_claims() -> None:
    claims = read("Go past the red bench on the left. Then turn right into the third aisle and wait at the drum.")
    assert claims == [
        Claim("pass", "left", name="red bench"), Claim("turn", "right", 3, "passage"), Claim("goal", name="drum"),
    ]  # fmt: skip


@pytest.mark.parametrize("first", [AROUND, "left", "right"])
def test_a_robot_that_does_not_face_its_route_is_told_how_to_turn(first: str, way: RouteDescription) -> None:
    for text in wordings(way, 20, 3, held_out=False, first=first):
        assert [claim.side for claim in read(text) if claim.kind == "face"] == [first]
        assert untrue(text, way, first) == []
        assert split_turn(text)[0] is not None, "the runner makes the turn"
        assert untrue(text, way) == [f"turn on the spot: expected none, found {first}"]
        assert any(f"must turn {first}" in line for line in untrue(wordings(way, 1, 3, held_out=False)[0], way, first))


def test_a_robot_in_a_room_may_be_told_to_leave_it_and_no_more(way: RouteDescription) -> None:
    inside = replace(way, leaves_room=True, steps=(replace(way.steps[0], before_kind="room"),))
    claims = [read(text) for text in wordings(inside, 40, 3, held_out=False, first=AROUND)]
    told = sum(any(claim.kind == "face" for claim in each) for each in claims)
    assert 8 < told < 32
    assert all(any(claim.kind == "face" for claim in read(text))
               for text in wordings(inside, 20, 3, held_out=True, first=AROUND))  # fmt: skip
    assert untrue(wordings(inside, 1, 3, held_out=False)[0], inside, AROUND) == []


@pytest.mark.parametrize(
    ("degrees_left", "first"),
    [(0, ""), (50, ""), (-50, ""), (70, "left"), (-110, "right"), (130, AROUND), (180, AROUND)],
)
def test_how_a_robot_turns_depends_on_where_its_path_begins(degrees_left: float, first: str) -> None:
    for heading_rad in (0.0, 3.0, -2.0):
        bearing_rad = heading_rad + radians(degrees_left)
        path = [(1.0, 2.0), (1.0 + 5 * cos(bearing_rad), 2.0 + 5 * sin(bearing_rad))]
        assert facing((1.0, 2.0, heading_rad), path) == first


@pytest.mark.slow
def test_one_way_has_thousands_of_wordings_all_true(way: RouteDescription) -> None:
    texts = [text for seed in range(25) for text in wordings(way, 50, seed, held_out=False)]
    assert len(set(texts)) > 1000
    assert len({pattern(text) for text in texts}) > 700
    assert [text for text in texts if untrue(text, way)] == []


@pytest.mark.slow
def test_benchmark_and_training_share_no_pattern(way: RouteDescription) -> None:
    ours = {pattern(text) for seed in range(10) for text in wordings(way, 20, seed, held_out=True)}
    theirs = {pattern(text) for seed in range(10) for text in wordings(way, 20, seed, held_out=False)}
    assert not ours & theirs
    assert len(ours) > 100


def test_a_pattern_depends_neither_on_landmarks_nor_on_sides_nor_on_counts() -> None:
    a = "Take the second left and stop at the red vending machine."
    b = "take the fifth right and stop at the bookshelf."
    assert pattern(a) == pattern(b)
    assert is_held_out(a) == is_held_out(b)


def test_wordings_are_the_same_for_the_same_seed_and_different_from_each_other(way: RouteDescription) -> None:
    first = wordings(way, 8, 3, held_out=True)
    assert first == wordings(way, 8, 3, held_out=True)
    assert first != wordings(way, 8, 4, held_out=True)
    assert len({pattern(text) for text in first}) == 8


def test_an_indistinguishable_turn_is_refused(way: RouteDescription) -> None:
    vague = replace(way.steps[0], ordinal=0, near=(), at_end=False)
    with pytest.raises(WordingError, match="cannot be described"):
        wordings(replace(way, steps=(vague,)), 4, 1, held_out=True)


@pytest.fixture(scope="module", params=KINDS)
def drawn(request: pytest.FixtureRequest) -> list[Task]:
    scene = layouts.generate(request.param, 4711)
    grid, rng, found = NavGrid(scene, clearance_m=0.4), np.random.default_rng((1, 2)), []
    for _ in range(60):
        try:
            found.append(sample_task(scene, grid, rng, length_m=(5.0, 60.0)))
        except RouteError:
            continue
        if len(found) == 3:
            break
    return found


@pytest.mark.slow
def test_training_scenes_yield_tasks_whose_wordings_are_true(drawn: list[Task]) -> None:
    assert len(drawn) == 3
    for index, task in enumerate(drawn):
        for text in wordings(task.route, 6, index, held_out=False):
            assert untrue(text, task.route) == [], text


@pytest.mark.slow
def test_a_task_begins_with_its_way_ahead_and_ends_at_its_landmark(drawn: list[Task]) -> None:
    for task in drawn:
        ahead = next(p for p in task.path[1:] if np.hypot(p[0] - task.start[0], p[1] - task.start[1]) > 0.2)
        away = np.arctan2(ahead[1] - task.start[1], ahead[0] - task.start[0]) - task.start[2]
        assert np.cos(away) > 0
        assert task.path[-1] == task.goal
