"""`dynanav-fresh`: a large stratified suite on layouts that nobody has tuned to."""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import replace

import pytest

from sim_hil.benchmark.language.route import describe_route
from sim_hil.benchmark.suite import build_fresh
from sim_hil.benchmark.suite.build import INDOOR_CROWDS, count_turns, timeout_s
from sim_hil.benchmark.suite.build_fresh import KINDS, PER_CELL, PER_LAYOUT, SEEDS, TURNS
from sim_hil.benchmark.suite.episode import ROBOTS, SUITES, Episode, load_suite, suite_to_toml
from sim_hil.benchmark.suite.robots import route_grid
from sim_hil.benchmark.suite.strata import FRESH, LENGTHS_M, band_of, kind_of, turns_of
from sim_hil.benchmark.suite.validate import validate
from sim_hil.layouts import is_reserved
from sim_hil.layouts.scenes import open_scene

EPISODES = load_suite(FRESH)


def test_there_are_300_episodes_or_more_and_ten_layouts_or_more_of_each_kind() -> None:
    assert len(EPISODES) >= 300
    layouts: dict[str, set[str]] = defaultdict(set)
    for episode in EPISODES:
        layouts[kind_of(episode.scene)].add(episode.scene)
    assert set(layouts) == set(KINDS) and all(len(each) >= 10 for each in layouts.values())


def test_every_layout_is_one_of_60_to_99_which_training_refuses() -> None:
    seeds = {int(episode.scene.rsplit("-", 1)[1]) for episode in EPISODES}
    assert seeds <= set(SEEDS) and all(is_reserved(seed) for seed in seeds)


def test_every_stratum_of_kind_length_and_turns_has_the_same_number_of_tasks() -> None:
    turns = {each.id: min(turns_of(each.task) or 0, TURNS[-1]) for each in EPISODES}
    strata = Counter((kind_of(each.scene), band_of(each.shortest_m), turns[each.id]) for each in EPISODES)
    assert strata == {(kind, band, turns): PER_CELL for kind in KINDS for band in LENGTHS_M for turns in TURNS}


def test_every_kind_has_both_robots_and_every_crowd_about_equally_often() -> None:
    for kind in KINDS:
        members = [episode for episode in EPISODES if kind_of(episode.scene) == kind]
        robots = Counter(episode.robot for episode in members)
        crowds = Counter(episode.people for episode in members)
        assert abs(robots["go2"] - robots["carter"]) <= 6
        assert set(crowds) == set(INDOOR_CROWDS) and max(crowds.values()) - min(crowds.values()) <= 6


def test_an_episode_is_a_task_of_its_own() -> None:
    for key in ("task", "id", "seed"):
        assert len({getattr(episode, key) for episode in EPISODES}) == len(EPISODES)
    first = load_suite("dynanav")
    assert not {episode.seed for episode in EPISODES} & {episode.seed for episode in first}


def test_no_layout_has_more_than_its_share() -> None:
    assert max(Counter(episode.scene for episode in EPISODES).values()) <= PER_LAYOUT


def test_threshold_and_timeout_are_those_of_the_first_suite() -> None:
    for each in EPISODES:
        assert (each.threshold_m, each.timeout_s) == (1.5, timeout_s(each.shortest_m, each.people, outdoor=False))


def test_the_file_is_small_and_reads_back() -> None:
    text = (SUITES / f"{FRESH}.toml").read_text(encoding="utf-8")
    assert len(text) < 500_000
    assert text == suite_to_toml(FRESH, build_fresh.VERSION, EPISODES)


def first_episode(kind: str) -> Episode:
    return next(episode for episode in EPISODES if kind_of(episode.scene) == kind)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_file_is_what_the_builder_builds(kind: str) -> None:
    # The first layout stands for all here; `build_fresh --check` compares the whole.
    built = list(build_fresh.first_layout(kind))
    assert len(built) >= 5
    in_file = [episode for episode in EPISODES if episode.scene == built[0].scene]
    assert suite_to_toml(FRESH, build_fresh.VERSION, built) == suite_to_toml(FRESH, build_fresh.VERSION, in_file)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_an_episode_of_each_kind_is_sound_and_has_the_turns_of_its_name(kind: str) -> None:
    episode = first_episode(kind)
    assert validate([episode]) == {}
    scene = open_scene(episode.scene)
    grid = route_grid(scene)
    goal = next(thing for thing in scene.objects if thing.label == episode.goal_landmark)
    path = grid.path(episode.start[:2], episode.goal_xy)
    assert path is not None
    assert count_turns(describe_route(scene, grid, path, goal)) == turns_of(episode.task)


@pytest.mark.slow
def test_the_validator_finds_a_goal_that_cannot_be_reached() -> None:
    episode = first_episode("office")
    scene = open_scene(episode.scene)
    outside = (scene.floor_max_m[0] + 50.0, scene.floor_max_m[1] + 50.0)
    found = validate([replace(episode, goal_xy=outside)])
    assert "the goal is not free" in "\n".join(found[episode.id])


@pytest.mark.parametrize("robot", ROBOTS)
def test_ids_name_crowd_and_robot(robot: str) -> None:
    for episode in EPISODES:
        if episode.robot == robot:
            assert episode.id == f"{episode.task}-{episode.people}-{robot}"
