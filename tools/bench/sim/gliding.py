"""How near a gliding stand-in comes to its robot, and what it saves (`sim_hil/simulation/gliding.py`).

    python -m tools.bench.sim.gliding --json out/bench/gliding.json

Both are given the same commands on a free floor, such as a policy gives: a forward velocity and a turn that change
every 0.3 to 2 s. The figures: how far apart they are after 1, 3 and 5 s from a common pose, how the base sways, and the
processor time of a simulated second of the body alone, without people and pictures. Exit code 0: done, 2: bad
arguments.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from math import asin, atan2, hypot
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.core.cli import EXIT_BAD_INPUT, EXIT_DONE, check_result_target, command_line, write_result
from edge.core.geometry import SE2
from edge.core.stats import percentiles
from firmware_bridge.system.terminal import CommandParser
from sim_hil.scene.scene import Scene
from sim_hil.simulation.gliding import GLIDES
from sim_hil.simulation.physics import Simulation

Array = NDArray[np.float64]

CONTROL_S: Final = 0.1
HORIZONS_S: Final = (1.0, 3.0, 5.0)
ROBOT_HZ: Final = 480
GLIDE_HZ: Final = 120
_HALF_M: Final = 250.0
SPEED_MPS: Final = (0.0, 0.8)
TURN_RADPS: Final = (-1.0, 1.0)
STAND_SHARE: Final = 0.15


@dataclass(frozen=True)
class Run:
    """One robot's motion every 0.1 s: pose [n, 3] (m, m, rad), sway [n, 3] (height m, roll rad, pitch rad)."""

    pose: Array
    sway: Array
    cpu_per_s: float


def commands(seconds: float, seed: int) -> Array:
    """Return one velocity for each control period [n, 3]: vx m/s, vy m/s, wz rad/s."""
    rng = np.random.default_rng((seed, 77))
    rows: list[tuple[float, float, float]] = []
    while len(rows) < round(seconds / CONTROL_S):
        stands, straight = rng.uniform(size=2)
        vx = 0.0 if stands < STAND_SHARE else float(rng.uniform(*SPEED_MPS))
        wz = 0.0 if straight < 0.3 else float(rng.uniform(*TURN_RADPS))
        rows += [(vx, 0.0, wz)] * int(rng.integers(3, 21))
    return np.array(rows[: round(seconds / CONTROL_S)])


def drive(robot: str, given: Array, *, glides: bool) -> Run:
    """Drive one body through `given` on a floor without anything on it."""
    scene = Scene(
        "floor", (0.0, 0.0, 0.0), (1.0, 0.0), (-_HALF_M, -_HALF_M), (_HALF_M, _HALF_M), "concrete", 0.0, (), (), ()
    )
    simulation = Simulation(
        scene, people=0, seed=0, robot=robot, rate_hz=GLIDE_HZ if glides else ROBOT_HZ, glides=glides
    )
    try:
        simulation.settle()
        steps = round(CONTROL_S * simulation.rate_hz)
        poses, sways = [], []
        begun_s = time.process_time()
        for velocity in given:
            simulation.command(*(float(v) for v in velocity))
            for _ in range(steps):
                simulation.step()
            (x, y, _), heading = simulation.pose()
            state = simulation.render_state()
            poses.append((x, y, heading))
            sways.append((float(state[2]), *roll_pitch(state[3:7])))
        spent_s = time.process_time() - begun_s
    finally:
        simulation.close()
    return Run(np.array(poses), np.array(sways), spent_s / (CONTROL_S * len(given)))


def roll_pitch(quaternion_xyzw: Array) -> tuple[float, float]:
    """Return roll and pitch of a rotation about x, y and z of the world, rad."""
    x, y, z, w = (float(v) for v in quaternion_xyzw)
    pitch = asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)), pitch


def apart(one: Array, two: Array, seconds: float) -> tuple[Array, Array]:
    """Return how far apart two motions are `seconds` after each common pose: m [n] and rad [n]."""
    ahead = round(seconds / CONTROL_S)
    gaps, turns = [], []
    for begin in range(0, len(one) - ahead, 5):
        ends = [SE2(*row[begin]).inverse() @ SE2(*row[begin + ahead]) for row in (one, two)]
        between = ends[0].inverse() @ ends[1]
        gaps.append(hypot(between.x_m, between.y_m))
        turns.append(abs(between.theta_rad))
    return np.array(gaps), np.array(turns)


def measure(robot: str, seconds: float, seed: int) -> dict[str, Any]:
    """Return one robot's figures as JSON values."""
    given = commands(seconds, seed)
    real, glide = (drive(robot, given, glides=glides) for glides in (False, True))
    row: dict[str, Any] = {"robot": robot, "seconds": seconds, "tagged": "measured"}
    for horizon_s in HORIZONS_S:
        gaps, turns = apart(real.pose, glide.pose, horizon_s)
        row[f"apart_m_after_{horizon_s:g}_s"] = percentiles(gaps.tolist(), "p50", "p99")
        row[f"apart_rad_after_{horizon_s:g}_s"] = percentiles(turns.tolist(), "p50", "p99")
    row["sway_sd"] = {
        name: [round(float(v), 5) for v in run.sway.std(axis=0)] for name, run in (("robot", real), ("glide", glide))
    }
    row["cpu_s_per_s"] = {"robot": round(real.cpu_per_s, 4), "glide": round(glide.cpu_per_s, 4)}
    row["ratio"] = round(real.cpu_per_s / glide.cpu_per_s, 2)
    return row


@command_line("gliding")
def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark; returns its exit code."""
    p = CommandParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--seconds", type=float, default=120.0, metavar="S", help="simulated time (default 120)")
    p.add_argument("--seed", type=int, default=0, metavar="N", help="of the commands (default 0)")
    p.add_argument("--json", metavar="FILE|-", help="write the figures as JSON")
    args = p.parse_args(argv)
    check_result_target(args.json)
    if not 10 <= args.seconds <= 3600 or args.seed < 0:
        expected = "expected --seconds 10 to 3600 and --seed 0 or more"
        sys.stderr.write(f"gliding: {expected}, found {args.seconds:g} and {args.seed}\n")
        return EXIT_BAD_INPUT
    rows = [measure(robot, args.seconds, args.seed) for robot in GLIDES]
    for row in rows:
        parts = []
        for seconds in HORIZONS_S:
            gap, turn = (row[f"apart_{unit}_after_{seconds:g}_s"]["p50"] for unit in ("m", "rad"))
            parts.append(f"{gap:.3f} m and {turn:.3f} rad after {seconds:g} s")
        apart_by = ", ".join(parts)
        sys.stdout.write(
            f"{row['robot']}: apart by {apart_by} (medians); processor time {row['ratio']:.1f} times less\n"
        )
    write_result(args.json, {"rows": rows})
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
