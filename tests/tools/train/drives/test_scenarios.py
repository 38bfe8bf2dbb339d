"""Training draws its tasks from scenes, seeds and sentences that the benchmark never uses."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from math import hypot

import pytest

from sim_hil.benchmark.language.instruction_reading import untrue
from sim_hil.benchmark.language.instructions import is_held_out, pattern
from sim_hil.benchmark.language.tasks import facing
from sim_hil.benchmark.suite.episode import load_suite
from sim_hil.layouts import LayoutError
from sim_hil.realtime.stack import INSTRUCTION
from sim_hil.scene.scene import Scene, load_scene
from tests.support.train.training_scenarios import SEED, all_scenarios, scenarios
from tools.train.config.collect import CORRIDOR, KINDS, SHARES
from tools.train.drives.scenarios import (
    FIRST_SEED,
    LEAST_WORDINGS,
    ScenarioError,
    Site,
    SiteError,
    corridor,
    kind_of_group,
    training_episodes,
)

SUITE = load_suite("dynanav")


def _content(scene: Scene) -> str:
    """What a scene is made of, whatever it is called and wherever one starts."""
    return hashlib.sha256(repr((scene.walls, scene.objects, scene.terrain, scene.areas)).encode()).hexdigest()


# -- apart from the benchmark ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_no_training_scene_has_the_content_of_a_benchmark_scene() -> None:
    held = {_content(load_scene(name)) for name in {episode.scene for episode in SUITE}}
    assert not held & {_content(scenario.scene) for scenario in all_scenarios()}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", [0, 3, 60, 99])
def test_a_reserved_layout_is_refused(kind: str, seed: int) -> None:
    with pytest.raises((SiteError, LayoutError), match="benchmark"):
        Site(kind, seed)


@pytest.mark.slow
def test_no_seed_of_a_crowd_is_the_benchmarks() -> None:
    assert max(episode.seed for episode in SUITE) < FIRST_SEED
    assert all(scenario.episode.seed >= FIRST_SEED for scenario in all_scenarios())


@pytest.mark.slow
def test_no_start_or_goal_is_the_benchmarks() -> None:
    held = {(episode.start, episode.goal_xy) for episode in SUITE}
    assert not held & {(scenario.episode.start, scenario.episode.goal_xy) for scenario in all_scenarios()}
    assert not {start for start, _ in held} & {scenario.episode.start for scenario in all_scenarios()}


@pytest.mark.slow
def test_no_wording_and_no_pattern_of_one_is_the_benchmarks() -> None:
    texts = [text for scenario in all_scenarios() for text in scenario.wordings]
    held = {text for episode in SUITE for text in episode.instructions}
    assert not held & set(texts)
    assert not {pattern(text) for text in held} & {pattern(text) for text in texts}
    assert not any(is_held_out(text) for text in texts)


def test_the_demos_sentence_is_none_of_trainings() -> None:
    assert is_held_out(INSTRUCTION)
    assert INSTRUCTION.lower() not in {text.lower().rstrip(".") for s in scenarios(CORRIDOR) for text in s.wordings}


@pytest.mark.slow
def test_a_scenario_with_a_wording_or_a_crowd_of_the_benchmark_is_refused() -> None:
    scenario = scenarios("office")[0]
    taken = (*scenario.wordings[:-1], SUITE[0].instructions[0])
    with pytest.raises(ScenarioError, match="patterns"):
        replace(scenario, episode=replace(scenario.episode, instructions=taken))
    with pytest.raises(ScenarioError, match="seed"):
        replace(scenario, episode=replace(scenario.episode, seed=SUITE[0].seed))


# -- what a scenario is ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_every_scenario_has_wordings_enough_and_all_of_them_true() -> None:
    for scenario in all_scenarios():
        assert len(set(scenario.wordings)) >= LEAST_WORDINGS
        assert not [problem for text in scenario.wordings for problem in untrue(text, scenario.route)]


@pytest.mark.slow
def test_a_task_can_be_done_by_its_robot_and_ends_before_its_landmark() -> None:
    for scenario in all_scenarios():
        episode = scenario.episode
        assert scenario.site.robot_grid(episode.robot).is_free(*episode.start[:2])
        assert scenario.task.path[0] == episode.start[:2] and scenario.task.path[-1] == episode.goal_xy
        thing = next(thing for thing in scenario.scene.objects if thing.label == episode.goal_landmark)
        gap = hypot(thing.position_m[0] - episode.goal_xy[0], thing.position_m[1] - episode.goal_xy[1])
        assert gap < max(thing.size_m[:2]) / 2 + 2.0


def test_the_demos_corridor_is_itself_for_even_seeds_and_rearranged_for_odd_ones() -> None:
    def places(scene: Scene) -> list[tuple[float, ...]]:
        return [thing.position_m for thing in scene.objects]

    assert places(corridor(100)) == places(load_scene(CORRIDOR))
    assert places(corridor(101)) != places(load_scene(CORRIDOR))
    assert corridor(100).routes == load_scene(CORRIDOR).routes


# -- drawing them ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_same_seed_gives_the_same_scenarios_whichever_of_them_are_drawn() -> None:
    kinds = {CORRIDOR: 1.0}
    together = [s.episode for s in training_episodes(SEED, 3, kinds, tasks_per_scene=2)]
    alone = [s.episode for s in training_episodes(SEED, 1, kinds, start=2, tasks_per_scene=2)]
    assert together[2:] == alone
    assert [s.episode for s in training_episodes(SEED, 1, kinds, start=1, tasks_per_scene=2)] == together[1:2]


def test_a_turned_start_changes_heading_and_words_alone() -> None:
    kinds = {CORRIDOR: 1.0}
    usual, turned = (list(training_episodes(SEED, 4, kinds, tasks_per_scene=2, turned_share=x)) for x in (0.0, 1.0))
    for each, other in zip(usual, turned, strict=True):
        words = {"instructions": other.wordings, "landmarks": other.episode.landmarks}
        assert replace(each.episode, start=other.episode.start, **words) == other.episode
        assert each.task.path == other.task.path and each.episode.start[:2] == other.episode.start[:2]
        first = facing(other.episode.start, other.task.path)
        assert not any(untrue(text, other.route, first) for text in other.wordings)
    assert any(facing(each.episode.start, each.task.path) for each in turned)


def test_kinds_come_in_their_shares_even_in_a_short_run() -> None:
    count = 60
    kinds = [kind_of_group(0, group, SHARES) for group in range(count)]
    total = sum(SHARES.values())
    for kind, share in SHARES.items():
        assert abs(kinds.count(kind) - count * share / total) <= 3


@pytest.mark.parametrize("kinds", [{"castle": 1.0}, {"office": -1.0}, {"office": 0.0}, {}, {"office": float("nan")}])
def test_invalid_shares_are_refused(kinds: dict[str, float]) -> None:
    with pytest.raises(ScenarioError):
        next(training_episodes(0, 1, kinds))


@pytest.mark.parametrize(
    ("seed", "count", "start"), [(-1, 1, 0), (10_000, 1, 0), (0, -1, 0), (0, 1, -1), (0, 10**9, 0)]
)
def test_numbers_out_of_range_are_refused(seed: int, count: int, start: int) -> None:
    with pytest.raises(ScenarioError):
        next(training_episodes(seed, count, {"office": 1.0}, start=start), None)
