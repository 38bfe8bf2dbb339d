"""How fast does lockstep run, and on what is the time spent? Expert episodes among crowds, with and without the camera.

    python -m tools.bench.sim.lockstep --json out/bench/lockstep.json
    python -m tools.bench.sim.lockstep --case hospital:go2:20 --case sidewalk:go2:200 --seconds 30

Each case drives the expert for so many seconds of simulation, one process, and times every control period by part: the
picture, the expert's thinking, people, physics (engine, robot's controller, contact watch). Parts are timed by wall
clock and by the process's own CPU time, because others may use the machine; the verdict is on CPU time of one core.
The targets: 5 times real time with 20 people and 1 with 200, with the camera. Exit code 1: missed.
"""

from __future__ import annotations

import argparse
import functools
import sys
import time
from collections.abc import Callable
from math import atan2
from typing import Any, Final

import numpy as np
import pybullet

from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, check_result_target, command_line, write_result
from sim_hil.benchmark.env.world import EpisodeWorld, WorldOptions
from sim_hil.benchmark.policies.baselines import make_baseline
from sim_hil.benchmark.suite.episode import Episode
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Scene, SceneError, load_scene

CASES: Final = ("hospital:go2:0", "hospital:go2:20", "hospital:carter:20", "hospital:go2:60", "sidewalk:go2:200")
TARGETS: Final = ((20, 5.0), (200, 1.0))
"""(up to so many people, times real time)."""
CONTROL_S: Final = 0.1
PARTS: Final = ("picture", "expert", "people", "physics engine", "robot", "contacts")


class Meter:
    """Wall and CPU nanoseconds spent in named parts since it was last asked."""

    def __init__(self) -> None:
        self.spent: dict[str, list[int]] = {}

    def timed(self, part: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """The call, its time booked on a part."""

        @functools.wraps(call)
        def run(*args: Any, **named: Any) -> Any:
            wall, cpu = time.perf_counter_ns(), time.process_time_ns()
            try:
                return call(*args, **named)
            finally:
                spent = self.spent.setdefault(part, [0, 0])
                spent[0] += time.perf_counter_ns() - wall
                spent[1] += time.process_time_ns() - cpu

        return run

    def take(self) -> dict[str, list[int]]:
        """What was spent; starts again at zero."""
        spent, self.spent = self.spent, {}
        return spent


def make_episode(scene: Scene, robot: str, people: int, seed: int) -> Episode:
    """A long drive between two places far apart, drawn by the seed."""
    grid = NavGrid(scene, clearance_m=0.5)
    cells, rng = np.argwhere(grid.free & (grid.clearances > 0.8)), np.random.default_rng((seed, 17))
    for _ in range(200):
        a, b = (grid.centre(*(int(v) for v in cells[rng.integers(len(cells))])) for _ in range(2))
        path = grid.path(a, b)
        if path is not None and grid.distance_m(a, b) > 25.0:
            heading = atan2(path[1][1] - a[1], path[1][0] - a[0])
            return Episode(
                id=f"{scene.name}-{robot}-{people}",
                task="bench",
                scene=scene.name,
                robot=robot,
                people=people,
                seed=seed,
                start=(*a, heading),
                goal_xy=b,
                instructions=("Go.",),
                timeout_s=600.0,
                threshold_m=1.5,
                shortest_m=grid.distance_m(a, b),
                landmarks=("goal",),
                goal_landmark="goal",
            )
    raise ValueError(f"scene {scene.name}: expected places more than 25 m of way apart, found none")


def measure(case: str, seconds: float, camera: tuple[int, int] | None, seed: int) -> dict[str, Any]:
    """Drive one case; its samples are per control period, ms of wall and of CPU time."""
    name, robot, people = case.split(":")
    scene, meter = load_scene(name), Meter()
    samples: list[dict[str, list[float]]] = []
    simulated = 0.0
    begun = time.process_time_ns()
    setup_s = 0.0
    while simulated < seconds:
        episode = make_episode(scene, robot, int(people), seed)
        with EpisodeWorld(episode, WorldOptions(camera=camera), scene=scene) as world:
            policy = make_baseline("expert")
            policy.reset(episode, "Go.", world, seed)
            world.observe()
            setup_s += (time.process_time_ns() - begun) / 1e9
            observe, act = meter.timed("picture", world.observe), meter.timed("expert", policy.act)
            unwrap = _instrument(world, meter)
            try:
                while not world.done and simulated < seconds:
                    wall, cpu = time.perf_counter_ns(), time.process_time_ns()
                    world.step(act(observe()))
                    parts = {part: [ns / 1e6 for ns in spent] for part, spent in meter.take().items()}
                    total = [(time.perf_counter_ns() - wall) / 1e6, (time.process_time_ns() - cpu) / 1e6]
                    samples.append({**parts, "total": total})
                    simulated += CONTROL_S
            finally:
                unwrap()
        seed += 1
        begun = time.process_time_ns()
    wall_s, cpu_s = (sum(sample["total"][clock] for sample in samples) / 1e3 for clock in (0, 1))
    return {
        "case": case,
        "camera": camera,
        "simulated_s": round(simulated, 1),
        "setup_cpu_s": round(setup_s, 3),
        "times_real": {"wall": round(simulated / wall_s, 2), "cpu": round(simulated / cpu_s, 2)},
        "mean_cpu_ms": {part: round(_mean(samples, part), 3) for part in (*PARTS, "total")},
        "samples_ms": samples,
    }


def _instrument(world: EpisodeWorld, meter: Meter) -> Callable[[], None]:
    """Time what a simulation step is made of; returns what puts everything back."""
    simulation = world._simulation
    step, robot = pybullet.stepSimulation, simulation.robot
    walkers = simulation._walkers
    pybullet.stepSimulation = meter.timed("physics engine", step)
    for thing, method, part in (
        (walkers, "step", "people"),
        (walkers, "poses", "people"),
        (simulation, "_place_people", "people"),
        (robot, "drive", "robot"),
        (robot, "observe", "robot"),
        (simulation, "_watch", "contacts"),
    ):
        setattr(thing, method, meter.timed(part, getattr(thing, method)))

    def unwrap() -> None:
        pybullet.stepSimulation = step

    return unwrap


def _mean(samples: list[dict[str, list[float]]], part: str) -> float:
    return sum(sample.get(part, [0.0, 0.0])[1] for sample in samples) / max(len(samples), 1)


def verdict(row: dict[str, Any]) -> bool | None:
    """Whether a case with a camera meets its target; None for one without."""
    if row["camera"] is None:
        return None
    people = int(row["case"].split(":")[2])
    target = next((times for most, times in TARGETS if people <= most), TARGETS[-1][1])
    return bool(row["times_real"]["cpu"] >= target)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"expected WxH such as 128x128, found {text!r}")
    return int(width), int(height)


@command_line("lockstep")
def main(argv: list[str] | None = None) -> int:
    """Command line; see the module's page for the exit codes."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        prog="python -m tools.bench.sim.lockstep",
    )
    parser.add_argument("--case", action="append", metavar="SCENE:ROBOT:PEOPLE", help=f"default: {' '.join(CASES)}")
    parser.add_argument("--seconds", type=float, default=40.0, help="of simulation, each case (default 40)")
    parser.add_argument("--camera", type=_size, default=(128, 128), metavar="WxH", help="default 128x128")
    parser.add_argument("--no-camera", action="store_true", help="drive without pictures only")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", metavar="FILE|-", help="write the result, every sample included, as JSON")
    args = parser.parse_args(argv)
    rows = []
    try:
        check_result_target(args.json)
        for case in args.case or CASES:
            for camera in (None,) if args.no_camera else (args.camera, None):
                row = measure(case, args.seconds, camera, args.seed)
                rows.append(row)
                times, parts = row["times_real"], row["mean_cpu_ms"]
                shares = ", ".join(f"{part} {parts[part]:.2f}" for part in PARTS if parts[part])
                sys.stderr.write(
                    f"{case:22} camera {'none' if camera is None else f'{camera[0]}x{camera[1]}':8}"
                    f" {times['cpu']:6.1f} x real time (wall {times['wall']:.1f});"
                    f" a period of 100 ms costs {parts['total']:.2f} ms: {shares}; set-up {row['setup_cpu_s']:.2f} s\n"
                )
    except (SceneError, ValueError, OSError) as error:
        sys.stderr.write(f"lockstep: {error}\n")
        return EXIT_BAD_INPUT
    verdicts = [verdict(row) for row in rows]
    passed = True in verdicts and False not in verdicts
    if True not in verdicts and False not in verdicts:
        sys.stderr.write("lockstep: no case has a target (those with a camera do): nothing was judged\n")
    write_result(args.json, {"passed": passed, "targets": TARGETS, "cases": rows})
    return EXIT_DONE if passed else EXIT_CHECK_FAILED


if __name__ == "__main__":
    sys.exit(main())
