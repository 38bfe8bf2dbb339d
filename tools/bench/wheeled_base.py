"""The wheeled base's table: what the simulated Carter makes of its commands, what it climbs, how its odometry drifts.

    python -m tools.bench.wheeled_base --json out/bench/wheeled_base.json
    python -m tools.bench.wheeled_base --minutes 5 --rate 480

Commanded against achieved velocity (means over 2 s after settling); ramps, edges, kerbs at several speeds; odometry's
error per metre over laps of a random course; minutes of random commands; seconds of simulation a second of processor
buys (every repeat is kept). Exit codes: 0 done, 1 a row is not within its bound, 2 bad arguments.
"""

from __future__ import annotations

import math
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, TypeVar

import numpy as np

from edge.core.cli import EXIT_CHECK_FAILED, EXIT_DONE, check_result_target, command_line, write_result
from sim_hil.robots.carter.wheel_odometry import WheelCalibration
from tools.bench import bad_input, command_parser
from tools.bench.sim.wheeled_course import World, forward_mps

Row = dict[str, object]
Result = TypeVar("Result")

SPEEDS_MPS: Final = (-1.5, -0.8, -0.3, 0.1, 0.3, 0.5, 0.8, 1.0, 1.5)
TURNS_RADPS: Final = (-2.0, -1.0, -0.3, 0.3, 1.0, 2.0)
ARCS: Final = ((0.3, 1.0), (0.6, -0.8), (1.0, 0.5), (1.0, -1.0), (1.5, 0.5), (-0.5, 0.5))
TRACKING_BOUND: Final = 0.03
RAMPS_DEG: Final = (4.0, 8.0, 12.0)
STEPS_M: Final = (0.01, 0.02, 0.03, 0.10, 0.15, 0.20)
CLIMBING_MPS: Final = (0.3, 0.6, 1.0)
MUST_CLIMB_DEG: Final = 8.0
MUST_CLIMB_M: Final = 0.02
MUST_STOP_M: Final = 0.15
BENCHMARK_HZ: Final = 240
SPEED_RATES_HZ: Final = (240, 480, 500)
SPEED_S: Final = 20.0
LONGEST_MIN: Final = 1440.0
REAL_TIME_BOUND: Final = 40.0  # at the benchmark's rate


def tracked(world: World, v: float, w: float) -> Row:
    """Mean velocities over 2 s, after 3 s."""
    world.go().run(3.0, v, w)
    samples = []
    for _ in range(40):
        truth = world.run(0.05, v, w)
        samples.append((forward_mps(truth), float(truth.gyro_radps[2])))
    mean_v, mean_w = (float(value) for value in np.mean(samples, axis=0))
    good = abs(mean_v - v) <= max(TRACKING_BOUND * abs(v), 0.01) and abs(mean_w - w) <= max(
        TRACKING_BOUND * abs(w), 0.01
    )
    return {"commanded": [v, w], "achieved": [round(mean_v, 4), round(mean_w, 4)], "good": good}


def climbed_ramp(world: World, degrees: float, v: float) -> Row:
    """Whether it gets up a ramp of 4 m, and how far it rolls back in 3 s of rest on it."""
    world.ramp(1.0, degrees, 6.0)
    world.go().run(1.0 + 4.0 / v, v)
    world.run(1.5, 0.0)
    before = world.truth()
    rolled_m = float(np.linalg.norm(world.run(3.0).position_m - before.position_m))
    up = bool(before.position_m[2] > 0.3 * math.sin(math.radians(degrees)) and world.robot.up() > 0.9)
    return {
        "degrees": degrees,
        "v": v,
        "up": up,
        "rolled_m": round(rolled_m, 4),
        "good": up or degrees > MUST_CLIMB_DEG,
    }


def met_step(world: World, rise_m: float, v: float) -> Row:
    """Whether it gets onto a step, or is stopped with its front bumper pressed."""
    world.box((5.0, 0.0, rise_m / 2), (8.0, 6.0, rise_m))
    truth = world.go().run(1.0 + 2.5 / v, v)
    up = bool(truth.position_m[2] > 0.8 * rise_m and truth.position_m[0] > 1.6)
    stopped = bool(truth.bumpers.front and abs(forward_mps(truth)) < 0.02)
    good = (up or rise_m > MUST_CLIMB_M) and (stopped or rise_m < MUST_STOP_M)
    return {"rise_m": rise_m, "v": v, "up": up, "bumper_stop": stopped, "good": good}


def drifted(world: World, minutes: float, seed: int) -> Row:
    """Random commands; the odometry's errors every 10 m of way, and how far it ever tilted."""
    rng = np.random.default_rng((seed, 0xB0))
    world.go()
    errors: list[tuple[float, float]] = []
    upright = 1.0
    for _ in range(round(minutes * 60 / 2)):
        (x, y, _), heading = world.robot.pose()
        # Back towards the middle before the floor ends.
        home = math.remainder(math.atan2(-y, -x) - heading, math.tau) / 2
        v, w = (1.0, home) if math.hypot(x, y) > 20.0 else (float(rng.uniform(-0.5, 1.5)), float(rng.uniform(-1, 1)))
        truth = world.run(2.0, v, w)
        upright = min(upright, world.robot.up())
        if truth.odometry.distance_m >= 10.0 * (len(errors) + 1):
            reported, true = truth.odometry.T_odom_base, truth.position_m
            away_m = math.hypot(reported.x_m - float(true[0]), reported.y_m - float(true[1]))
            errors.append((away_m, math.remainder(reported.theta_rad - float(truth.rpy_rad[2]), math.tau)))
    return {
        "minutes": minutes,
        "way_m": round(world.truth().odometry.distance_m, 1),
        "upright_min": round(upright, 5),
        "error_m_every_10_m": [round(away, 4) for away, _ in errors],
        "heading_error_rad_every_10_m": [round(turned, 5) for _, turned in errors],
        "good": upright > 0.99,
    }


def real_time_factor(world: World) -> float:
    """Seconds of simulation per second of this thread's processor, driving an arc."""
    world.go().run(1.0, 1.0, 0.5)
    begin_ns = time.thread_time_ns()
    world.run(SPEED_S, 1.0, 0.5)
    return SPEED_S / ((time.thread_time_ns() - begin_ns) / 1e9)


def alone(measure: Callable[[World], Result], rate_hz: int, calibration: WheelCalibration | None = None) -> Result:
    """Measure in a world of its own."""
    with TemporaryDirectory(prefix="wheeled-base-") as folder:
        world = World(Path(folder), rate_hz, calibration)
        try:
            return measure(world)
        finally:
            world.close()


def run(rate_hz: int, minutes: float, repeats: int) -> dict[str, list[Row]]:
    """All rows of the table."""
    commands = [(v, 0.0) for v in SPEEDS_MPS] + [(0.0, w) for w in TURNS_RADPS] + list(ARCS)
    rows: dict[str, list[Row]] = {
        "tracking": [alone(partial(tracked, v=v, w=w), rate_hz) for v, w in commands],
        "ramps": [
            alone(partial(climbed_ramp, degrees=degrees, v=v), rate_hz) for degrees in RAMPS_DEG for v in CLIMBING_MPS
        ],
        "steps": [alone(partial(met_step, rise_m=rise, v=v), rate_hz) for rise in STEPS_M for v in CLIMBING_MPS],
        "random commands, wheels as believed": [alone(partial(drifted, minutes=minutes, seed=0), rate_hz)],
        "random commands, wheels measured with ordinary care": [
            alone(partial(drifted, minutes=minutes / 5, seed=seed), rate_hz, WheelCalibration.drawn(seed))
            for seed in (1, 2, 3)
        ],
        "speed": [],
    }
    for rate in SPEED_RATES_HZ:
        factors = [round(alone(real_time_factor, rate), 1) for _ in range(repeats)]
        good = rate != BENCHMARK_HZ or statistics.median(factors) > REAL_TIME_BOUND
        rows["speed"].append({"rate_hz": rate, "real_time_factors": factors, "good": good})
    return rows


@command_line("wheeled_base")
def main(argv: list[str] | None = None) -> int:
    """Command line; see the module's page for the exit codes."""
    parser = command_parser(__doc__)
    parser.add_argument("--rate", type=int, default=BENCHMARK_HZ, metavar="HZ", help="of the physics (default 240)")
    parser.add_argument("--minutes", type=float, default=30.0, metavar="N", help="of random commands (default 30)")
    parser.add_argument("--repeats", type=int, default=5, metavar="N", help="of the speed (default 5)")
    args = parser.parse_args(argv)
    try:
        if not 200 <= args.rate <= 1000:
            raise ValueError(f"--rate: expected 200..1000, found {args.rate}")
        if not 0 < args.minutes <= LONGEST_MIN:
            raise ValueError(f"--minutes: expected more than 0, up to {LONGEST_MIN:g}, found {args.minutes}")
        if args.repeats < 1:
            raise ValueError(f"--repeats: expected 1 or more, found {args.repeats}")
        check_result_target(args.json)
        rows = run(args.rate, args.minutes, args.repeats)
        write_result(args.json, {"rate_hz": args.rate, **rows})
    except (ValueError, OSError) as error:
        return bad_input("wheeled_base", error)
    bad = 0
    for part, found in rows.items():
        for row in found:
            bad += not row["good"]
            cells = ", ".join(f"{key} {_short(value)}" for key, value in row.items() if key != "good")
            sys.stderr.write(f"{'ok ' if row['good'] else 'BAD'} {part}: {cells}\n")
    return EXIT_CHECK_FAILED if bad else EXIT_DONE


def _short(value: object) -> object:
    """A long list by its length and its last element; the rest is in the JSON."""
    return f"[{len(value)} values, last {value[-1]}]" if isinstance(value, list) and len(value) > 6 else value


if __name__ == "__main__":
    sys.exit(main())
