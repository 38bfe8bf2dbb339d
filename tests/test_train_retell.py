"""A drive under other instructions: the same pictures and poses, and words that are true of another way along them."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import cache
from math import hypot
from pathlib import Path

import numpy as np
import pytest

from sim_hil.benchmark.instruction_reading import untrue
from sim_hil.benchmark.instructions import is_held_out
from sim_hil.benchmark.route import RouteError
from sim_hil.benchmark.tasks import Task, begins_ahead, make_task
from tests.train_drives import VAL_LAYOUT, made_up_drive, write_dataset
from tests.training_scenarios import SPEED_MPS, drive_along, scenarios
from tools.train.anchors import anchors_of
from tools.train.distributed import Ranks
from tools.train.drive import Drive
from tools.train.progress_labels import RouteProgress
from tools.train.retell import RetellConfig, RetellError, Retelling, Retellings, retell, told_along
from tools.train.scenarios import Scenario
from tools.train.trace_words import TURN_BACK, WAIT

CONFIG = RetellConfig(ways=2, tries=24)
CROWDED = "person ahead 2 m coming, person left 3 m standing"


@cache
def _told(kind: str, number: int = 0) -> tuple[Scenario, Drive, tuple[Retelling, ...]]:
    scenario = scenarios(kind)[number]
    drive = drive_along(scenario)
    return scenario, drive, tuple(retell(drive, scenario.site, CONFIG, 1))


@cache
def _tasks(kind: str) -> dict[tuple[float, float], Task]:
    """From the same start, by goal."""
    scenario = scenarios(kind)[0]
    found = {}
    for thing in scenario.site.goals:
        with suppress(RouteError):
            task = make_task(scenario.scene, scenario.site.grid, scenario.task.start, thing)
            found[task.goal] = task
    return found


KINDS = ("corridor", "office", "sidewalk")


def test_told_of_its_own_way_a_drive_is_what_it_was() -> None:
    scenario, drive, _ = _told("office")
    own = told_along(drive, scenario, SPEED_MPS)
    assert own is not None and own.wordings == drive.wordings and own.told == drive.about.told
    for mine, said in zip(drive.traces, own.traces, strict=False):
        assert {name: said[name] for name in ("progress", "situation", "k")} == {
            name: mine[name] for name in ("progress", "situation", "k")
        }
    # It ends where it arrives.
    x, y = scenario.episode.goal_xy
    gaps = np.hypot(drive.pose[:, 0] - x, drive.pose[:, 1] - y)
    assert gaps[len(own) - 1] < scenario.episode.threshold_m and not np.any(gaps[: len(own) - 1] < 0.7 * 1.5)


@pytest.mark.parametrize("kind", KINDS)
def test_other_ways_lead_on_from_the_same_start_to_other_goals(kind: str) -> None:
    _, drive, found = _told(kind)
    assert 1 <= len(found) <= CONFIG.ways
    for each in found:
        assert hypot(*(np.array(each.goal_xy) - drive.about.goal_xy)) >= 2.0
        assert begins_ahead(_tasks(kind)[each.goal_xy])


@pytest.mark.parametrize("kind", KINDS)
def test_no_wording_is_untrue_or_the_benchmarks(kind: str) -> None:
    _, _, found = _told(kind)
    for each in found:
        assert not any(is_held_out(text) for text in each.wordings)
        assert not any(untrue(text, _tasks(kind)[each.goal_xy].told) for text in each.wordings)


@pytest.mark.parametrize("kind", KINDS)
def test_a_retelling_has_the_drives_frames_up_to_where_it_is_far_from_the_other_way(kind: str) -> None:
    scenario, drive, found = _told(kind)
    for each in found:
        other = each.of(drive)
        assert 50 <= len(other) <= len(drive) and other.id == drive.id
        assert np.array_equal(other.pose_odom, drive.pose_odom[: len(other)])
        assert [trace["k"] for trace in other.traces] == list(range(0, len(other), 10))
        assert not other.future_steps.any()  # what to do among people is not known of this way
        progress = RouteProgress(replace(scenario, task=_tasks(kind)[each.goal_xy]))
        assert max(progress.strayed_m(other.T_world_base(k)) for k in range(0, len(other), 10)) <= 6.0


@pytest.mark.parametrize("kind", KINDS)
def test_waypoints_lie_ahead_on_the_way_at_the_experts_speed(kind: str) -> None:
    _, _, found = _told(kind)
    for each in found:
        reach = np.hypot(each.plan_xy[..., 0], each.plan_xy[..., 1])
        for seconds, column in zip((3.0, 6.0, 9.0), reach.T, strict=True):
            assert column.max() <= SPEED_MPS * seconds + 0.5  # a way is looked for twice a second
        # Where the drive begins, the other way begins too.
        assert each.plan_xy[0, 0, 0] > 1.0
    assert len({each.plan_xy.tobytes() for each in found}) == len(found)


def test_who_is_near_and_whether_to_wait_for_them_stays_as_it_was() -> None:
    scenario = scenarios("office")[0]
    drive = drive_along(scenario, motion=CROWDED, waits=True)
    for each in retell(drive, scenario.site, CONFIG, 1):
        for said in each.traces:
            assert said["motion"] == CROWDED
            assert said["plan"] == TURN_BACK or said["plan"].startswith(WAIT)


def test_anchors_are_asked_in_the_other_words_about_the_same_frames() -> None:
    _, drive, found = _told("office")
    own = {anchor.k: anchor for anchor in anchors_of(drive)}
    for each in found:
        for anchor in anchors_of(each.of(drive)):
            same = own[anchor.k]
            assert (anchor.drive_id, anchor.frames, anchor.way) == (same.drive_id, same.frames, same.way)
            assert not set(anchor.wordings) & set(same.wordings)


def test_the_same_numbers_tell_the_same_and_another_seed_other_ways() -> None:
    scenario, drive, found = _told("office")
    again = retell(drive, scenario.site, CONFIG, 1)
    assert [each.as_json() for each in again] == [each.as_json() for each in found]
    goals = [{each.goal_xy for each in retell(drive, scenario.site, CONFIG, seed)} for seed in range(1, 5)]
    assert any(goal != goals[0] for goal in goals)


def test_a_drive_without_traces_or_from_elsewhere_is_left_alone(tmp_path: Path) -> None:
    scenario, _, _ = _told("corridor")
    assert retell(made_up_drive("a", traces=()), scenario.site, CONFIG, 1) == []
    dataset = write_dataset(tmp_path, [made_up_drive("real", kind="recorded", layout_seed=VAL_LAYOUT)])
    retellings = Retellings(dataset, CONFIG, 1)
    retellings.build(dataset.ids)
    assert list(retellings.of(dataset.load("real"))) == []


# On disk


def test_what_is_written_is_read_and_made_only_once(tmp_path: Path) -> None:
    _, drive, found = _told("corridor")
    dataset = write_dataset(tmp_path, [drive])
    retellings = Retellings(dataset, CONFIG, 1)
    retellings.build(dataset.ids)
    read = list(retellings.of(drive))
    assert [other.about.wordings for other in read] == [each.wordings for each in found]
    for other, each in zip(read, found, strict=True):
        assert np.allclose(other.plan_xy, each.plan_xy, atol=1e-3) and other.traces == each.traces
    path = retellings.folder / "a.json"
    path.write_text("kept")
    retellings.build(dataset.ids)
    assert path.read_text() == "kept"
    with pytest.raises(RetellError, match=r"a\.json.*delete it"):
        list(retellings.of(drive))


def test_other_numbers_have_a_folder_of_their_own(tmp_path: Path) -> None:
    dataset = write_dataset(tmp_path, [made_up_drive("a")])
    folders = {Retellings(dataset, config, seed).folder for config in (CONFIG, RetellConfig(ways=1)) for seed in (1, 2)}
    assert len(folders) == 4


def test_ranks_share_the_layouts(tmp_path: Path) -> None:
    class Waiting(Ranks):
        def barrier(self) -> None:
            """Nobody else is there."""

    drives = [made_up_drive(name, kind="recorded", layout_seed=seed) for name, seed in (("a", 1), ("b", 2), ("c", 1))]
    dataset = write_dataset(tmp_path, drives)
    retellings = Retellings(dataset, CONFIG, 1)
    retellings.build(dataset.ids, ranks=Waiting(0, 2))
    assert sorted(path.stem for path in retellings.folder.iterdir()) == ["a", "c"]
    retellings.build(dataset.ids, ranks=Waiting(0, 1))
    assert sorted(path.stem for path in retellings.folder.iterdir()) == ["a", "b", "c"]


def test_the_numbers_are_checked() -> None:
    with pytest.raises(ValueError, match="0 to 64 ways"):
        RetellConfig(ways=65)
    with pytest.raises(ValueError, match="speed_mps"):
        RetellConfig(speed_mps=0.0)
