"""Images are rendered in their own layouts, from poses on free floor; they are reproducible and rendering resumes."""

from __future__ import annotations

import dataclasses
from math import atan2, hypot, pi
from pathlib import Path

import numpy as np
import pytest

from export.core.typed import build, plain
from sim_hil.benchmark.suite.robots import robot_grid
from sim_hil.layouts import is_reserved
from sim_hil.robots.go2.body import rotation_matrix
from sim_hil.scene.nav_grid import NavGrid
from tests.tools.train.encoder.test_encoder_labels import SCENE
from tools.train.config.checks import TrainError
from tools.train.config.encoder import MOST_SCENES, FramesConfig
from tools.train.drives import scenarios
from tools.train.encoder import worker as encoder_poses
from tools.train.encoder.data import FIRST_LAYOUT, FrameSet, Shard, fill, finish, made, path_of, plan
from tools.train.encoder.labels import label_shapes
from tools.train.encoder.worker import Poses, body_state, quaternion_xyzw, render
from tools.train.run.job import QuietProgress

SMALL = FramesConfig(count=24, held=0, per_scene=12, kinds=("corridor",), people_indoors=8, moment=4, jobs=2)


def never() -> bool:
    return False


class Counted(QuietProgress):
    """Remembers how far it was."""

    def __init__(self) -> None:
        self.seen: list[tuple[int, int]] = []

    def update(self, done: int, total: int, **numbers: float) -> None:
        self.seen.append((done, total))


@pytest.fixture(scope="module")
def shards() -> list[Shard]:
    return [dataclasses.replace(shard, people=8) for shard in plan(SMALL, 3, 8)]


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory, shards: list[Shard]) -> Path:
    """Two shards, made by two processes."""
    folder = tmp_path_factory.mktemp("frames")
    fill(folder, shards, 2, QuietProgress(), never)
    return folder


def test_held_out_layouts_are_never_learned_from_however_often_one_is_tried_again() -> None:
    shards = plan(FramesConfig(count=300_000, held=20_000), 4, 8)
    tried: dict[bool, set[int]] = {False: set(), True: set()}
    for shard in shards:
        tried[shard.held] |= {shard.layout_seed + attempt * MOST_SCENES for attempt in range(8)}
    assert tried[True] and tried[False] and not tried[True] & tried[False]


def test_no_layout_is_the_benchmarks_or_a_recorded_drives() -> None:
    highest = scenarios.RESERVED_BELOW + (scenarios.MAX_SEED + 1) * scenarios.LAYOUT_TRIES * scenarios.GROUPS
    for seed in (0, 1, 999, 2**31 - 1):
        for shard in plan(FramesConfig(count=3_000, held=500), seed, 8):
            assert shard.layout_seed >= FIRST_LAYOUT > highest and not is_reserved(shard.layout_seed)


def test_the_corridor_is_learned_from_as_it_is_and_changed_but_never_held_out() -> None:
    shards = plan(FramesConfig(count=200_000, held=20_000), 1, 8)
    corridors = [shard for shard in shards if shard.kind == "corridor"]
    assert not any(shard.held for shard in corridors)
    assert {shard.layout_seed % 2 for shard in corridors} == {0, 1}
    assert {shard.kind for shard in shards if shard.held} == {"hospital", "office", "warehouse", "sidewalk"}


def test_both_robots_and_crowds_of_all_sizes_are_in_every_kind_of_scene() -> None:
    shards = plan(FramesConfig(), 1, 8)
    for kind in ("hospital", "office", "warehouse", "sidewalk"):
        own = [shard for shard in shards if shard.kind == kind and not shard.held]
        robots = [shard.robot for shard in own]
        assert abs(robots.count("go2") - robots.count("carter")) <= 1
        assert max(shard.people for shard in own) > 40
        assert min(shard.people for shard in own) < 50
    assert all(shard.people >= 20 for shard in shards if shard.kind == "sidewalk")


def test_a_shards_key_changes_with_every_number(shards: list[Shard]) -> None:
    first = shards[0]
    others = [
        dataclasses.replace(first, layout_seed=first.layout_seed + 1),
        dataclasses.replace(first, robot="carter" if first.robot == "go2" else "go2"),
        dataclasses.replace(first, people=first.people + 1),
        dataclasses.replace(first, side=4),
        dataclasses.replace(first, sharp_share=0.5),
    ]
    assert len({first.key, *(other.key for other in others)}) == 6
    assert build(Shard, plain(first), "shard") == first


@pytest.mark.slow
def test_shards_of_several_processes_are_read_as_one_list(filled: Path, shards: list[Shard]) -> None:
    frames = FrameSet(filled, shards)
    assert len(frames) == 24
    for name, (kind, shape) in label_shapes(8).items():
        assert frames.labels[name].shape == (24, *shape) and frames.labels[name].dtype == kind
    pictures = np.array([frames.picture(index) for index in range(24)])
    assert pictures.shape == (24, 128, 128, 3) and pictures.dtype == np.uint8
    assert len({picture.tobytes() for picture in pictures}) == 24
    with pytest.raises(IndexError):
        frames.picture(24)


@pytest.mark.slow
def test_the_same_shard_comes_out_alike_in_another_process(filled: Path, shards: list[Shard], tmp_path: Path) -> None:
    assert list(render(tmp_path, shards[0]))[-1] == 12
    name = shards[0].name
    assert path_of(tmp_path, name).read_bytes() == path_of(filled, name).read_bytes()
    assert made(tmp_path, shards[0]) == made(filled, shards[0])


def fake(folder: Path, shard: Shard) -> None:
    """A file that nobody looks into."""
    path_of(folder, shard.name).write_bytes(b"pictures")
    finish(folder, shard)


def test_only_a_whole_file_of_the_same_numbers_counts(tmp_path: Path, shards: list[Shard]) -> None:
    shard = shards[0]
    assert made(tmp_path, shard) is None
    fake(tmp_path, shard)
    assert made(tmp_path, shard) is not None
    assert made(tmp_path, dataclasses.replace(shard, people=shard.people + 1)) is None
    path_of(tmp_path, shard.name).write_bytes(b"half")
    assert made(tmp_path, shard) is None


def test_picture_generation_ends_on_request(tmp_path: Path, shards: list[Shard]) -> None:
    with pytest.raises(KeyboardInterrupt):
        fill(tmp_path, shards, 1, QuietProgress(), lambda: True)


def test_a_file_that_is_not_of_pictures_is_refused(tmp_path: Path, shards: list[Shard]) -> None:
    fake(tmp_path, shards[0])
    with pytest.raises(TrainError, match="not readable"):
        FrameSet(tmp_path, shards[:1])


PEOPLE = np.array([(1.0, 0.0, 0.0), (4.0, -1.0, 0.0), (10.0, 1.0, 0.0)])
NOBODY = np.zeros((0, 3))


@pytest.fixture(scope="module")
def grid() -> NavGrid:
    return robot_grid(SCENE, "go2")


def drawn(
    grid: NavGrid, sort: str, people: np.ndarray, monkeypatch: pytest.MonkeyPatch, count: int = 60
) -> list[tuple[float, float, float]]:
    """Poses of one sort alone."""
    monkeypatch.setattr(encoder_poses, "SHARES", ((sort, 1.0),))
    poses = Poses(SCENE, grid, np.random.default_rng(1))
    return [poses.draw(people) for _ in range(count)]


def off(pose: tuple[float, float, float], x: float, y: float) -> float:
    """By how much a pose looks past a point, rad."""
    return abs((atan2(y - pose[1], x - pose[0]) - pose[2] + pi) % (2 * pi) - pi)


@pytest.mark.parametrize("sort", [name for name, _ in encoder_poses.SHARES])
def test_poses_of_every_sort_are_on_free_floor_and_clear_of_people(
    grid: NavGrid, sort: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for people in (PEOPLE, NOBODY):
        for x, y, _ in drawn(grid, sort, people, monkeypatch):
            assert grid.is_free(x, y)
            assert all(hypot(x - px, y - py) >= 0.6 for px, py, _ in people)


def test_poses_before_a_thing_have_one_in_view(grid: NavGrid, monkeypatch: pytest.MonkeyPatch) -> None:
    things = [thing.position_m[:2] for thing in SCENE.objects]
    poses = drawn(grid, "thing", NOBODY, monkeypatch)
    looking = [min(off(pose, x, y) for x, y in things) < 0.9 for pose in poses]
    assert np.mean(looking) > 0.9


def test_a_floor_full_of_people_still_gives_a_pose(grid: NavGrid) -> None:
    crowd = np.array([(x, y, 0.0) for x in np.arange(-2, 12, 0.5) for y in np.arange(-2, 2, 0.5)])
    x, y, _ = Poses(SCENE, grid, np.random.default_rng(1)).draw(crowd)
    assert grid.is_free(x, y)


@pytest.mark.parametrize(
    ("roll", "pitch", "yaw"), [(0.0, 0.0, 0.7), (0.1, 0.0, 0.0), (0.0, 0.2, 0.0), (0.1, -0.2, 2.0)]
)
def test_a_quaternion_rolls_then_pitches_then_turns(roll: float, pitch: float, yaw: float) -> None:
    matrix = rotation_matrix(quaternion_xyzw(roll, pitch, yaw))
    assert atan2(matrix[1, 0], matrix[0, 0]) == pytest.approx(yaw)
    assert -np.arcsin(matrix[2, 0]) == pytest.approx(pitch)
    assert atan2(matrix[2, 1], matrix[2, 2]) == pytest.approx(roll)


@pytest.mark.parametrize(("robot", "height"), [("go2", 0.31), ("carter", 0.0)])
def test_a_body_sways_a_little_about_its_height(robot: str, height: float) -> None:
    rng = np.random.default_rng(1)
    states = np.array([body_state(SCENE, robot, (1.0, -0.5, 0.3), rng) for _ in range(200)])
    assert states[:, :2] == pytest.approx(np.tile((1.0, -0.5), (200, 1)))
    assert states[:, 2].mean() == pytest.approx(height, abs=0.01) and states[:, 2].std() < 0.05
    up = np.array([rotation_matrix(tuple(state[3:7]))[2, 2] for state in states])
    assert up.min() > 0.95
    assert (states[:, 2].std() > 0) == (robot == "go2")
