"""`python -m sim_hil.benchmark.suite.validate`: check that episodes are feasible and their instructions are true.

Everything is recomputed from scene, start and goal and compared with the suite's file. The rules that describe a route
(route.describe_route) are shared with the builder, so the validator cannot find mistakes in them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

from edge.core.cli import check_result_target, command_line, write_result
from firmware_bridge.system.terminal import CommandParser, one_line
from sim_hil.benchmark.language.instruction_reading import untrue
from sim_hil.benchmark.language.instructions import is_held_out
from sim_hil.benchmark.language.route import RouteError, describe_route
from sim_hil.benchmark.language.task_checks import named_landmarks, named_too_small, worst_leak, wrong_bends
from sim_hil.benchmark.language.tasks import outline_gap_m
from sim_hil.benchmark.language.visibility import Sightlines
from sim_hil.benchmark.suite.episode import ROBOTS, Episode, SuiteError, load_suite, suite_names
from sim_hil.benchmark.suite.robots import ROUTE_CLEARANCE_M, robot_grid, route_grid
from sim_hil.layouts.scenes import open_scene
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Scene, SceneError, SceneObject, Vec2

# Mean speeds at which an episode must be feasible, m/s. Indoors this is below the Go2's mean speed in sync mode
# (0.146 m/s: halts of 2 s before each 0.5 s of driving) and leaves room for detours.
INDOOR_SPEED_MPS, OUTDOOR_SPEED_MPS = 0.12, 0.2
LENGTH_TOLERANCE_M = 0.02
MAX_GOAL_GAP_M = 1.6  # maximum distance from the landmark's outline to the goal

_EXAMPLES = """examples:
  edge-bench validate
  edge-bench validate --suite my_suite.toml --json -
exit codes: 0 all valid, 1 an episode is invalid, 2 the suite or a scene cannot be read"""


@dataclass
class _Place:
    """One scene with its lazily computed grids, path lengths and sightlines."""

    scene: Scene
    grids: dict[str, NavGrid] = field(default_factory=dict)
    lengths: dict[tuple[str, Vec2, Vec2], float] = field(default_factory=dict)

    def grid(self, robot: str) -> NavGrid:
        if robot not in self.grids:
            self.grids[robot] = robot_grid(self.scene, robot)
        return self.grids[robot]

    @cached_property
    def routes(self) -> NavGrid:
        return route_grid(self.scene)

    @cached_property
    def lines(self) -> Sightlines:
        return Sightlines(self.scene)

    @property
    def outdoor(self) -> bool:
        return any(area.kind == "sidewalk" for area in self.scene.areas)

    def thing(self, label: str) -> SceneObject | None:
        return next((thing for thing in self.scene.objects if thing.label == label), None)


class Validator:
    """Checker of episodes that loads each scene once. Raises SceneError for a scene that cannot be read."""

    def __init__(self) -> None:
        self._places: dict[str, _Place] = {}
        self._tasks: dict[tuple[object, ...], list[str]] = {}

    def problems(self, episode: Episode) -> list[str]:
        """Return the problems of an episode, one line each."""
        if episode.scene not in self._places:
            self._places[episode.scene] = _Place(open_scene(episode.scene))
        place = self._places[episode.scene]
        found = _feasible(episode, place)
        # Checks that do not depend on robot and crowd run once per task.
        key = (episode.scene, episode.start, episode.goal_xy, episode.instructions, episode.landmarks,
               episode.goal_landmark, episode.threshold_m)  # fmt: skip
        if key not in self._tasks:
            self._tasks[key] = _truthful(episode, place)
        return found + self._tasks[key]


def _feasible(episode: Episode, place: _Place) -> list[str]:
    grid = place.grid(episode.robot)
    found = []
    if not grid.is_free(*episode.start[:2]):
        found.append(f"the start is not free for a {episode.robot}")
    if not grid.is_free(*episode.goal_xy):
        found.append(f"the goal is not free for a {episode.robot}")
    key = (episode.robot, episode.start[:2], episode.goal_xy)
    if key not in place.lengths:
        place.lengths[key] = grid.distance_m(episode.start[:2], episode.goal_xy)
    length = place.lengths[key]
    if length == float("inf"):
        return [*found, "the goal cannot be reached"]
    if abs(length - episode.shortest_m) > LENGTH_TOLERANCE_M:
        found.append(f"shortest_m is {episode.shortest_m:.3f}, the shortest feasible path has {length:.3f}")
    speed = OUTDOOR_SPEED_MPS if place.outdoor else INDOOR_SPEED_MPS
    if episode.timeout_s < length / speed:
        found.append(f"timeout_s is {episode.timeout_s:.0f}, at {speed} m/s it takes {length / speed:.0f}")
    return found


def _truthful(episode: Episode, place: _Place) -> list[str]:
    scene, grid = place.scene, place.routes
    goal = place.thing(episode.goal_landmark)
    if goal is None or not goal.landmark:
        return [f"goal_landmark {episode.goal_landmark!r} is not a landmark of the scene"]
    found = []
    gap = outline_gap_m(goal, episode.goal_xy)
    if gap > MAX_GOAL_GAP_M:
        found.append(f"the goal is {gap:.1f} m away from the {goal.landmark}")
    if (leak := worst_leak(grid, episode.goal_xy, episode.threshold_m)) > 0:
        found.append(f"a spot within the threshold is {leak:.1f} m too far by path: the goal counts through a wall")
    path = grid.path(episode.start[:2], episode.goal_xy)
    if path is None:
        return [*found, f"no path for a robot of radius {ROUTE_CLEARANCE_M} m"]
    try:
        route = describe_route(scene, grid, path, goal)
    except RouteError as error:
        return [*found, f"the route cannot be described: {error}"]
    found += wrong_bends(route, path)
    for text in episode.instructions:
        found += [f"{text!r}: {problem}" for problem in untrue(text, route)]
        if not is_held_out(text):
            found.append(f"{text!r}: this sentence pattern belongs to training")
    if not found:
        named = set(named_landmarks(episode.instructions, route))
        if named != set(episode.landmarks):
            found.append(f"landmarks are {sorted(episode.landmarks)}, the instructions name {sorted(named)}")
    return found + named_too_small(scene, place.lines, path, episode.landmarks)


def validate(episodes: Sequence[Episode]) -> dict[str, list[str]]:
    """Return problems by episode id; valid episodes are left out."""
    validator = Validator()
    found = {episode.id: validator.problems(episode) for episode in episodes}
    return {name: lines for name, lines in found.items() if lines}


@command_line("validate")
def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser(
        prog="edge-bench validate",
        description="Check that a suite's episodes are feasible and their instructions are true.",
        epilog=_EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument(
        "--suite", default="dynanav", metavar="S", help=f"{', '.join(suite_names())}, or a .toml file"
    )  # fmt: skip
    parser.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    args = parser.parse_args(argv)
    try:
        check_result_target(args.json)
        episodes = load_suite(args.suite)
        wrong = validate(episodes)
    except (SuiteError, SceneError, OSError) as error:
        sys.stderr.write(f"edge-bench validate: {one_line(error)}\n")
        return 2
    result = {
        "suite": args.suite,
        "episodes": len(episodes),
        "tasks": len({episode.task for episode in episodes}),
        "wordings": sum(len(t) for t in {episode.instructions for episode in episodes}),
        "robots": {robot: sum(episode.robot == robot for episode in episodes) for robot in ROBOTS},
        "wrong": len(wrong),
        "problems": wrong,
    }
    write_result(args.json, result)
    for name, lines in wrong.items():
        for line in lines:
            sys.stderr.write(f"{name}: {line}\n")
    sys.stderr.write(f"{len(episodes)} episodes, {len(wrong)} of them invalid\n")
    return 1 if wrong or not episodes else 0


if __name__ == "__main__":
    sys.exit(main())
