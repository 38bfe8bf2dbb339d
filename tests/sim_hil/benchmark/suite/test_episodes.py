"""The DynaNav suite as data: 85 episodes of 20 tasks, shaped as the paper's appendix C says."""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import replace
from pathlib import Path

import pytest

from sim_hil.benchmark.suite.build import PARTS, VERSION, build_part
from sim_hil.benchmark.suite.episode import SUITES, Episode, SuiteError, load_suite, parse_suite, suite_to_toml

TEXT = (SUITES / "dynanav.toml").read_text(encoding="utf-8")
EPISODES = load_suite("dynanav")


def tasks() -> dict[str, list[Episode]]:
    found: dict[str, list[Episode]] = defaultdict(list)
    for episode in EPISODES:
        found[episode.task].append(episode)
    return found


def test_there_are_85_episodes_25_a_building_and_10_outdoors() -> None:
    counts = Counter(episode.scene for episode in EPISODES)
    assert counts == {"hospital": 25, "office": 25, "warehouse": 25, "sidewalk": 10}


def test_crowds_are_0_to_60_indoors_and_100_to_200_outdoors() -> None:
    for scene in ("hospital", "office", "warehouse"):
        counts = Counter(episode.people for episode in EPISODES if episode.scene == scene)
        assert counts == {0: 5, 10: 5, 20: 5, 40: 5, 60: 5}
    outdoors = [episode.people for episode in EPISODES if episode.scene == "sidewalk"]
    assert min(outdoors) == 100
    assert max(outdoors) == 200


def test_the_episodes_of_a_task_share_the_goal_and_differ_in_crowd_robot_and_timeout() -> None:
    for episodes in tasks().values():
        assert len({(e.scene, e.start, e.goal_xy, e.instructions, e.goal_landmark) for e in episodes}) == 1
        assert len({e.people for e in episodes}) == len(episodes)
        assert {e.robot for e in episodes} == {"go2", "carter"}
        by_crowd = sorted(episodes, key=lambda e: e.people)
        assert [e.timeout_s for e in by_crowd] == sorted(e.timeout_s for e in episodes)
        assert by_crowd[0].timeout_s < by_crowd[-1].timeout_s


def test_each_crowd_of_a_building_has_both_robots() -> None:
    seen = {(e.scene, e.people, e.robot) for e in EPISODES if e.scene != "sidewalk"}
    assert len(seen) == 3 * 5 * 2


def test_the_threshold_is_the_papers_indoors_and_relaxed_outdoors() -> None:
    assert {e.threshold_m for e in EPISODES if e.scene != "sidewalk"} == {1.5}
    assert all(e.threshold_m > 1.5 for e in EPISODES if e.scene == "sidewalk")


def test_no_two_episodes_have_one_seed() -> None:
    assert len({episode.seed for episode in EPISODES}) == len(EPISODES)


@pytest.mark.slow
def test_the_file_is_what_the_builder_builds() -> None:
    # One task stands for all here; `build_suite --check` compares the whole.
    part = next(part for part in PARTS if part.scene == "warehouse")
    first = replace(part, wanted=part.wanted[:1])
    assert build_part(first) == [episode for episode in EPISODES if episode.task == "warehouse-cone"]


def test_a_suite_reads_back_what_was_written() -> None:
    assert suite_to_toml("dynanav", VERSION, EPISODES) == TEXT
    assert parse_suite(TEXT, "again") == EPISODES


def test_a_go2_that_halts_to_think_can_be_in_time_indoors() -> None:
    # At its limits 0.365 m in 0.5 s of driving and coasting; then 2 s of thought, 0.3 s of which the frame may wait.
    stop_and_go_mps = 0.365 / (0.5 + 2.0 + 0.3)
    for episode in EPISODES:
        if episode.robot == "go2" and episode.scene != "sidewalk":
            assert (episode.shortest_m - episode.threshold_m) / episode.timeout_s < 0.85 * stop_and_go_mps


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ('robot = "go2"', 'robot = "spot"', "spot"),
        ("people = 0", "people = -1", "people"),
        ("people = 0", 'people = "none"', "whole number"),
        ("threshold_m = 1.5", "threshold_m = 0.0", "positive"),
        ("threshold_m = 1.5", "threshold_m = 50.0", "within the threshold"),
        ("threshold_m = 1.5", "threshold_m = 1.5\nspeed = 1", "speed"),
        ("format = 1", "format = 2", "format"),
        ('goal_landmark = "', 'goal_landmark = "no such ', "goal_landmark"),
        ("instructions = [", "instructions = []\nother = [", "wordings"),
        ("[[tasks.episodes]]", "[[tasks.runs]]", "tasks"),
        ("timeout_s = ", "timeout_s = nan # ", "timeout_s"),
    ],
)
def test_a_wrong_suite_is_refused_in_one_line(old: str, new: str, complaint: str) -> None:
    assert old in TEXT
    with pytest.raises(SuiteError, match=complaint) as error:
        parse_suite(TEXT.replace(old, new, 1), "test.toml")
    assert str(error.value).startswith("test.toml: ")
    assert "\n" not in str(error.value)


def test_ids_that_come_twice_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "twice.toml"
    path.write_text(suite_to_toml("twice", 1, [*EPISODES[:5], replace(EPISODES[0], task="x")]), encoding="utf-8")
    with pytest.raises(SuiteError, match="twice"):
        load_suite(path)


def test_an_unknown_suite_is_refused_by_naming_the_known_ones() -> None:
    with pytest.raises(SuiteError, match="dynanav"):
        load_suite("nothing-like-it")
