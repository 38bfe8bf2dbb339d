"""Build the DynaNav suite from its four scenes: tasks, wordings, crowds, timeouts; deterministic by fixed seeds.

Run it by hand when scenes or grammar change, and commit the file. A test checks that the file equals the output.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edge.core.cli import command_line, write_named
from firmware_bridge.system.terminal import CommandParser
from sim_hil.benchmark.language.instruction_reading import untrue
from sim_hil.benchmark.language.instructions import WordingError, wordings
from sim_hil.benchmark.language.route import RouteDescription, RouteError
from sim_hil.benchmark.language.task_checks import named_landmarks, named_too_small, worst_leak, wrong_bends
from sim_hil.benchmark.language.tasks import Task, goals, sample_task
from sim_hil.benchmark.language.visibility import Sightlines
from sim_hil.benchmark.suite.episode import ROBOTS, SUITES, Episode, suite_to_toml
from sim_hil.benchmark.suite.robots import robot_grid, route_grid
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Scene, load_scene

NAME, VERSION = "dynanav", 2
WORDINGS = 6
INDOOR_CROWDS = (0, 10, 20, 40, 60)
_DRAWS = 400
LEAST_LEG_M = 3.0
"""Shortest leg before a turn, m: turns in quick succession, or right after the start, are ambiguous."""


def count_turns(route: RouteDescription) -> int:
    """Return the number of a route's turns; a crossing counts as one."""
    return sum(step.side != "straight" or step.kind == "crossing" for step in route.steps)


def has_clear_legs(route: RouteDescription) -> bool:
    """Return whether every turn comes LEAST_LEG_M after the start or the turn before, or leaves a room."""
    return all(step.before_m >= LEAST_LEG_M for step in route.steps if step.before_kind != "room")


@dataclass(frozen=True)
class Wanted:
    """Requirements on a task: kinds of goal object, range of path length, range of the number of turns."""

    task: str
    kinds: tuple[str, ...]
    length_m: tuple[float, float]
    turns: tuple[int, int]
    area_kinds: tuple[str, ...] = ()
    at_end: bool = False
    counted: int = 0  # least ordinal that one of the turns must have

    def fits(self, scene: Scene, task: Task) -> bool:
        """Return whether a drawn task meets the requirements."""
        thing = next(thing for thing in scene.objects if thing.label == task.goal_label)
        route = task.route
        return (
            thing.kind in self.kinds
            and self.length_m[0] <= route.length_m <= self.length_m[1]
            and self.turns[0] <= count_turns(route) <= self.turns[1]
            and (not self.area_kinds or route.goal_area_kind in self.area_kinds)
            and (not self.at_end or route.goal_at_end)
            and has_clear_legs(route)
            and (not self.counted or any(step.ordinal >= self.counted for step in route.steps))
        )


@dataclass(frozen=True)
class Part:
    """A scene's share of the suite."""

    scene: str
    seed: int
    threshold_m: float
    crowds: tuple[tuple[int, ...], ...]  # of each task
    wanted: tuple[Wanted, ...]


_INDOOR = (INDOOR_CROWDS,) * 5
PARTS = (
    Part("hospital", 1, 1.5, _INDOOR, (
        Wanted("vending-machine", ("vending_machine",), (9, 18), (1, 2), ("corridor",)),
        Wanted("hospital-bed", ("hospital_bed",), (12, 24), (1, 2), ("room",), counted=2),
        Wanted("water-dispenser", ("water_dispenser",), (14, 26), (1, 2)),
        Wanted("end-of-hallway", ("double_door",), (18, 34), (1, 1), ("corridor",), at_end=True),
        Wanted("reception", ("reception_desk",), (22, 35), (2, 3), ("lobby",)),
    )),
    Part("office", 2, 1.5, _INDOOR, (
        Wanted("elevator", ("elevator",), (10, 22), (1, 3), ("lobby",)),
        Wanted("carpet", ("carpet",), (10, 22), (1, 2), ("room",)),
        Wanted("coffee-machine", ("coffee_machine", "vending_machine"), (16, 30), (2, 3), ("room",)),
        Wanted("exit-door", ("door",), (14, 32), (1, 2), ("corridor",), at_end=True),
        Wanted("desk", ("desk",), (18, 35), (2, 3), ("room",), counted=2),
    )),
    Part("warehouse", 3, 1.5, _INDOOR, (
        Wanted("cone", ("traffic_cone",), (10, 20), (1, 2), ("aisle",), counted=2),
        Wanted("third-aisle", ("drum", "fire_extinguisher", "wet_floor_sign"), (12, 24), (1, 1), ("aisle",), counted=3),
        Wanted("forklift", ("forklift",), (10, 28), (1, 3), ("yard",)),
        Wanted("pallet-jack", ("pallet_jack",), (14, 32), (2, 3), ("aisle",)),
        Wanted("boxes", ("box_stack",), (8, 30), (1, 2), ("aisle",)),
    )),
    Part("sidewalk", 4, 3.0, ((100, 150), (120, 170), (100, 180), (140, 200), (110, 160)), (
        Wanted("fountain", ("fountain",), (30, 70), (1, 3)),
        Wanted("umbrella", ("umbrella", "umbrella_table"), (35, 80), (1, 3)),
        Wanted("storefront", ("storefront",), (40, 75), (1, 3)),
        Wanted("kiosk", ("kiosk",), (30, 80), (1, 3)),
        Wanted("far-storefront", ("storefront",), (50, 80), (2, 4)),
    )),
)  # fmt: skip


def timeout_s(shortest_m: float, people: int, outdoor: bool) -> float:
    """Return an episode's timeout, a multiple of 5 s: it grows with distance and crowd (paper appendix C).

    It suffices in sync mode: halts of 2 s alternating with 0.5 s of driving give 0.146 m/s at the Go2's limits.
    """
    driving_s = 30.0 + shortest_m / 0.2 if outdoor else 20.0 + shortest_m / 0.12
    return 5.0 * round((driving_s + 0.5 * people) / 5.0)


def build_part(part: Part, progress: Callable[[str], None] = lambda line: None) -> list[Episode]:
    """Return one scene's episodes. Raises ValueError if no drawn task meets a requirement."""
    scene = load_scene(part.scene)
    grids = {robot: robot_grid(scene, robot) for robot in ROBOTS}
    episodes: list[Episode] = []
    for index, (wanted, task) in enumerate(_tasks(part, scene)):
        name = f"{part.scene}-{wanted.task}"
        progress(f"{name}: {task.route.length_m:.1f} m, {len(task.route.steps)} steps")
        texts = tuple(wordings(task.route, WORDINGS, part.seed * 1000 + index, held_out=True))
        lengths = {robot: round(grids[robot].distance_m(task.start[:2], task.goal), 3) for robot in ROBOTS}
        for number, people in enumerate(part.crowds[index]):
            # Each task occurs with both robots, and so does each crowd over a scene's tasks.
            robot = ROBOTS[(number + index) % 2]
            episodes.append(
                Episode(
                    id=f"{name}-{people}-{robot}",
                    task=name,
                    scene=part.scene,
                    robot=robot,
                    people=people,
                    seed=part.seed * 10000 + index * 100 + number,
                    start=task.start,
                    goal_xy=task.goal,
                    instructions=texts,
                    timeout_s=timeout_s(lengths[robot], people, part.scene == "sidewalk"),
                    threshold_m=part.threshold_m,
                    shortest_m=lengths[robot],
                    landmarks=named_landmarks(texts, task.route),
                    goal_landmark=task.goal_label,
                )
            )
    return episodes


def build(progress: Callable[[str], None] = lambda line: None) -> str:
    """Return the suite's TOML text. Raises ValueError if no drawn task meets a requirement."""
    return suite_to_toml(NAME, VERSION, [episode for part in PARTS for episode in build_part(part, progress)])


def _tasks(part: Part, scene: Scene) -> list[tuple[Wanted, Task]]:
    """Return for each requirement the first drawn task that meets it and is valid; goals are distinct."""
    rng = np.random.default_rng((part.seed, 17))
    grid = route_grid(scene)
    lines = Sightlines(scene)
    found: list[tuple[Wanted, Task]] = []
    for index, wanted in enumerate(part.wanted):
        used = {task.goal_label for _, task in found}
        things = [thing for thing in goals(scene) if thing.kind in wanted.kinds and thing.label not in used]
        task = None
        for _ in range(_DRAWS):
            try:
                drawn = sample_task(scene, grid, rng, things=things, length_m=wanted.length_m)
            except RouteError:
                continue
            if wanted.fits(scene, drawn) and _is_valid(part, scene, grid, lines, drawn, part.seed * 1000 + index):
                task = drawn
                break
        if task is None:
            raise ValueError(f"{part.scene}: no task found for {wanted.task}")
        found.append((wanted, task))
    return found


def _is_valid(part: Part, scene: Scene, grid: NavGrid, lines: Sightlines, task: Task, seed: int) -> bool:
    """Return whether a task passes the checks of the validator."""
    try:
        texts = wordings(task.route, WORDINGS, seed, held_out=True)
    except WordingError:
        return False
    return is_true(task, texts, scene, grid, lines, part.threshold_m)


def is_true(
    task: Task, texts: Sequence[str], scene: Scene, grid: NavGrid, lines: Sightlines, threshold_m: float
) -> bool:  # fmt: skip
    """Return whether a task with these instructions passes the validator's checks; `grid`: that of `route_grid`."""
    if any(untrue(text, task.route) for text in texts):
        return False
    if worst_leak(grid, task.goal, threshold_m) > 0 or wrong_bends(task.route, task.path):
        return False
    return not named_too_small(scene, lines, task.path, named_landmarks(texts, task.route))


def _print_progress(line: str) -> None:
    sys.stderr.write(line + "\n")


def build_command(
    argv: Sequence[str] | None, name: str, module: str, make: Callable[[Callable[[str], None]], str]
) -> int:  # fmt: skip
    """Write or check the file of suite `name`, whose text `make` returns; return the exit code."""
    path = SUITES / f"{name}.toml"
    parser = CommandParser(
        prog=f"python -m {module}", description=f"Build the suite {name}.",
        epilog=f"examples:\n  python -m {module}\n  python -m {module} --check --out FILE\n"
        "exit codes: 0 done, 1 the file differs or cannot be built, 2 bad arguments",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--out", type=Path, default=path, metavar="FILE", help=f"suite file (default: {name}.toml)")
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if the file differs")
    args = parser.parse_args(argv)
    try:
        text = make(_print_progress)
        if args.check:
            same = args.out.read_text(encoding="utf-8") == text
            _print_progress(
                f"{args.out} {'is up to date' if same else 'differs from the built suite; run without --check'}"
            )
            return 0 if same else 1
        write_named(args.out, text)
    except (ValueError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


@command_line("build_suite")
def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return build_command(argv, NAME, "sim_hil.benchmark.suite.build", build)


if __name__ == "__main__":
    sys.exit(main())
