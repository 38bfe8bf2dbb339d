"""Flight log of an episode: the runner's records, the policy's pictures and the simulator's truth.

`edge-replay explain` and `edge-replay video` read it like a robot's log. Everything stays in memory until `keep`, so
that an episode that nobody asks about costs no disk.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from math import atan2, hypot, pi
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.core.geometry import SE2
from edge.flightlog.part import LogPart, PartFile, Payload
from sim_hil.benchmark.env.metrics import Outcome
from sim_hil.benchmark.language.visibility import EYE_M, Sightlines
from sim_hil.benchmark.suite.episode import Episode
from sim_hil.benchmark.suite.robots import robot_grid
from sim_hil.scene.nav_grid import NavGrid, length_m
from sim_hil.scene.scene import Scene

_PEOPLE_M: Final = 10.0
"""Distance within which people are recorded, m."""
_AHEAD_M: Final = 3.0
"""Length of the shortest path over which its direction is taken, m: about the plan's 3 s."""
_ROUTE_EVERY: Final = 5
"""Control periods from one shortest path to the next: a path takes milliseconds."""

Vec2 = tuple[float, float]


class EpisodeFlight:
    """Records of one episode; `keep` writes them, otherwise they are lost. It is the recorder of the policy's loop."""

    def __init__(self, path: Path, scene: Scene, episode: Episode) -> None:
        self._path, self._scene, self._episode = path, scene, episode
        self._records: list[tuple[str, int, Payload]] = []
        self._truths: list[tuple[int, dict[str, Any]]] = []

    def put(self, topic: str, stamp_ns: int, payload: Payload) -> None:
        """Add a record of the policy, as `Recorder.put`."""
        self._records.append((topic, stamp_ns, payload))

    def see(self, stamp_ns: int, pose: SE2, people: NDArray[np.float64], touching: Iterable[str]) -> None:
        """Add the true state of the world at an instant of the records' clock.

        `people`: (x m, y m, heading rad) [n, 3]; `touching`: labels of what the robot touches.
        """
        near = people[np.hypot(people[:, 0] - pose.x_m, people[:, 1] - pose.y_m) < _PEOPLE_M] if len(people) else people
        self._truths.append(
            (
                stamp_ns,
                {
                    "pose": pose.as_tuple(),
                    "people": [[round(float(value), 3) for value in row] for row in near],
                    "touching": sorted(touching),
                },
            )
        )

    def settle(self, choice: str, outcome: Outcome, folder: Path) -> None:
        """Keep the log, its cause alone below the run's `folder`, or nothing: `choice` is --flight-logs.

        Raises OSError.
        """
        if choice == "none" or (choice != "all" and outcome.success and not outcome.collided):
            return
        self.keep(outcome)
        if choice == "causes":
            from sim_hil.benchmark.results.causes import keep_cause  # here: most episodes need no explanation

            keep_cause(self._path, folder)

    def keep(self, outcome: Outcome) -> None:
        """Write the log, whole or not at all. Raises OSError."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        partial = self._path.with_suffix(".partial")
        part = LogPart(PartFile(partial, new=False), 1)
        try:
            end_ns = self._truths[-1][0] if self._truths else 0
            run = [record for record in self._records if record[0] == "/run"]
            rest = [record for record in self._records if record[0] != "/run"]
            grid, sightlines = robot_grid(self._scene, self._episode.robot), Sightlines(self._scene)
            for number, (at_ns, truth) in enumerate(self._truths):
                x_m, y_m, _ = truth["pose"]
                seen = {"people_seen": sightlines.persons((x_m, y_m, EYE_M), truth["people"]).tolist()}
                route = {} if number % _ROUTE_EVERY else _route(grid, truth["pose"], self._episode.goal_xy)
                rest.append(("/truth", at_ns, {**truth, **seen, **route}))
            for record in (*run, *sorted(rest, key=lambda record: record[1])):
                part.add(*record)
            part.add("/result", end_ns, outcome_record(outcome))
            part.finish()
        finally:
            part.file.close()
        partial.replace(self._path)


def outcome_record(outcome: Outcome) -> dict[str, Any]:
    """Return the `/result` record of an episode."""
    return {
        "end": outcome.end,
        "success": outcome.success,
        "collisions": list(outcome.collisions),
        "first_collision_s": outcome.first_collision_s,
        "ne_m": outcome.ne_m,
        "duration_s": outcome.time_s,
        "faults": [],
    }


def _route(grid: NavGrid, pose: Sequence[float], goal: Vec2) -> Mapping[str, float | None]:
    """Return length and direction of the shortest path to the goal (None without one), and the clearance here."""
    x_m, y_m, theta_rad = pose
    path = grid.path((x_m, y_m), goal)
    clearance_m = round(float(grid.clearance_m(x_m, y_m)), 3)
    if path is None:
        return {"route_m": None, "route_bearing_rad": None, "clearance_m": clearance_m}
    ahead = _along(path, _AHEAD_M)
    seen = SE2(x_m, y_m, theta_rad).inverse() @ SE2(*ahead, 0.0)
    bearing = (atan2(seen.y_m, seen.x_m) + pi) % (2 * pi) - pi if hypot(seen.x_m, seen.y_m) > 0.3 else None
    return {
        "route_m": round(length_m(path), 3),
        "route_bearing_rad": None if bearing is None else round(bearing, 4),
        "clearance_m": clearance_m,
    }


def _along(path: Sequence[Vec2], distance_m: float) -> Vec2:
    """Return the point of a polyline at a distance from its start; its end where it is shorter."""
    left_m = distance_m
    for a, b in itertools.pairwise(path):
        step_m = hypot(b[0] - a[0], b[1] - a[1])
        if step_m >= left_m > 0:
            share = left_m / step_m
            return (a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share)
        left_m -= step_m
    return path[-1]
