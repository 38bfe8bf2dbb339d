"""Tasks of a soak: drawn from the robot's pose, tracked by ground truth."""

from __future__ import annotations

from math import hypot, pi
from pathlib import Path

import numpy as np
import pytest

from edge.core.cli import EXIT_BAD_INPUT
from edge.reasoning.told_turn import split_turn
from sim_hil.benchmark.language.instruction_words import AROUND
from sim_hil.benchmark.suite.robots import footprint_m, robot_grid
from sim_hil.realtime.truth import TruePose, TruthTail
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Scene, load_scene
from sim_hil.soak.cli import main
from sim_hil.soak.tasks import LENGTH_M, Journey, SoakTask, TaskRun

S = 1_000_000_000
SMALL_ROOM = """
name = "room"
start = [0.0, 0.0, 0.0]
goal_xy = [1.0, 0.0]
ceiling_height_m = 2.6
[floor]
min_m = [-1.5, -1.5]
max_m = [1.5, 1.5]
texture = "floor_tiles"
[[areas]]
label = "room"
kind = "room"
name = "room"
polygon = [[-1.5, -1.5], [1.5, -1.5], [1.5, 1.5], [-1.5, 1.5]]
[[objects]]
label = "plant"
kind = "plant"
landmark = "plant"
position_m = [1.2, 1.2, 0.0]
heading_deg = 180
size_m = [0.3, 0.3, 1.0]
colour = [0.2, 0.4, 0.2]
"""
"""Every task in it would be shorter than a soak's."""


@pytest.fixture(scope="module")
def office() -> Scene:
    return load_scene("office")


def test_a_scene_without_a_reachable_task_is_refused_before_the_first_leg(
    artifacts_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "soak"
    (tmp_path / "room.toml").write_text(SMALL_ROOM)
    scenes = ["--scene", "office", "--scene", str(tmp_path / "room.toml")]
    assert main(["--artifacts", str(artifacts_dir), "--duration", "10m", *scenes, "--out", str(out)]) == EXIT_BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert "scene room: no task found in 24 tries (" in line and not out.exists()


@pytest.mark.slow
def test_a_task_begins_at_the_robot_and_has_a_feasible_path(office: Scene) -> None:
    journey = Journey(office, seed=1, leg=1, speed_mps=0.8)
    grid = NavGrid(office, clearance_m=footprint_m("go2"))
    at = journey.begin()
    for number in (1, 2, 3, 4):
        task = journey.next(at)
        assert task is not None and task.start == at and task.instruction and task.number == number
        assert LENGTH_M[0] <= task.shortest_m <= LENGTH_M[1]
        assert task.shortest_m == pytest.approx(grid.distance_m((at[0], at[1]), task.goal_xy), rel=0.03)
        at = (*task.goal_xy, 0.0)


@pytest.mark.slow
def test_a_robot_that_does_not_face_its_route_is_told_to_turn_around(office: Scene) -> None:
    for heading, first in ((0.0, ""), (pi, AROUND)):
        tasks = [Journey(office, seed, leg=1, speed_mps=0.8).next((14.0, 10.6, heading)) for seed in (1, 2)]
        assert [None if task is None else task.first for task in tasks] == [first, first]
        told = [task is not None and split_turn(task.instruction)[0] is not None for task in tasks]
        assert told == [bool(first)] * 2


@pytest.mark.slow
def test_the_same_seed_gives_the_same_tasks(office: Scene) -> None:
    first, second = (Journey(office, seed=4, leg=2, speed_mps=0.8) for _ in range(2))
    at = first.begin()
    assert second.begin() == at and first.next(at) == second.next(at)


@pytest.mark.slow
def test_a_task_exists_from_every_free_place(office: Scene) -> None:
    journey = Journey(office, seed=1, leg=1, speed_mps=0.1)
    grid = NavGrid(office, clearance_m=footprint_m("go2"))
    rng = np.random.default_rng(0)
    (x0, y0), (x1, y1) = office.floor_min_m, office.floor_max_m
    found = 0
    while found < 6:
        at = (float(rng.uniform(x0, x1)), float(rng.uniform(y0, y1)), float(rng.uniform(-3, 3)))
        if grid.is_free(at[0], at[1]):
            found += 1
            assert journey.next(at) is not None, at


def test_a_robot_in_a_pocket_between_furniture_gets_a_task() -> None:
    """The nearest free cell of the pose lies in a pocket that no path leaves; seen in a soak, where the leg ended."""
    scene = load_scene("hospital")
    at = (3.145, 12.885, -0.41)
    grid = robot_grid(scene, "go2")
    task = Journey(scene, seed=1, leg=1, speed_mps=0.8).next(at)
    assert task is not None and task.start == at
    assert grid.path(at[:2], task.goal_xy) is None
    begin = grid.nearest_in_largest_space(at[0], at[1])
    straight_m = hypot(begin[0] - at[0], begin[1] - at[1])
    assert 0 < straight_m < 1.5
    assert task.shortest_m == pytest.approx(straight_m + grid.distance_m(begin, task.goal_xy), rel=1e-6)


def task(goal: tuple[float, float] = (10.0, 0.0), timeout_s: float = 30.0) -> SoakTask:
    return SoakTask(1, "go there", (0.0, 0.0, 0.0), goal, "door", hypot(*goal), timeout_s)


def pose(t_s: float, x: float, y: float = 0.0, touching: tuple[str, ...] = ()) -> TruePose:
    return TruePose(round(t_s * S), x, y, 0.0, touching)


def test_a_task_is_reached_within_one_and_a_half_metres() -> None:
    run = TaskRun(task(), 0)
    assert [run.add(pose(t, t)) for t in range(9)] == [None] * 9
    assert run.add(pose(8.6, 8.6)) == "reached"
    outcome = run.outcome("reached")
    assert outcome["success"] and outcome["ne_m"] == pytest.approx(1.4) and outcome["time_s"] == pytest.approx(8.6)


def test_spl_is_less_for_a_detour_and_nothing_without_success() -> None:
    run = TaskRun(task(), 0)
    for at in ((0, 0), (0, 9), (9, 9), (9, 0)):
        run.add(pose(1.0, *at))
    assert run.outcome("reached")["spl"] == pytest.approx(100 * 10 / 27, abs=0.01)
    assert run.outcome("timeout")["spl"] == 0.0


def test_a_task_ends_at_its_timeout() -> None:
    run = TaskRun(task(timeout_s=5.0), 2 * S)
    assert run.add(pose(6.9, 1.0)) is None and run.add(pose(7.0, 1.0)) == "timeout"


def test_poses_before_the_task_do_not_count() -> None:
    run = TaskRun(task(), 5 * S)
    run.add(pose(4.0, 9.5, touching=("wall 1",)))
    run.add(pose(5.5, 1.0))
    run.add(pose(6.0, 2.0))
    outcome = run.outcome("cut")
    assert outcome["path_m"] == pytest.approx(1.0) and outcome["collisions"] == []


def test_each_touched_object_is_counted_once() -> None:
    run = TaskRun(task(), 0)
    for t in range(3):
        run.add(pose(t, t, touching=("person", "wall 1")))
    assert run.outcome("timeout")["collisions"] == ["person", "wall 1"]


def test_a_trace_is_read_in_complete_lines_while_it_grows(tmp_path: Path) -> None:
    path = tmp_path / "trace.jsonl"
    tail = TruthTail(path)
    assert tail.update() == [] and tail.newest is None
    text = '{"kind": "pose", "t_ns": 1, "x": 1.0, "y": 2.0, "theta": 0.5, "touching": ["wall 1"]}\n'
    path.write_text('{"kind": "scene", "t_ns": 0}\n' + text + text[:30], encoding="utf-8")
    assert tail.update() == [TruePose(1, 1.0, 2.0, 0.5, ("wall 1",))]
    with path.open("a", encoding="utf-8") as stream:
        stream.write(text[30:])
    assert len(tail.update()) == 1 and tail.update() == []
