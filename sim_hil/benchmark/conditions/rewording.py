"""Replace the instructions of episodes: by training's sentence patterns, or by another task's instruction.

The episodes themselves are changed, so the workers that run them need no extra option.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from zlib import crc32

import numpy as np

from sim_hil.benchmark.conditions.conditions import Conditions, ConditionsError
from sim_hil.benchmark.language.instructions import WordingError, wordings
from sim_hil.benchmark.language.route import RouteError, describe_route
from sim_hil.benchmark.suite.episode import Episode
from sim_hil.benchmark.suite.robots import route_grid
from sim_hil.layouts.scenes import open_scene
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Scene

_TAG = 0x54A9

Texts = dict[str, tuple[str, ...]]
"""Instructions by task."""


def reworded(
    episodes: Sequence[Episode], conditions: Conditions, suite: Callable[[], Sequence[Episode]]
) -> tuple[Episode, ...]:
    """Return `episodes` with the instructions that the conditions request.

    `suite` returns all episodes of the suite; instructions are swapped among their tasks. Raises ConditionsError if an
    instruction cannot be made.
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
    """Return for each task the task whose instruction it receives: another of the same scene, each used once.

    Both tasks share the scene, so the named objects exist and only the route is wrong. Raises ConditionsError for a
    scene with a single task.
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
        # One cycle over all tasks, so no task keeps its own instruction.
        for here, there in zip(order, np.roll(order, 1), strict=True):
            giver[tasks[here]] = tasks[there]
    return giver


def training_texts(episodes: Sequence[Episode]) -> Texts:
    """Return by task the same number of instructions in training's sentence patterns; deterministic.

    Raises ConditionsError for a route that these patterns cannot describe.
    """
    places: dict[str, tuple[Scene, NavGrid]] = {}
    texts: Texts = {}
    for episode in episodes:
        if episode.task in texts:
            continue
        if episode.scene not in places:
            scene = open_scene(episode.scene)
            places[episode.scene] = scene, route_grid(scene)
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
        raise RouteError("no path to its goal")
    route = describe_route(scene, grid, path, goal)
    return wordings(route, len(episode.instructions), crc32(episode.task.encode()), held_out=False)
