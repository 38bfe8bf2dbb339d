"""A drive under other instructions: the same pictures and poses, and words that are true of another way along them."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import cache
from math import hypot
from pathlib import Path

import numpy as np
import pytest

from edge.core.geometry import SE2
from edge.state.reasoning_text import format_text
from sim_hil.benchmark.language.instruction_reading import untrue
from sim_hil.benchmark.language.instructions import is_held_out
from sim_hil.benchmark.language.route import RouteError
from sim_hil.benchmark.language.tasks import Task, begins_ahead, make_task
from tests.support.train.train_drives import made_up_drive, write_dataset
from tests.support.train.training_scenarios import SPEED_MPS, drive_along, scenarios
from tools.train.collect.record import off_way_m
from tools.train.config.checks import TrainError
from tools.train.config.sft import RelabelConfig
from tools.train.drives.drive import Drive
from tools.train.drives.progress_labels import RouteProgress
from tools.train.drives.scenarios import Scenario
from tools.train.samples.anchors import anchors_of
from tools.train.sft.relabel import InstructionRelabel, InstructionRelabels, relabel, relabel_along

CONFIG = RelabelConfig(ways=2, tries=24)
CROWDED = "person ahead 2 m coming, person left 3 m standing"


@cache
def _told(kind: str, number: int = 0) -> tuple[Scenario, Drive, tuple[InstructionRelabel, ...]]:
    scenario = scenarios(kind)[number]
    drive = drive_along(scenario)
    return scenario, drive, tuple(relabel(drive, scenario.site, CONFIG, 1, SPEED_MPS))


@cache
def _tasks(kind: str, number: int = 0) -> dict[tuple[float, float], Task]:
    """From the same start, by goal."""
    scenario = scenarios(kind)[number]
    found = {}
    for thing in scenario.site.goals:
        with suppress(RouteError):
            task = make_task(scenario.scene, scenario.site.grid, scenario.task.start, thing)
            found[task.goal] = task
    return found


KINDS = ("corridor", "office", "sidewalk")


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_relabel_with_its_own_route_equals_the_drive(kind: str) -> None:
    scenario, drive, _ = _told(kind)
    own = relabel_along(drive, scenario, SPEED_MPS, CONFIG.off_m)
    assert own is not None and own.wordings == drive.wordings and own.told == drive.about.told
    assert len(own.traces) > 4 and list(own.traces) == list(drive.traces[: len(own.traces)])
    # It ends where it arrives.
    gaps = np.hypot(*(drive.pose[:, :2] - scenario.episode.goal_xy).T)
    threshold_m = 0.7 * scenario.episode.threshold_m
    assert gaps[len(own) - 1] < threshold_m and not np.any(gaps[: len(own) - 1] < threshold_m)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_other_ways_lead_on_from_the_same_start_to_other_goals(kind: str) -> None:
    _, drive, found = _told(kind)
    assert 1 <= len(found) <= CONFIG.ways
    for each in found:
        assert hypot(*(np.array(each.goal_xy) - drive.about.goal_xy)) >= 2.0
        assert begins_ahead(_tasks(kind)[each.goal_xy])


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_no_wording_is_untrue_or_the_benchmarks(kind: str) -> None:
    _, _, found = _told(kind)
    for each in found:
        assert not any(is_held_out(text) for text in each.wordings)
        assert not any(untrue(text, _tasks(kind)[each.goal_xy].route) for text in each.wordings)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_relabel_has_the_drives_frames_up_to_where_it_is_far_from_the_other_way(kind: str) -> None:
    scenario, drive, found = _told(kind)
    for each in found:
        other = each.of(drive)
        assert 50 <= len(other) <= len(drive) and other.id == drive.id
        assert np.array_equal(other.pose_odom, drive.pose_odom[: len(other)])
        assert [trace["k"] for trace in other.traces] == list(range(0, len(other), 10))
        assert not other.future_steps.any()  # what to do among people is not known of this way
        progress = RouteProgress(replace(scenario, task=_tasks(kind)[each.goal_xy]))
        assert max(progress.strayed_m(other.T_world_base(k)) for k in range(0, len(other), 10)) <= CONFIG.off_m


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_waypoints_lie_ahead_on_the_other_way_at_the_experts_speed(kind: str) -> None:
    _, drive, found = _told(kind)
    for each in found:
        reach = np.hypot(each.plan_xy[..., 0], each.plan_xy[..., 1])
        for seconds, column in zip((3.0, 6.0, 9.0), reach.T, strict=True):
            assert column.max() <= SPEED_MPS * seconds + 0.5  # a way is looked for twice a second
        path = np.array(_tasks(kind)[each.goal_xy].path)
        for k in range(0, len(each), 10):
            pose = drive.T_world_base(k)
            if off_way_m(drive.pose[k, :2], path) > 0.5:
                continue  # on the way back to it
            places = [pose @ SE2(float(x), float(y), 0.0) for x, y in each.plan_xy[k]]
            for place in places:
                assert off_way_m(np.array((place.x_m, place.y_m)), path) < 1.5
            left = [hypot(place.x_m - each.goal_xy[0], place.y_m - each.goal_xy[1]) for place in places]
            assert k > 0 or left[-1] < hypot(*(drive.pose[0, :2] - each.goal_xy))


@pytest.mark.slow
def test_past_a_turn_that_was_missed_it_turns_back_and_not_before() -> None:
    said = {"before": set(), "after": set()}
    for number in range(2):
        _, drive, found = _told("office", number)
        for each in found:
            path = np.array(_tasks("office", number)[each.goal_xy].path)
            for trace in each.traces:
                off_m = off_way_m(drive.pose[trace["k"], :2], path)
                said["after" if off_m > 2.0 else "before"].add(trace["plan"])
    assert "turn back" in said["after"] and len(said["before"] - {"turn back"}) > 10


@pytest.mark.slow
def test_a_greater_distance_shows_more_of_a_robot_that_is_lost() -> None:
    scenario, drive, found = _told("office")
    farther = relabel(drive, scenario.site, replace(CONFIG, off_m=8.0), 1, SPEED_MPS)
    backs = [sum(trace["plan"] == "turn back" for each in some for trace in each.traces) for some in (found, farther)]
    assert backs[1] > backs[0]


@pytest.mark.slow
def test_only_frames_without_people_nearby_are_relabelled(tmp_path: Path) -> None:
    scenario, drive, _ = _told("corridor")
    crowded = drive_along(scenario, "b", motion=CROWDED)
    dataset = write_dataset(tmp_path, [drive, crowded])
    relabels = InstructionRelabels(dataset, CONFIG, 1, SPEED_MPS)
    relabels.build(dataset.ids)
    assert relabels.anchors(drive) and relabel(crowded, scenario.site, CONFIG, 1, SPEED_MPS)
    assert relabels.anchors(crowded) == []


@pytest.mark.slow
def test_a_drive_without_traces_or_from_elsewhere_is_left_alone(tmp_path: Path) -> None:
    scenario, drive, _ = _told("corridor")
    elsewhere = replace(drive, about=replace(drive.about, scene="corridor-0"))
    for other in (
        made_up_drive("a", traces=()),
        elsewhere,
        replace(drive, pose=drive.pose + np.array((0.0, 40.0, 0.0))),
    ):
        assert relabel(other, scenario.site, CONFIG, 1, SPEED_MPS) == []
    foreign = [made_up_drive("real", kind="recorded"), made_up_drive("reserved", layout_seed=1)]
    dataset = write_dataset(tmp_path, foreign)
    relabels = InstructionRelabels(dataset, CONFIG, 1, SPEED_MPS)
    relabels.build(dataset.ids)
    assert [relabels.anchors(each) for each in foreign] == [[], []]


# On disk


@pytest.mark.slow
def test_a_written_relabel_is_read_back_and_made_only_once(tmp_path: Path) -> None:
    _, drive, found = _told("corridor")
    dataset = write_dataset(tmp_path, [drive])
    relabels = InstructionRelabels(dataset, CONFIG, 1, SPEED_MPS)
    with pytest.raises(TrainError, match=r"a\.json.*build"):
        relabels.anchors(drive)
    relabels.build(dataset.ids)
    read = relabels.anchors(drive)
    assert [format_text(anchor.reasoning) for anchor in read] == [
        format_text(anchor.reasoning) for each in found for anchor in anchors_of(each.of(drive))
    ]
    path = relabels.folder / "a.json"
    made = path.stat().st_mtime_ns
    relabels.build(dataset.ids)
    assert path.stat().st_mtime_ns == made


@pytest.mark.parametrize("content", ["", "{", '{"drive_sha256": "0", "ways": []}', '{"ways": [{}]}', "[]"])
def test_an_unreadable_or_foreign_relabel_is_made_again(tmp_path: Path, content: str) -> None:
    dataset = write_dataset(tmp_path, [made_up_drive("a", kind="recorded")])
    relabels = InstructionRelabels(dataset, CONFIG, 1, SPEED_MPS)
    relabels.build(dataset.ids)
    whole = (relabels.folder / "a.json").read_text()
    (relabels.folder / "a.json").write_text(content)
    relabels.build(dataset.ids)
    assert (relabels.folder / "a.json").read_text() == whole


def test_a_stop_request_ends_it_after_the_drive_and_keeps_its_output(tmp_path: Path) -> None:
    dataset = write_dataset(tmp_path, [made_up_drive(name, kind="recorded") for name in "abc"])
    relabels = InstructionRelabels(dataset, CONFIG, 1, SPEED_MPS)
    with pytest.raises(KeyboardInterrupt):
        relabels.build(dataset.ids, stopped=lambda: (relabels.folder / "a.json").exists())
    assert [path.name for path in relabels.folder.iterdir()] == ["a.json"]
