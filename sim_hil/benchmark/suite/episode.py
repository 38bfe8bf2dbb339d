"""Benchmark suite as data: tasks (start, goal, instructions) and their episodes (robot, crowd, seed, timeout).

A suite is a TOML file. Episodes of one task share start, goal and instructions. They differ in crowd density, robot and
timeout (paper appendix C: "share the same semantic objective but differ in crowd density, robot platform and timeout").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import degrees, hypot, isfinite, radians
from pathlib import Path
from typing import Any

import tomli_w

from firmware_bridge.system.input_file import parse_toml, read_text
from sim_hil.scene.table import Table

SUITES = Path(__file__).with_name("suites")
ROBOTS = ("go2", "carter")
FORMAT = 1  # of the file; `version` in the file identifies the suite's data
MIN_WORDINGS = 4
MAX_PEOPLE = 200

_TASK_KEYS = ("task", "scene", "goal_xy", "threshold_m", "goal_landmark", "landmarks", "instructions")
_EPISODE_KEYS = ("id", "robot", "people", "seed", "timeout_s", "shortest_m")

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]


class SuiteError(ValueError):
    """An invalid suite; one line: what, expected, found."""


@dataclass(frozen=True)
class Episode:
    """One run of the benchmark from `start` (x m, y m, theta rad) to `goal_xy` (m) by instruction.

    `landmarks`: labels of the scene's objects that the instructions name; `goal_landmark`: the one at the goal.
    `shortest_m` is the length of the shortest feasible path for this robot (paper equation 9).
    """

    id: str
    task: str
    scene: str
    robot: str
    people: int
    seed: int
    start: Vec3
    goal_xy: Vec2
    instructions: tuple[str, ...]
    timeout_s: float
    threshold_m: float
    shortest_m: float
    landmarks: tuple[str, ...]
    goal_landmark: str

    def __post_init__(self) -> None:
        what = f"episode {self.id!r}"
        if not self.id or any(not (char.isalnum() or char in "-_.") for char in self.id):
            raise SuiteError(f"{what}: an id is made of letters, digits, '-', '_' and '.'")
        if self.robot not in ROBOTS:
            raise SuiteError(f"{what}: unknown robot {self.robot!r}, expected one of {', '.join(ROBOTS)}")
        if not 0 <= self.people <= MAX_PEOPLE:
            raise SuiteError(f"{what}: people must be within 0..{MAX_PEOPLE}, found {self.people}")
        if self.seed < 0:
            raise SuiteError(f"{what}: seed must be 0 or more, found {self.seed}")
        numbers = (*self.start, *self.goal_xy, self.timeout_s, self.threshold_m, self.shortest_m)
        if not all(isfinite(number) for number in numbers):
            raise SuiteError(f"{what}: every number must be finite")
        if min(self.timeout_s, self.threshold_m, self.shortest_m) <= 0:
            raise SuiteError(f"{what}: timeout_s, threshold_m and shortest_m must be positive")
        straight_m = hypot(self.goal_xy[0] - self.start[0], self.goal_xy[1] - self.start[1])
        if straight_m <= self.threshold_m:
            raise SuiteError(f"{what}: the start lies within the threshold of the goal")
        if not self.instructions or any(not text.strip() for text in self.instructions):
            raise SuiteError(f"{what}: expected instructions, none of them empty")
        if len(set(self.instructions)) != len(self.instructions):
            raise SuiteError(f"{what}: expected different instructions, found one twice")
        if self.goal_landmark not in self.landmarks:
            raise SuiteError(f"{what}: goal_landmark {self.goal_landmark!r} is not among its landmarks")


def _task(table: Table) -> list[Episode]:
    task, (x, y, heading_deg) = table.text("task"), table.vector("start_deg", 3)
    instructions = table.texts("instructions")
    if len(instructions) < MIN_WORDINGS:
        raise SuiteError(f"task {task!r}: expected {MIN_WORDINGS} wordings or more, found {len(instructions)}")
    shared: dict[str, Any] = {
        "task": task,
        "scene": table.text("scene"),
        "start": (x, y, radians(heading_deg)),
        "goal_xy": table.vector("goal_xy", 2),
        "instructions": instructions,
        "threshold_m": table.number("threshold_m"),
        "landmarks": table.texts("landmarks"),
        "goal_landmark": table.text("goal_landmark"),
    }
    episodes = []
    for row in table.tables("episodes"):
        row.what = f"task {task!r}, {row.what}"
        name, robot, people, seed = row.text("id"), row.text("robot"), row.whole("people"), row.whole("seed")
        timeout_s, shortest_m = row.number("timeout_s"), row.number("shortest_m")
        episodes.append(
            Episode(
                id=name, robot=robot, people=people, seed=seed, timeout_s=timeout_s, shortest_m=shortest_m, **shared
            )
        )
        row.done()
    table.done()
    return episodes


def parse_suite(text: str, source: str) -> tuple[Episode, ...]:
    """Parse a suite's TOML text into episodes, in the file's order; `source` names it in errors. Raises SuiteError."""
    try:
        table = Table("suite", parse_toml(text), SuiteError)
        if (found := table.whole("format")) != FORMAT:
            raise SuiteError(f"format {FORMAT} expected, found {found}")
        table.text("name")
        table.whole("version")
        episodes = [episode for task in table.tables("tasks") for episode in _task(task)]
        table.done()
        if not episodes:
            raise SuiteError("expected [[tasks]] with [[tasks.episodes]], found none")
    except ValueError as error:  # of the parser, and SuiteError
        raise SuiteError(f"{source}: {error}") from error
    return tuple(episodes)


def suite_names() -> list[str]:
    """Return the names of the shipped suites."""
    return sorted(path.stem for path in SUITES.glob("*.toml"))


def load_suite(name_or_path: str | Path) -> tuple[Episode, ...]:
    """Load the episodes of a shipped suite or a TOML file; ids are unique. Raises SuiteError."""
    path = Path(name_or_path)
    if path.suffix != ".toml":
        if str(name_or_path) not in suite_names():
            known = ", ".join(suite_names())
            raise SuiteError(f"unknown suite {str(name_or_path)!r}, expected one of {known}, or a .toml file")
        path = SUITES / f"{name_or_path}.toml"
    try:
        text = read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise SuiteError(f"{path}: cannot be read: {error}") from error
    episodes = parse_suite(text, path.name)
    ids = [episode.id for episode in episodes]
    if twice := sorted({name for name in ids if ids.count(name) > 1}):
        raise SuiteError(f"{path.name}: expected unique episode ids, found {twice[0]!r} twice")
    return episodes


def suite_to_toml(name: str, version: int, episodes: Sequence[Episode]) -> str:
    """Format a suite as TOML for `parse_suite`; the episodes of one task must be adjacent."""
    tasks: list[dict[str, Any]] = []
    for episode in episodes:
        if not tasks or tasks[-1]["task"] != episode.task:
            x, y, theta = episode.start
            task = {key: getattr(episode, key) for key in _TASK_KEYS}
            tasks.append({**task, "start_deg": (x, y, round(degrees(theta), 6)), "episodes": []})
        tasks[-1]["episodes"].append({key: getattr(episode, key) for key in _EPISODE_KEYS})
    head = "# Written by `python -m sim_hil.benchmark.suite.build`; a test holds the two equal.\n"
    return head + tomli_w.dumps({"format": FORMAT, "name": name, "version": version, "tasks": tasks})
