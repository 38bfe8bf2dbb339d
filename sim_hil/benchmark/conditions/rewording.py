"""Replace the instructions of episodes: by training's sentence patterns, another task's, or those of a turned start.

The episodes themselves are changed, so the workers that run them need no extra option.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import pi
from zlib import crc32

import numpy as np

from sim_hil.benchmark.conditions.conditions import Conditions, ConditionsError
from sim_hil.benchmark.language.instructions import WordingError, wordings
from sim_hil.benchmark.language.route import RouteDescription, RouteError, describe_route
from sim_hil.benchmark.language.tasks import facing
from sim_hil.benchmark.suite.episode import Episode
from sim_hil.benchmark.suite.robots import route_grid
from sim_hil.layouts.scenes import open_scene
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Scene, Vec2

_TAG = 0x54A9

Texts = dict[str, tuple[str, ...]]
"""Instructions by task."""


def reworded(
    episodes: Sequence[Episode], conditions: Conditions, suite: Callable[[], Sequence[Episode]]
) -> tuple[Episode, ...]:
    """Return `episodes` with the instructions, and the headings at the start, that the conditions request.

    `suite` returns all episodes of the suite; instructions are swapped among their tasks. Raises ConditionsError if an
    instruction cannot be made.
    """
    if conditions.turn_starts is not None:
        return turned(episodes, conditions.turn_starts, held_out=conditions.wordings == "benchmark")
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


def turned(episodes: Sequence[Episode], seed: int, *, held_out: bool) -> tuple[Episode, ...]:
    """Return the episodes with a random heading at the start, the same for all episodes of a task.

    Where the route no longer begins ahead of the robot, the instructions are new ones, which say how to turn on the
    spot. `held_out`: from the benchmark's sentence patterns; otherwise every instruction is new, from training's.
    Raises ConditionsError for a route that the patterns cannot describe.
    """
    places = _Places("--turn-starts")
    tasks: dict[str, tuple[float, tuple[str, ...]]] = {}
    for episode in episodes:
        if episode.task not in tasks:
            rng = np.random.default_rng((seed, crc32(episode.task.encode()), _TAG))
            heading_rad = round(float(rng.uniform(-pi, pi)), 3)
            texts = places.wordings(replace(episode, start=(*episode.start[:2], heading_rad)), held_out=held_out)
            tasks[episode.task] = heading_rad, texts or episode.instructions
    return tuple(
        replace(each, start=(*each.start[:2], tasks[each.task][0]), instructions=tasks[each.task][1])
        for each in episodes
    )


def training_texts(episodes: Sequence[Episode]) -> Texts:
    """Return by task the same number of instructions in training's sentence patterns; deterministic.

    Raises ConditionsError for a route that these patterns cannot describe.
    """
    places = _Places("--wordings training")
    texts: Texts = {}
    for episode in episodes:
        if episode.task not in texts:
            texts[episode.task] = places.wordings(episode, held_out=False)
    return texts


class _Places:
    """Scenes and their grids, opened once; `option`: the one that asks for new instructions."""

    def __init__(self, option: str) -> None:
        self._option = option
        self._known: dict[str, tuple[Scene, NavGrid]] = {}

    def wordings(self, episode: Episode, *, held_out: bool) -> tuple[str, ...]:
        """Return new instructions for an episode's task; with `held_out`, () if its route begins ahead of the robot.

        Raises ConditionsError.
        """
        if episode.scene not in self._known:
            scene = open_scene(episode.scene)
            self._known[episode.scene] = scene, route_grid(scene)
        try:
            path, route = _route(episode, *self._known[episode.scene])
            first = facing(episode.start, path)
            if held_out and not first:
                return ()
            seed = crc32(episode.task.encode())
            return tuple(wordings(route, len(episode.instructions), seed, held_out=held_out, first=first))
        except (RouteError, WordingError, StopIteration) as error:
            raise ConditionsError(f"{self._option}: task {episode.task}: {error or 'no goal'}") from error


def _route(episode: Episode, scene: Scene, grid: NavGrid) -> tuple[list[Vec2], RouteDescription]:
    goal = next(thing for thing in scene.objects if thing.label == episode.goal_landmark)
    path = grid.path(episode.start[:2], episode.goal_xy)
    if path is None:
        raise RouteError("no path to its goal")
    return path, describe_route(scene, grid, path, goal)
