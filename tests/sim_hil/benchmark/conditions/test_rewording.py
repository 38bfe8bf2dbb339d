"""The same episodes with other words: training's sentence patterns, or the way of another task."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from sim_hil.benchmark.conditions.conditions import Conditions, ConditionsError, PolicySpec
from sim_hil.benchmark.conditions.rewording import reworded, swapped_tasks
from sim_hil.benchmark.language.instructions import is_held_out
from sim_hil.benchmark.suite.episode import load_suite
from tests.support.benchmark.dynanav_fakes import STILL, episode

EPISODES = load_suite("dynanav")
SWAPPED = Conditions(PolicySpec("still"), swap_instructions=3)


def test_without_asking_episodes_keep_their_words() -> None:
    assert reworded(EPISODES, STILL, lambda: pytest.fail("nobody needs the suite")) == EPISODES


def test_swapped_every_task_gets_the_words_of_another_one_of_its_scene() -> None:
    own = {each.task: each.instructions for each in EPISODES}
    scene_of = {each.task: each.scene for each in EPISODES}
    task_of = {texts: task for task, texts in own.items()}
    for before, each in zip(EPISODES, reworded(EPISODES, SWAPPED, lambda: EPISODES), strict=True):
        giver = task_of[each.instructions]
        assert giver != each.task and scene_of[giver] == each.scene
        assert replace(each, instructions=before.instructions) == before


def test_swapped_no_task_gives_twice_and_the_seed_decides() -> None:
    first, again, other = (swapped_tasks(EPISODES, seed) for seed in (3, 3, 4))
    assert sorted(first.values()) == sorted(first) and first == again and first != other


def test_a_part_of_the_suite_is_swapped_as_the_whole_is() -> None:
    whole = {each.id: each for each in reworded(EPISODES, SWAPPED, lambda: EPISODES)}
    part = [each for each in EPISODES if each.id.startswith("office-desk")]
    assert all(whole[each.id] == each for each in reworded(part, SWAPPED, lambda: EPISODES))


def test_a_scene_of_one_task_cannot_be_swapped() -> None:
    with pytest.raises(ConditionsError, match="two tasks or more in corridor"):
        reworded([episode("a")], SWAPPED, lambda: [episode("a")])


def test_training_wordings_are_of_no_benchmark_pattern_and_as_many() -> None:
    part = [each for each in EPISODES if each.task == "warehouse-cone"]
    found = reworded(part, Conditions(PolicySpec("still"), wordings="training"), lambda: EPISODES)
    for before, after in zip(part, found, strict=True):
        assert len(after.instructions) == len(before.instructions) >= 4
        assert not any(is_held_out(text) for text in after.instructions)
        assert all(is_held_out(text) for text in before.instructions)


@pytest.mark.slow
def test_a_turned_start_is_the_same_for_all_episodes_of_a_task_and_the_instruction_says_how_to_turn() -> None:
    part = [each for each in EPISODES if each.scene == "hospital"]
    found = reworded(part, Conditions(PolicySpec("still"), turn_starts=1), lambda: EPISODES)
    headings: dict[str, float] = {}
    for before, after in zip(part, found, strict=True):
        assert replace(after, start=before.start, instructions=before.instructions) == before
        assert after.start[:2] == before.start[:2]
        assert headings.setdefault(after.task, after.start[2]) == after.start[2] != before.start[2]
        assert all(is_held_out(text) for text in after.instructions)
        assert len(after.instructions) == len(before.instructions)
    kept = [after.instructions == before.instructions for before, after in zip(part, found, strict=True)]
    assert any(kept) and not all(kept), "only a route that no longer begins ahead is told anew"
    assert any(re.search("turn a?round", text, re.IGNORECASE) for each in found for text in each.instructions)
    assert found == reworded(part, Conditions(PolicySpec("still"), turn_starts=1), lambda: EPISODES)


def test_a_start_is_not_turned_with_the_instruction_of_another_task() -> None:
    with pytest.raises(ConditionsError, match="without swapped instructions"):
        replace(SWAPPED, turn_starts=1)


@pytest.mark.slow
def test_both_go_together() -> None:
    part = [each for each in EPISODES if each.scene == "warehouse"]
    both = Conditions(PolicySpec("still"), wordings="training", swap_instructions=3)
    training = replace(both, swap_instructions=None)
    own = {each.task: each.instructions for each in reworded(part, training, lambda: part)}
    giver = swapped_tasks(part, 3)
    for each in reworded(part, both, lambda: part):
        assert each.instructions == own[giver[each.task]]
