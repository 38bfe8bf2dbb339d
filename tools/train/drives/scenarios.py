"""Training scenarios: an episode with its scene, its route's description, and wordings that the benchmark never uses.

A group is one new layout with several tasks. A scenario depends on its seed and number alone, so that workers can
divide scenarios by number.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import hypot, isfinite, pi
from typing import Any, Final, TypeVar

import numpy as np

from sim_hil.benchmark.language.instruction_reading import untrue
from sim_hil.benchmark.language.instructions import WordingError, is_held_out, wordings
from sim_hil.benchmark.language.route import RouteDescription, RouteError
from sim_hil.benchmark.language.task_checks import named_landmarks, named_too_small, worst_leak, wrong_bends
from sim_hil.benchmark.language.tasks import Task, facing, goals, make_task, sample_task
from sim_hil.benchmark.language.visibility import Sightlines
from sim_hil.benchmark.policies.expert_route import PlannerGround
from sim_hil.benchmark.suite.build import timeout_s
from sim_hil.benchmark.suite.episode import ROBOTS, Episode
from sim_hil.benchmark.suite.robots import robot_grid, route_grid
from sim_hil.layouts import RESERVED_BELOW, LayoutError, generate, is_reserved
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Area, Scene, SceneObject, load_scene
from tools.train.config.collect import CORRIDOR, KINDS, OUTDOORS, SHARES, TASKS_PER_SCENE, check_shares

# Objects of the demo's corridor that are distinguishable and can be goals.
_CORRIDOR_LANDMARKS: Final = frozenset(
    ("vending machine", "bench", "water dispenser", "fire extinguisher", "cabinet", "notice board", "exit door")
)
_OUTDOOR_GOALS: Final = 8
_MOVED_M: Final = 0.7  # largest shift of an object along the wall, small enough that no two meet


class SiteError(ValueError):
    """A scene of an unknown kind or of the benchmark; one line."""


class Site:
    """One scene with derived data, computed on first use. Raises SiteError, LayoutError."""

    def __init__(self, kind: str, layout_seed: int) -> None:
        if kind not in KINDS:
            raise SiteError(f"unknown kind of scene {kind!r}, expected one of {', '.join(KINDS)}")
        if layout_seed < 0 or is_reserved(layout_seed):
            raise SiteError(f"layout seed {layout_seed} is the benchmark's: expected 100 or more")
        self.kind, self.layout_seed = kind, layout_seed
        made = corridor(layout_seed) if kind == CORRIDOR else generate(kind, layout_seed)
        # The name begins with the kind, which determines the people's clothes.
        self.scene: Scene = replace(made, name=f"{kind}-{layout_seed}")
        self._robot_grids: dict[str, NavGrid] = {}
        self._planner_grounds: dict[str, PlannerGround] = {}

    @property
    def outdoors(self) -> bool:
        """Whether the scene has no ceiling."""
        return self.kind in OUTDOORS

    @property
    def threshold_m(self) -> float:
        """Distance to the goal that counts as success, m, as in the benchmark."""
        return 3.0 if self.outdoors else 1.5

    @cached_property
    def grid(self) -> NavGrid:
        """Grid of free floor by which routes are described."""
        return route_grid(self.scene)

    @cached_property
    def goals(self) -> tuple[SceneObject, ...]:
        """Landmarks that can be goals; outdoors a subset, because each needs a search of the whole scene."""
        found = goals(self.scene)
        if not self.outdoors or len(found) <= _OUTDOOR_GOALS:
            return tuple(found)
        rng = np.random.default_rng((self.layout_seed, 47))
        return tuple(found[index] for index in sorted(rng.choice(len(found), _OUTDOOR_GOALS, replace=False)))

    @cached_property
    def lines(self) -> Sightlines:
        """Sightlines of the scene."""
        return Sightlines(self.scene)

    def robot_grid(self, robot: str) -> NavGrid:
        """Return the grid of floor that is free for a robot. Raises ValueError for an unknown robot."""
        if robot not in self._robot_grids:
            self._robot_grids[robot] = robot_grid(self.scene, robot)
        return self._robot_grids[robot]

    def planner_ground(self, robot: str) -> PlannerGround:
        """Return what planners of a robot's routes in this scene share. Raises ValueError for an unknown robot."""
        if robot not in self._planner_grounds:
            self._planner_grounds[robot] = PlannerGround(self.scene, self.robot_grid(robot))
        return self._planner_grounds[robot]


def corridor(layout_seed: int) -> Scene:
    """Build the demo's corridor with named landmarks; for odd seeds the landmarks are moved.

    Landmarks at the walls are moved a little along them, so that their positions cannot be memorised.
    """
    scene = load_scene(CORRIDOR)
    (x0, y0), (x1, y1) = scene.floor_min_m, scene.floor_max_m
    area = Area("corridor 1", "corridor", ((x0, y0), (x1, y0), (x1, y1), (x0, y1)), "corridor")
    rng = np.random.default_rng((layout_seed, 31))
    things = []
    for thing in scene.objects:
        x, y, z = thing.position_m
        if layout_seed % 2 and thing.label in _CORRIDOR_LANDMARKS and abs(y) > 1.0:
            x = round(x + float(rng.uniform(-_MOVED_M, _MOVED_M)), 2)
        name = thing.label if thing.label in _CORRIDOR_LANDMARKS else ""
        things.append(replace(thing, position_m=(x, y, z), landmark=name))
    return replace(scene, objects=tuple(things), areas=(area,))


WORDINGS: Final = 12  # wordings of one task
LEAST_WORDINGS: Final = 8
FIRST_SEED: Final = 1_000_000  # smallest seed of an episode, far above the benchmark's
MAX_SEED: Final = 9_999
KEPT_SEEDS: Final = range(9_001, 9_005)
"""Seeds of evaluation and reinforcement learning; no drive is collected with them."""
GROUPS: Final = 100_000  # layouts of one seed
LAYOUT_TRIES: Final = 4  # layouts tried for one scenario
_DRAWS: Final = 60  # tasks drawn at most for one scenario
_LEAST_WAY_M: Final = 1.0  # least straight distance from the start to the success radius around the goal
_LEAST_LEG_M: Final = 2.0  # shortest leg before a turn
# (range of route length in m, share): the benchmark's routes are 9 to 35 m indoors and 30 to 80 m outdoors.
_INDOORS: Final = (((4.0, 12.0), 0.30), ((9.0, 22.0), 0.40), ((18.0, 36.0), 0.30))
_OUTDOORS: Final = (((6.0, 22.0), 0.30), ((20.0, 48.0), 0.40), ((40.0, 80.0), 0.30))
_BANDS: Final = {"corridor": (((4.0, 14.0), 0.4), ((12.0, 27.0), 0.6))}
_CROWDS: Final = {
    "indoors": ((0, 0.25), (5, 0.1), (10, 0.15), (20, 0.2), (40, 0.18), (60, 0.12)),
    "outdoors": ((20, 0.3), (50, 0.3), (80, 0.25), (120, 0.15)),
    CORRIDOR: ((0, 0.4), (2, 0.2), (5, 0.2), (8, 0.2)),
}
# Probability of keeping a task without turns, with turns, and with turns that must be counted.
_KEEP: Final = (0.2, 0.6, 1.0)
_TAG = 43

_T = TypeVar("_T")


class ScenarioError(ValueError):
    """Invalid arguments, no scenario found, or a scenario that training may not use; one line."""


@dataclass(frozen=True)
class Scenario:
    """One task with its crowd and robot, for one drive or rollout."""

    episode: Episode
    task: Task
    site: Site

    def __post_init__(self) -> None:
        what = f"scenario {self.episode.id}"
        if is_reserved(self.site.layout_seed) or self.episode.seed < FIRST_SEED:
            raise ScenarioError(f"{what}: its layout or seed is the benchmark's")
        if len(self.wordings) < LEAST_WORDINGS:
            raise ScenarioError(f"{what}: expected {LEAST_WORDINGS} wordings or more, found {len(self.wordings)}")
        if held := [text for text in self.wordings if is_held_out(text)]:
            raise ScenarioError(f"{what}: a wording has one of the benchmark's patterns: {held[0]!r}")

    @property
    def kind(self) -> str:
        """Kind of its scene: hospital, office, warehouse, sidewalk or corridor."""
        return self.site.kind

    @property
    def layout_seed(self) -> int:
        """Seed of its scene; data is split into training and validation by it."""
        return self.site.layout_seed

    @property
    def scene(self) -> Scene:
        """Scene, for EpisodeWorld(episode, options, scene=scene)."""
        return self.site.scene

    @property
    def route(self) -> RouteDescription:
        """Description of its route."""
        return self.task.route

    @property
    def wordings(self) -> tuple[str, ...]:
        """Instructions that describe the route."""
        return self.episode.instructions

    def steps_json(self) -> list[dict[str, Any]]:
        """Return the route's steps for a drive's header: side, kind, name, ordinal, at_end and position, m."""
        return [
            {"side": step.side, "kind": step.kind, "name": step.name, "ordinal": step.ordinal, "at_end": step.at_end,
             "at": [round(v, 3) for v in step.at]}
            for step in self.route.steps
        ]  # fmt: skip


def training_episodes(
    seed: int,
    count: int,
    kinds: Mapping[str, float] = SHARES,
    *,
    start: int = 0,
    tasks_per_scene: int = TASKS_PER_SCENE,
    turned_share: float = 0.0,
) -> Iterator[Scenario]:
    """Yield scenarios number `start` to `start + count - 1` of a seed; `kinds` are shares of the layouts by kind.

    `turned_share`: probability that the robot's heading at the start is random and not along its route; the rest of a
    scenario does not depend on it. Raises ScenarioError.
    """
    if not 0 <= seed <= MAX_SEED or count < 0 or start < 0 or tasks_per_scene < 1:
        raise ScenarioError(
            f"expected a seed of 0..{MAX_SEED}, a count and a start of 0 or more, one task a scene or more,"
            f" found {seed}, {count}, {start} and {tasks_per_scene}"
        )
    if start + count > GROUPS * tasks_per_scene:
        raise ScenarioError(f"one seed has {GROUPS} layouts: expected fewer scenarios, found {start + count}")
    group, skip = divmod(start, tasks_per_scene)
    left = count
    while left > 0:
        made = scenario_group(seed, group, kinds, min(tasks_per_scene, skip + left), tasks_per_scene, turned_share)
        yield from made[skip:]
        left -= len(made) - skip
        group, skip = group + 1, 0


def kind_of_group(seed: int, group: int, kinds: Mapping[str, float]) -> str:
    """Return the kind of a group's layout, distributed by the given shares. Raises ScenarioError."""
    try:
        check_shares(kinds)
    except ValueError as error:
        raise ScenarioError(str(error)) from error
    names = [name for name in KINDS if kinds.get(name, 0) > 0]
    # A low-discrepancy sequence (golden ratio) and not random numbers: short runs have the right shares too.
    place = (0.5 + 0.618033988749895 * group + 0.37 * seed) % 1.0
    return _at(place, [(name, kinds[name]) for name in names])


def scenario_group(
    seed: int, group: int, kinds: Mapping[str, float], count: int, tasks_per_scene: int = TASKS_PER_SCENE,
    turned_share: float = 0.0,
) -> list[Scenario]:  # fmt: skip
    """Return the first `count` scenarios of one group, usually of one layout. Raises ScenarioError."""
    kind = kind_of_group(seed, group, kinds)
    sites: dict[int, Site] = {}
    numbers = range(group * tasks_per_scene, group * tasks_per_scene + count)
    return [_first_found(sites, kind, seed, group, number, turned_share) for number in numbers]


def _first_found(
    sites: dict[int, Site], kind: str, seed: int, group: int, number: int, turned_share: float
) -> Scenario:  # fmt: skip
    """Find a scenario in the group's layout, or in the next one if it has none."""
    why = ""
    for attempt in range(LAYOUT_TRIES):
        layout_seed = RESERVED_BELOW + (seed * LAYOUT_TRIES + attempt) * GROUPS + group
        try:
            if attempt not in sites:
                sites[attempt] = Site(kind, layout_seed)
            return _scenario(sites[attempt], seed, number, turned_share)
        except (LayoutError, RouteError) as error:
            why = str(error)
    raise ScenarioError(f"scenario {number} of seed {seed} ({kind}): none in {LAYOUT_TRIES} layouts; the last: {why}")


def _scenario(site: Site, seed: int, number: int, turned_share: float) -> Scenario:
    rng = np.random.default_rng((seed, number, site.layout_seed, _TAG))
    turned, heading = np.random.default_rng((seed, number, site.layout_seed, _TAG, 1)).uniform(size=2)
    outdoors = site.outdoors
    robot = ROBOTS[int(rng.integers(len(ROBOTS)))]
    people = int(_at(float(rng.uniform()), _CROWDS.get(site.kind, _CROWDS["outdoors" if outdoors else "indoors"])))
    why = "none was drawn"
    for _ in range(_DRAWS):
        try:
            task = _draw(site, rng)
        except RouteError as error:
            why = str(error)
            continue
        if not _wanted(site, task, rng):
            why = "it was not wanted"
            continue
        if turned < turned_share:
            task = replace(task, start=(*task.start[:2], round(float(2 * heading - 1) * pi, 3)))
        try:
            return scenario_of(site, task, int(rng.integers(2**31)), robot, people, seed, number)
        except RouteError as error:
            why = str(error)
    raise RouteError(f"{site.scene.name}: no task found in {_DRAWS} draws; the last: {why}")


def scenario_of(site: Site, task: Task, wording_seed: int, robot: str, people: int, seed: int, number: int) -> Scenario:
    """Add true wordings, robot and crowd to a task. Raises RouteError if there is no wording or no path."""
    first = facing(task.start, task.path)
    try:
        texts = wordings(task.route, WORDINGS, wording_seed, held_out=False, first=first)
    except WordingError as error:
        raise RouteError(str(error)) from error
    if any(untrue(text, task.route, first) for text in texts):
        raise RouteError("a wording is not true of it")
    if named_too_small(site.scene, site.lines, task.path, named_landmarks(texts, task.route)):
        raise RouteError("something that is named is nowhere seen well")
    shortest_m = site.robot_grid(robot).distance_m(task.start[:2], task.goal)
    if not isfinite(shortest_m):
        raise RouteError(f"the {robot} cannot get there")
    name = f"{site.scene.name}-{number}"
    episode = Episode(
        id=f"t{seed}-{name}-{people}-{robot}",
        task=name,
        scene=site.scene.name,
        robot=robot,
        people=people,
        seed=FIRST_SEED * (1 + seed) + number,
        start=task.start,
        goal_xy=task.goal,
        instructions=tuple(texts),
        timeout_s=timeout_s(shortest_m, people, site.outdoors),
        threshold_m=site.threshold_m,
        shortest_m=round(shortest_m, 3),
        landmarks=named_landmarks(texts, task.route),
        goal_landmark=task.goal_label,
    )
    return Scenario(episode, task, site)


def _draw(site: Site, rng: np.random.Generator) -> Task:
    if site.kind == CORRIDOR and rng.uniform() < 0.6:
        # Near the demo's start.
        x, y, turn = (float(value) for value in rng.uniform((-0.5, -0.5, -0.3), (4.0, 0.5, 0.3)))
        thing = next(thing for thing in site.scene.objects if thing.label == "vending machine")
        return make_task(site.scene, site.grid, (round(x, 2), round(y, 2), round(turn, 3)), thing)
    length_m = _at(float(rng.uniform()), _BANDS.get(site.kind, _OUTDOORS if site.outdoors else _INDOORS))
    return sample_task(site.scene, site.grid, rng, things=site.goals, length_m=length_m)


def _wanted(site: Site, task: Task, rng: np.random.Generator) -> bool:
    """Return whether to keep a task: randomly by its turns, and only if it is sound."""
    steps = task.route.steps
    if not _long_enough(site, task):
        return False
    worth = 0 if not steps else 2 if any(step.ordinal > 1 for step in steps) else 1
    if site.kind != CORRIDOR and rng.uniform() >= _KEEP[worth]:
        return False
    return _unmistakable(site, task)


def is_sound(site: Site, task: Task) -> bool:
    """Return whether a task is usable by the benchmark's checks: instruction and route agree."""
    return _long_enough(site, task) and _unmistakable(site, task)


def _long_enough(site: Site, task: Task) -> bool:
    (x, y), steps = task.goal, task.route.steps
    if hypot(x - task.start[0], y - task.start[1]) < site.threshold_m + _LEAST_WAY_M:
        return False
    return not any(step.before_m < _LEAST_LEG_M for step in steps if step.before_kind != "room")


def _unmistakable(site: Site, task: Task) -> bool:
    """Return whether no point behind a wall counts as the goal, and the route bends where its description says."""
    return worst_leak(site.grid, task.goal, site.threshold_m) <= 0 and not wrong_bends(task.route, task.path)


def _at(place: float, choices: Sequence[tuple[_T, float]]) -> _T:
    """Return the choice at position `place` in [0, 1) of the cumulative shares of (choice, share) pairs."""
    left = place * sum(share for _, share in choices)
    for choice, share in choices:
        left -= share
        if left < 0:
            return choice
    return choices[-1][0]
