"""The locomotion table: how the simulated Go2 follows commands, and which pushes make it fall.

    python -m tools.bench.locomotion --json out/bench/locomotion.json
    python -m tools.bench.locomotion --rate 240 --minutes 5 --seeds 2 --jobs 2

Commanded against achieved velocity (means over 3 s after settling) on flat ground, over 5 cm bumps and an 8 degree ramp
(up, down, across); falls in minutes of random commands; pushes, falls and recoveries; seconds of simulation per second
of processor time. `--rate` is the physics' rate: 500 Hz is edge-hil's. Exit code 1 if a row exceeds its bound.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from itertools import product
from math import degrees
from multiprocessing import get_context
from typing import Any

from edge.core.cli import EXIT_CHECK_FAILED, EXIT_DONE, check_result_target, command_line, write_result
from reporting.progress import Progress
from tools.bench import bad_input, command_parser
from tools.bench.sim.locomotion_runs import (
    PUSHES,
    ROUTES,
    Endured,
    Pushed,
    Row,
    Speed,
    endure,
    measure_speed,
    push_over,
    track,
    travel,
)

Command = tuple[float, float, float]

FORWARD_MPS = (-0.8, -0.6, -0.3, -0.1, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.5)
SIDEWAYS_MPS = (-0.5, -0.3, -0.1, 0.1, 0.3, 0.5)
TURNS_RADPS = (-1.2, -1.0, -0.5, -0.2, 0.2, 0.5, 1.0, 1.2)
SPEED_RATES_HZ = (500, 480, 240)


@dataclass(frozen=True)
class Job:
    """One simulation and its part of the table."""

    part: str
    call: Callable[..., object]
    args: tuple[object, ...]


def envelope() -> tuple[Command, ...]:
    """Return every flat-ground command of the table: each axis alone, then combinations."""
    alone: list[Command] = [(vx, 0.0, 0.0) for vx in FORWARD_MPS]
    alone += [(0.0, vy, 0.0) for vy in SIDEWAYS_MPS] + [(0.0, 0.0, wz) for wz in TURNS_RADPS]
    mixed = product((-0.6, 0.0, 0.6, 1.0, 1.5), (-0.3, 0.0, 0.3), (-1.0, -0.5, 0.0, 0.5, 1.0))
    return (*alone, *(command for command in mixed if sum(part != 0.0 for part in command) > 1))


def plan(rate_hz: int, minutes: float, seeds: Sequence[int], repeats: int) -> list[Job]:
    """Return all jobs of a run; measurements of speed are last and run alone."""
    jobs = [Job("endurance", endure, (rate_hz, seed, 60.0 * minutes)) for seed in seeds]
    jobs += [Job("ground", travel, (name, rate_hz)) for name in ROUTES]
    jobs += [Job("pushes", push_over, (index, rate_hz)) for index in range(len(PUSHES))]
    jobs += [Job("flat", track, (command, rate_hz)) for command in envelope()]
    return jobs + [Job("speed", measure_speed, (rate, repeat)) for repeat in range(repeats) for rate in SPEED_RATES_HZ]


def _run(job: Job) -> object:
    return job.call(*job.args)


def run_all(jobs: Sequence[Job], processes: int) -> dict[str, list[Any]]:
    """Run all jobs; returns results by part in the order of the jobs. Measurements of speed run alone."""
    results: dict[str, list[Any]] = {part: [] for part in ("flat", "ground", "endurance", "pushes", "speed")}
    with Progress("locomotion: ", bar=True) as progress:
        for together in (True, False):
            chosen = [job for job in jobs if (job.part != "speed") == together]
            if not chosen:
                continue
            # Spawned, not forked: a physics client does not survive a fork.
            with ProcessPoolExecutor(processes if together else 1, mp_context=get_context("spawn")) as pool:
                for done, (job, result) in enumerate(zip(chosen, pool.map(_run, chosen), strict=True), 1):
                    results[job.part].append(result)
                    progress.show("walks" if together else "speed", done, len(chosen))
    return results


def _numbers(command: Sequence[float]) -> str:
    return "(" + ", ".join(f"{part:6.2f}" for part in command) + ")"


def _row_line(row: Row) -> str:
    return (
        f"  {'ok  ' if row.kept else 'FAIL'} {row.name:22s} {_numbers(row.commanded)} -> {_numbers(row.achieved)}"
        f"  off {100 * row.error_share:4.1f} %  tilt {degrees(row.tilt_rad):4.1f} deg  torque {row.torque_share:.2f}"
        f"{'  FELL' if row.fell else ''}"
    )


def table(results: dict[str, list[Any]]) -> str:
    """Format the table: (vx m/s, vy m/s, wz rad/s) commanded -> achieved."""
    flat: list[Row] = results["flat"]
    ground: list[Row] = results["ground"]
    lines = [f"flat: {len(flat)} commands, {sum(row.kept for row in flat)} within their bound"]
    lines += [_row_line(row) for row in flat]
    lines += ["uneven ground:", *(_row_line(row) for row in ground)]
    endured: list[Endured] = results["endurance"]
    minutes = sum(run.minutes for run in endured)
    lines.append(f"random commands: {minutes:.1f} min, {sum(run.falls for run in endured)} falls")
    lines += [
        f"  {'ok  ' if run.kept else 'FAIL'} seed {run.seed}: {run.minutes:.1f} min, {run.commands} commands,"
        f" {run.path_m:.0f} m, {run.falls} falls, worst tilt {degrees(run.tilt_rad):.1f} deg"
        for run in endured
    ]
    pushed: list[Pushed] = results["pushes"]
    lines.append("pushes of 0.1 s, standing and walking:")
    lines += [
        f"  {'ok  ' if push.kept else 'FAIL'} {push.name:24s} {push.impulse_ns:5.1f} N.s "
        + (f"fell, limp in {push.limp_s:.2f} s, up again {push.recovered_s:.1f} s later" if push.fell else "stayed up")
        for push in pushed
    ]
    for rate, speeds in _speeds(results["speed"]).items():
        step, physics, control, factor = (
            statistics.median(getattr(speed, name) for speed in speeds)
            for name in ("step_us", "physics_us", "control_us", "sim_s_per_cpu_s")
        )
        lines.append(
            f"speed at {rate} Hz: {factor:.1f} s of simulation per second of processor; a step takes {step:.0f} us, "
            f"physics {physics:.0f} and control {control:.0f} of it"
        )
    return "\n".join(lines)


def _speeds(speeds: Sequence[Speed]) -> dict[int, list[Speed]]:
    return {rate: chosen for rate in SPEED_RATES_HZ if (chosen := [s for s in speeds if s.rate_hz == rate])}


@command_line("locomotion")
def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    p = command_parser(__doc__)
    p.add_argument("--rate", type=int, default=500, metavar="HZ", help="steps of physics a second (default 500)")
    p.add_argument(
        "--minutes", type=float, default=30.0, metavar="M", help="minutes of random commands per seed (default 30)"
    )
    p.add_argument("--seeds", type=int, default=3, metavar="N", help="random walks (default 3)")
    p.add_argument("--repeats", type=int, default=5, metavar="N", help="measurements of speed (default 5, 0: none)")
    p.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (default 1)")
    args = p.parse_args(argv)
    try:
        if not 200 <= args.rate <= 1000:
            raise ValueError(f"--rate: expected 200..1000, found {args.rate}")
        if args.minutes < 0 or min(args.seeds, args.repeats) < 0 or args.jobs < 1:
            raise ValueError("expected --minutes, --seeds and --repeats of 0 or more and --jobs of 1 or more")
        check_result_target(args.json)
    except (ValueError, OSError) as error:
        return bad_input("locomotion", error)
    jobs = plan(args.rate, args.minutes, range(args.seeds), args.repeats)
    results = run_all(jobs, args.jobs)
    kept = all(result.kept for part in ("flat", "ground", "endurance", "pushes") for result in results[part])
    (sys.stderr if args.json == "-" else sys.stdout).write(table(results) + "\n")
    rows = {part: [{**asdict(result), "kept": getattr(result, "kept", None)} for result in results[part]]
            for part in results}  # fmt: skip
    write_result(args.json, {"passed": kept, "rate_hz": args.rate, "settings": vars(args), **rows})
    return EXIT_DONE if kept else EXIT_CHECK_FAILED


if __name__ == "__main__":
    sys.exit(main())
