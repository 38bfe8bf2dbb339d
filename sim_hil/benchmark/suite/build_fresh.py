"""Build `dynanav-fresh` from layouts that nobody has tuned to: reserved seeds 60 to 99, stratified; deterministic.

Run it by hand when layouts or grammar change, and commit the file. A test checks that the file equals the output.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from edge.core.cli import command_line
from sim_hil.benchmark.language.instructions import WordingError, wordings
from sim_hil.benchmark.language.route import RouteError
from sim_hil.benchmark.language.task_checks import named_landmarks
from sim_hil.benchmark.language.tasks import Task, goals, sample_task
from sim_hil.benchmark.language.visibility import Sightlines
from sim_hil.benchmark.suite.build import (
    INDOOR_CROWDS,
    build_command,
    count_turns,
    has_clear_legs,
    is_true,
    timeout_s,
)
from sim_hil.benchmark.suite.episode import ROBOTS, Episode, suite_to_toml
from sim_hil.benchmark.suite.robots import robot_grid, route_grid
from sim_hil.benchmark.suite.strata import FRESH, LENGTHS_M, band_of, task_name
from sim_hil.layouts.scenes import layout_name, open_scene
from sim_hil.scene.scene import Scene

VERSION: Final = 1
KINDS: Final = ("hospital", "office", "warehouse")
SEEDS: Final = range(60, 100)
TURNS: Final = (1, 2)
"""Numbers of turns of a stratum; the last one stands for more turns, too, because routes of three are rare."""
PER_CELL: Final = 18
"""Tasks of each kind of building, band of lengths and number of turns."""
PER_LAYOUT: Final = 9
"""Largest number of tasks in one layout."""
WORDINGS: Final = 4
THRESHOLD_M: Final = 1.5
_DRAWS: Final = 120  # tasks drawn in one layout
_TAG: Final = 0xF2E5

Cell = tuple[str, int]
"""Band of lengths and number of turns."""


@dataclass
class _Places:
    """Free places of one kind of building by cell, and how many are taken."""

    taken: dict[Cell, int] = field(default_factory=lambda: {(band, turns): 0 for band in LENGTHS_M for turns in TURNS})

    @property
    def full(self) -> bool:
        return all(count >= PER_CELL for count in self.taken.values())

    def has(self, cell: Cell) -> bool:
        return self.taken.get(cell, PER_CELL) < PER_CELL

    def emptiest_band(self) -> str:
        return min(LENGTHS_M, key=lambda band: sum(self.taken[band, turns] for turns in TURNS))


class _Layout:
    """One layout while tasks are drawn in it."""

    def __init__(self, kind: str, seed: int) -> None:
        self.name = layout_name(kind, seed)
        self.scene: Scene = open_scene(self.name)
        self._rng = np.random.default_rng((KINDS.index(kind), seed, _TAG))
        self._grid, self._lines = route_grid(self.scene), Sightlines(self.scene)
        self._grids = {robot: robot_grid(self.scene, robot) for robot in ROBOTS}
        self._goals = goals(self.scene)
        self.used: set[str] = set()

    def draw(self, band: str) -> tuple[Task, tuple[str, ...]] | None:
        """Draw a task of a band with true instructions; None if the drawn one is unfit."""
        things = [thing for thing in self._goals if thing.label not in self.used]
        try:
            task = sample_task(self.scene, self._grid, self._rng, things=things, length_m=LENGTHS_M[band])
            texts = wordings(task.route, WORDINGS, int(self._rng.integers(2**31)), held_out=True)
        except (RouteError, WordingError):
            return None
        sound = has_clear_legs(task.route) and is_true(task, texts, self.scene, self._grid, self._lines, THRESHOLD_M)
        return (task, tuple(texts)) if sound else None

    def robot_for(self, task: Task, wanted: str) -> str:
        """Return the wanted robot if it has room at start and goal, else the other one."""
        grid = self._grids[wanted]
        fits = grid.is_free(*task.start[:2]) and grid.is_free(*task.goal)
        return wanted if fits else next(robot for robot in ROBOTS if robot != wanted)

    def shortest_m(self, task: Task, robot: str) -> float:
        return round(self._grids[robot].distance_m(task.start[:2], task.goal), 3)


def build_kind(kind: str, progress: Callable[[str], None] = lambda line: None) -> Iterator[Episode]:
    """Yield the episodes of one kind of building. Raises ValueError if its layouts lack tasks of a stratum."""
    places = _Places()
    for seed in SEEDS:
        if places.full:
            return
        layout = _Layout(kind, seed)
        yield from build_layout(layout, places, KINDS.index(kind), seed)
        progress(f"{layout.name}: {len(layout.used)} tasks")
    if not places.full:
        raise ValueError(f"{kind}: expected {PER_CELL} tasks of every stratum, found {places.taken}")


def build_layout(layout: _Layout, places: _Places, kind_number: int, seed: int) -> Iterator[Episode]:
    """Yield the episodes of one layout: one task each, in the strata that still lack tasks."""
    for _ in range(_DRAWS):
        if len(layout.used) == PER_LAYOUT or places.full:
            return
        drawn = layout.draw(places.emptiest_band())
        if drawn is None:
            continue
        task, texts = drawn
        turns = count_turns(task.route)
        cell = (band_of(task.route.length_m) or "", min(turns, TURNS[-1]))
        if not places.has(cell):
            continue
        number = places.taken[cell]
        robot = layout.robot_for(task, ROBOTS[(number + turns) % len(ROBOTS)])
        people = INDOOR_CROWDS[(list(places.taken).index(cell) * PER_CELL + number) % len(INDOOR_CROWDS)]
        shortest_m = layout.shortest_m(task, robot)
        if band_of(shortest_m) != cell[0]:
            continue
        places.taken[cell] += 1
        layout.used.add(task.goal_label)
        goal = next(thing.kind for thing in layout.scene.objects if thing.label == task.goal_label)
        name = task_name(layout.name, turns, goal, len(layout.used))
        yield Episode(
            id=f"{name}-{people}-{robot}",
            task=name,
            scene=layout.name,
            robot=robot,
            people=people,
            seed=500_000 + kind_number * 10_000 + seed * 100 + len(layout.used),
            start=task.start,
            goal_xy=task.goal,
            instructions=texts,
            timeout_s=timeout_s(shortest_m, people, outdoor=False),
            threshold_m=THRESHOLD_M,
            shortest_m=shortest_m,
            landmarks=named_landmarks(texts, task.route),
            goal_landmark=task.goal_label,
        )


def first_layout(kind: str) -> list[Episode]:
    """Return the episodes of the first layout of a kind, as the suite begins with them."""
    return list(build_layout(_Layout(kind, SEEDS[0]), _Places(), KINDS.index(kind), SEEDS[0]))


def build(progress: Callable[[str], None] = lambda line: None) -> str:
    """Return the suite's TOML text. Raises ValueError if layouts lack tasks of a stratum."""
    return suite_to_toml(FRESH, VERSION, [episode for kind in KINDS for episode in build_kind(kind, progress)])


@command_line("build_fresh")
def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return build_command(argv, FRESH, "sim_hil.benchmark.suite.build_fresh", build)


if __name__ == "__main__":
    sys.exit(main())
