"""A tour records along a described route what a drive would record there, with true text once a second."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from math import hypot
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge.core.geometry import SE2
from export.core.typed import plain
from sim_hil.benchmark.policies.expert import driving_of
from tests.support.train.train_drives import made_up_drive, write_dataset
from tests.support.train.training_scenarios import progress_of, scenarios
from tools.train.collect.collection import Collection, build_tours, tour_anchors
from tools.train.collect.record import CameraSettings, Recorded
from tools.train.collect.tour_world import KinematicBase, TourWorld, record_tour
from tools.train.collect.worker import Order, messages
from tools.train.config.checks import TrainError
from tools.train.config.collect import CollectConfig, TourConfig
from tools.train.drives.drive import TOUR_DRIVER, Dataset, Drive
from tools.train.drives.scenarios import Scenario
from tools.train.run.distributed import SINGLE
from tools.train.run.job import QuietProgress
from tools.train.samples.anchors import Anchor
from tools.train.samples.mirror import Joined, Seconds, SecondsDataset, Views

STRAIGHT = np.stack((np.arange(0, 8, 0.1), np.zeros(80)), axis=1)


@pytest.fixture(scope="module")
def tour_world() -> Iterator[TourWorld]:
    with closing(TourWorld(scenarios("office")[0].site, 10)) as made:
        yield made


def _tour(tour_world: TourWorld, scenario: Scenario, config: TourConfig) -> Recorded:
    return record_tour(
        scenario, tour_world, config, CameraSettings(), "none", CollectConfig(), np.random.default_rng(3)
    )


@pytest.fixture(scope="module")
def straight_there() -> Iterator[Recorded]:
    with closing(TourWorld(scenarios("office")[0].site, 10)) as tour_world:
        yield _tour(tour_world, scenarios("office")[0], TourConfig(stray_share=0.0, linger_s=8.0))


@pytest.fixture(scope="module")
def with_a_detour(tour_world: TourWorld) -> Recorded:
    return _tour(tour_world, scenarios("office")[0], TourConfig(stray_share=1.0))


@pytest.mark.slow
def test_it_begins_where_the_episode_does_and_stays_where_it_arrives(straight_there: Recorded) -> None:
    episode, pose = scenarios("office")[0].episode, straight_there.arrays["pose"]
    assert tuple(pose[0]) == pytest.approx(episode.start)
    assert hypot(*(pose[-1, :2] - np.array(episode.goal_xy))) < 0.7 * episode.threshold_m
    assert np.max(np.hypot(*np.diff(pose[-10:, :2], axis=0).T)) == 0.0
    assert np.max(np.hypot(*straight_there.arrays["plan_xy"][-1].T)) < 0.3


@pytest.mark.slow
def test_it_moves_no_faster_than_a_policy_may_and_only_where_the_robot_fits(straight_there: Recorded) -> None:
    scenario, pose = scenarios("office")[0], straight_there.arrays["pose"]
    assert np.max(np.hypot(*np.diff(pose[:, :2], axis=0).T)) <= 0.08 + 1e-9
    assert all(scenario.site.robot_grid(scenario.episode.robot).is_free(x, y) for x, y, _ in pose)


@pytest.mark.slow
def test_the_waypoint_of_three_seconds_lies_on_the_way_ahead(straight_there: Recorded) -> None:
    path = np.array(scenarios("office")[0].task.path)
    dense = np.concatenate([np.linspace(a, b, 50) for a, b in itertools.pairwise(path)])
    gaps = []
    for pose, plan in zip(straight_there.arrays["pose"][::10], straight_there.arrays["plan_xy"][::10], strict=True):
        there = SE2(*map(float, pose)) @ SE2(float(plan[0, 0]), float(plan[0, 1]), 0.0)
        gaps.append(np.min(np.hypot(*(dense - (there.x_m, there.y_m)).T)))
    assert np.median(gaps) < 0.6


@pytest.mark.slow
def test_it_goes_off_the_way_and_comes_back_to_it(straight_there: Recorded, with_a_detour: Recorded) -> None:
    progress, goal = progress_of(scenarios("office")[0]), scenarios("office")[0].episode.goal_xy

    def strayed_m(tour: Recorded) -> float:
        return max(progress.strayed_m(SE2(*map(float, pose))) for pose in tour.arrays["pose"])

    assert strayed_m(straight_there) < 1.0 < 1.5 < strayed_m(with_a_detour)
    assert hypot(*(with_a_detour.arrays["pose"][-1, :2] - np.array(goal))) < 1.05


@pytest.mark.slow
def test_its_plan_is_turn_back_where_the_route_lies_behind_it(with_a_detour: Recorded) -> None:
    plans = with_a_detour.arrays["plan_xy"][::10, 0]
    behind = np.abs(np.arctan2(plans[:, 1], plans[:, 0])) > 2.0
    says = np.array([trace["plan"] == "turn back" for trace in with_a_detour.traces])
    assert behind.any() and says[behind].all() and not says.all()


@pytest.mark.slow
def test_other_numbers_make_other_tours_and_more_of_them_the_same(tmp_path: Path) -> None:
    dataset = write_dataset(tmp_path, [made_up_drive("a", 40)])
    config = CollectConfig(kinds={"corridor": 1.0}, jobs=1)

    def made(**changed: Any) -> Dataset:
        numbers = TourConfig(**{"count": 1, "per_layout": 2, "people_most": 0, **changed})
        return build_tours(dataset, numbers, config, 3, ranks=SINGLE, progress=QuietProgress())

    two = made(count=2)
    assert made().entries == two.entries[:1] and made().folder == two.folder
    assert made(linger_s=1.0).folder != two.folder


@pytest.mark.slow
def test_its_kinds_of_scenes_are_those_of_the_drives_or_its_own(tmp_path: Path) -> None:
    dataset = write_dataset(tmp_path, [made_up_drive("a", 40)])
    config = CollectConfig(kinds={"warehouse": 1.0}, jobs=1)

    def kind_of(**kinds: float) -> str:
        numbers = TourConfig(count=1, per_layout=1, people_most=0, kinds=kinds)
        (entry,) = build_tours(dataset, numbers, config, 3, ranks=SINGLE, progress=QuietProgress()).entries
        return entry.kind

    assert (kind_of(), kind_of(corridor=1.0)) == ("warehouse", "corridor")


@pytest.mark.slow
def test_a_layout_that_is_held_out_is_shown_by_no_tour(tmp_path: Path) -> None:
    config = CollectConfig(kinds={"warehouse": 1.0}, jobs=1)
    numbers = TourConfig(count=1, per_layout=1, people_most=0)

    def made(folder: Path, drive: Drive) -> Dataset:
        dataset = write_dataset(folder, [drive])
        return build_tours(dataset, numbers, config, 3, ranks=SINGLE, progress=QuietProgress())

    shown = made(tmp_path / "a", made_up_drive("a", 40)).entries[0]
    about = made_up_drive("a", 40).about
    seed = next(seed for seed in range(100, 400) if replace(about, kind="warehouse", layout_seed=seed).is_val)
    held = replace(made_up_drive("a", 40), about=replace(about, kind="warehouse", layout_seed=seed))
    assert len(made(tmp_path / "b", held)) == 1
    entry = Dataset.open(tmp_path / "b").entries[0]
    same = Dataset(tmp_path / "b", (replace(entry, layout_seed=shown.layout_seed),))
    assert not len(build_tours(same, numbers, config, 3, ranks=SINGLE, progress=QuietProgress()))


@pytest.mark.slow
def test_a_body_glides_along_a_route_and_not_through_walls() -> None:
    scenario = scenarios("office")[0]
    x, y, heading = scenario.episode.start
    driving = replace(driving_of("go2"), speed_mps=0.8)
    grid = scenario.site.robot_grid("go2")
    body = KinematicBase(SE2(x, y, heading), driving, grid, np.random.default_rng(0))
    start, c, s = np.array((x, y)), np.cos(heading), np.sin(heading)
    for _ in range(600):  # far beyond any wall
        along = (np.array((body.pose.x_m, body.pose.y_m)) - start) @ (c, s)
        body.step(start + (along + STRAIGHT[:, :1]) * (c, s))
        assert grid.is_free(body.pose.x_m, body.pose.y_m)


@pytest.mark.slow
def test_its_process_writes_a_drive_that_can_be_read_in_seconds(tmp_path: Path) -> None:
    (tmp_path / "drives").mkdir()
    config = CollectConfig(kinds={"corridor": 1.0})
    order = Collection("w", 1, 3, 0, config, tour=TourConfig(count=1, per_layout=1)).orders(tmp_path, lambda _: False)
    said = [message for message in messages(plain(order[0])) if "drive" in message]
    drive = Drive.load(tmp_path / "drives" / "w00000.safetensors")
    assert said[0]["drive"]["driver"] == drive.about.driver == TOUR_DRIVER
    assert np.array_equal(Seconds(drive, False).frame(1), drive.frame(10))
    assert np.array_equal(Seconds(drive, True).frame(1), drive.frame(10)[:, ::-1])
    with pytest.raises(TrainError, match="frame 7 has no image"):
        drive.frame(7)


@pytest.mark.slow
def test_a_process_of_several_layouts_records_what_a_process_of_each_would(tmp_path: Path) -> None:
    (tmp_path / "drives").mkdir()
    tour = TourConfig(count=4, per_layout=1, people_most=2)
    first = Collection("w", 3, 3, 0, CollectConfig(), tour=tour).orders(tmp_path, lambda drive_id: drive_id == "w00001")
    assert len(first) == 1

    def recorded(order: Order) -> list[Any]:
        return [message["drive"] for message in messages(plain(order)) if "drive" in message]

    alone = [replace(first[0], start=number, count=1, skip=()) for number in (0, 2)]
    together = recorded(first[0])
    assert [entry["id"] for entry in together] == ["w00000", "w00002"]
    assert len({entry["layout_seed"] for entry in together}) == 2
    assert together == [entry for order in alone for entry in recorded(order)]


def test_seconds_with_a_person_in_the_path_are_left_out(tmp_path: Path) -> None:
    def says(motion: str) -> int:
        drive = made_up_drive(f"w{len(motion)}", 40)
        traces = tuple({**trace, "motion": motion if trace["k"] == 10 else "nobody near"} for trace in drive.traces)
        relabelled = replace(drive, about=replace(drive.about, traces=traces))
        dataset = write_dataset(tmp_path / f"{len(motion)}", [relabelled])
        return sum(anchor.k == 10 for anchor in tour_anchors(dataset, dataset.ids))

    assert says("person ahead 2 m coming") == says("person left 1 m standing, person ahead 1 m leaving") == 0
    assert says("person ahead 5 m coming") == says("person right 1 m leaving") == 1


class _Tokens:
    """Rows that say of which kind and second they are."""

    def __init__(self, kind: int) -> None:
        self._kind = kind

    def frames(self, drive_id: str) -> np.ndarray:
        return np.stack([np.full((2, 3), 100 * self._kind + k, np.float16) for k in range(40)])


def test_a_tours_anchor_is_seen_by_its_seconds_and_its_mirror_image(tmp_path: Path) -> None:
    dataset = write_dataset(tmp_path, [made_up_drive("w1", 40)])
    anchor: Anchor = next(each for each in tour_anchors(dataset, dataset.ids) if each.k == 30)
    views = Views(_Tokens(1), Joined(_Tokens(2), _Tokens(3), frozenset(("w1",))), _Tokens(4))
    assert [int(each[0, 0]) for each in views.of(anchor)] == [400, 403]
    assert [int(each[0, 0]) for each in views.of(anchor, in_mirror=True)] == [300, 303]
    assert SecondsDataset.of(dataset).entries[0].frames == 4
    with pytest.raises(ValueError, match="of its seconds"):
        Views(_Tokens(1)).of(anchor)
