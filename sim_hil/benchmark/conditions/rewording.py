"""Episodes with other words: in training's sentence patterns, or with the instruction of another task.

Both are told by the episodes themselves, so that whoever runs them knows nothing of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from zlib import crc32

import numpy as np

from sim_hil.benchmark.conditions.conditions import Conditions, ConditionsError
from sim_hil.benchmark.language.instructions import WordingError, wordings
from sim_hil.benchmark.language.route import RouteError, tell
from sim_hil.benchmark.suite.episode import Episode
from sim_hil.benchmark.suite.robots import telling_grid
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Scene, load_scene

_TAG = 0x54A9

Texts = dict[str, tuple[str, ...]]
"""Instructions by task."""


def reworded(
    episodes: Sequence[Episode], conditions: Conditions, suite: Callable[[], Sequence[Episode]]
) -> tuple[Episode, ...]:
    """`episodes` with the words that the conditions ask for; `suite` gives all episodes, from whose tasks is swapped.

    Raises ConditionsError where there are no such words.
    """
    if conditions.wordings == "benchmark" and conditions.swap_instructions is None:
        return tuple(episodes)
    everything = list(suite())
    texts: Texts = {episode.task: episode.instructions for episode in everything}
    if conditions.wordings == "training":
        wanted = {episode.task for episode in episodes}
        if conditions.swap_instructions is not None:
            wanted |= set(texts)
        texts |= training_texts([episode for episode in everything if episode.task in wanted])
    if conditions.swap_instructions is not None:
        giver = swapped_tasks(everything, conditions.swap_instructions)
        texts = {task: texts[giver[task]] for task in texts}
    return tuple(replace(episode, instructions=texts[episode.task]) for episode in episodes)


def swapped_tasks(episodes: Sequence[Episode], seed: int) -> dict[str, str]:
    """For each task the one whose instruction it is given: another one of the same scene, none given twice.

    Of the same scene, so that a robot is told of things that are there, and only the way is another one. Raises
    ConditionsError for a scene of one task.
    """
    scenes: dict[str, list[str]] = {}
    for episode in episodes:
        tasks = scenes.setdefault(episode.scene, [])
        if episode.task not in tasks:
            tasks.append(episode.task)
    giver: dict[str, str] = {}
    for scene, tasks in scenes.items():
        if len(tasks) < 2:
            raise ConditionsError(f"swapped instructions: expected two tasks or more in {scene}, found {len(tasks)}")
        order = np.random.default_rng((seed, crc32(scene.encode()), _TAG)).permutation(len(tasks))
        # One cycle over all: nobody keeps his own.
        for here, there in zip(order, np.roll(order, 1), strict=True):
            giver[tasks[here]] = tasks[there]
    return giver


def training_texts(episodes: Sequence[Episode]) -> Texts:
    """As many instructions of each task in sentence patterns of training; always the same ones.

    Raises ConditionsError for a way that cannot be told so.
    """
    places: dict[str, tuple[Scene, NavGrid]] = {}
    texts: Texts = {}
    for episode in episodes:
        if episode.task in texts:
            continue
        if episode.scene not in places:
            scene = load_scene(episode.scene)
            places[episode.scene] = scene, telling_grid(scene)
        try:
            found = _training_wordings(episode, *places[episode.scene])
        except (RouteError, WordingError, StopIteration) as error:
            raise ConditionsError(f"--wordings training: task {episode.task}: {error or 'no goal'}") from error
        texts[episode.task] = tuple(found)
    return texts


def _training_wordings(episode: Episode, scene: Scene, grid: NavGrid) -> list[str]:
    goal = next(thing for thing in scene.objects if thing.label == episode.goal_landmark)
    path = grid.path(episode.start[:2], episode.goal_xy)
    if path is None:
        raise RouteError("there is no way to its goal")
    told = tell(scene, grid, path, goal)
    return wordings(told, len(episode.instructions), crc32(episode.task.encode()), held_out=False)
