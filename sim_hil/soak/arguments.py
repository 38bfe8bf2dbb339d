"""Command line of `edge-soak`: drives task after task for hours with random faults and judges the measurements.

This module loads no simulation, which takes seconds: bad arguments are refused at once.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Final

from edge.core.cli import check_result_directory, check_result_target
from edge.inference.release import parse_release_delay
from firmware_bridge.system.input_file import MAX_INTEGER
from firmware_bridge.system.terminal import CommandParser
from sim_hil.realtime.robots import GO2, MAX_DOMAIN, ROBOTS
from sim_hil.robots.odometry_noise import LEVELS
from sim_hil.scene.scene import load_scene
from sim_hil.soak.faults import SoakInputError

SUMMARY: Final = "Drive task after task for hours in real time with random faults, and judge the measurements."
MODES: Final = ("async", "sync", "no-reasoning")
UNTRAINED_MPS: Final = 0.14
"""Default speed limit for untrained weights, m/s: they drive into walls, which below 0.2 m/s (edge.odometry.gate) does
not end the run, so that the growth of the runner can be measured."""
MAX_PEOPLE: Final = 500
"""The limit of `edge-hil`, whose module loads scipy."""
SHORTEST_LEG_S: Final = 15.0
LONGEST_LEG_S: Final = 86_400.0
LONGEST_SOAK_S: Final = 30 * 86_400.0
_UNITS_S: Final = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86_400.0}
EXAMPLES = """examples:
  edge-soak --artifacts out/nano --duration 2h --out out/soak
  edge-soak --artifacts out/nano --duration 8h --people 12 --scene hospital --scene office --out out/night
  edge-soak --artifacts out/nano --duration 8h --out out/night --resume      # with the same options, after a kill
  edge-soak --artifacts out/nano --duration 5m --faults none --json - --out out/quick
  edge-soak --artifacts out/nano --duration 2h --robot carter-can --out out/carter

A leg is one run of the stack (edge-hil, edge-bridge, edge-run) in one scene, with one task after another.
Default budget and faults: sim_hil/soak/budget.toml and sim_hil/soak/faults.toml; copy and change them. Only the go2
has the faults of the robot's side: other robots get those that end a process.
A soak ends after the leg in which a budget line failed that no later leg can mend.
exit codes: 0 budget met, 1 budget exceeded, undecided, or no leg could run, 2 bad arguments or input,
            3 refused (artifacts), 130 interrupted (a report of the finished part is written)
"""


def parser() -> argparse.ArgumentParser:
    """Return the argument parser."""
    p = CommandParser(
        "edge-soak", description=SUMMARY, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--artifacts", type=Path, required=True, metavar="DIR", help="directory made by edge-export")
    p.add_argument(
        "--duration", type=parse_seconds, required=True, metavar="T", help="total time, such as 90s, 10m, 1h or 1d"
    )
    p.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="directory for samples, legs, result.json and report.html",
    )
    p.add_argument("--faults", default="default", metavar="FILE|none", help="fault menu (default: the package's)")
    p.add_argument("--budget", type=Path, metavar="FILE", help="budget file (default: the package's)")
    p.add_argument(
        "--scene",
        action="append",
        metavar="NAME|FILE",
        help="scene (default hospital); if repeated, one per leg in turn",
    )
    p.add_argument("--people", type=int, default=6, metavar="N", help="walking people (default 6)")
    p.add_argument(
        "--seed", type=int, default=0, metavar="N", help="random seed of tasks, people and faults (default 0)"
    )
    p.add_argument("--leg", type=parse_seconds, default=7200.0, metavar="T", help="length of a leg (default 2h)")
    p.add_argument("--mode", choices=MODES, default="async", help="reasoning mode of edge-run (default async)")
    p.add_argument("--release-delay", default="0", metavar="S|PROFILE", help="release delay of edge-run (default 0)")
    p.add_argument(
        "--odometry-noise", choices=tuple(LEVELS), default="none", help="odometry drift in edge-hil (default none)"
    )
    p.add_argument(
        "--speed-limit",
        type=float,
        metavar="MPS",
        help=f"forward speed limit (default: the robot file's; untrained weights: {UNTRAINED_MPS})",
    )
    p.add_argument("--robot", choices=tuple(ROBOTS), default=GO2.name, help=f"robot to drive (default {GO2.name})")
    p.add_argument("--domain", type=int, metavar="N", help="DDS domain of a robot with DDS (default: a free one)")
    p.add_argument("--keep-logs", action="store_true", help="keep the flight logs (about 0.5 GiB an hour)")
    p.add_argument(
        "--to-the-end", action="store_true", help="drive on although a budget line failed that no later leg can mend"
    )
    p.add_argument("--resume", action="store_true", help="continue the soak in --out for the remaining time")
    p.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    return p


def parse_seconds(text: str) -> float:
    """Parse a time such as 90s, 10m, 1.5h, 1d or 90 to seconds. Raises argparse.ArgumentTypeError."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smhd]?)", text, re.ASCII)
    if match is None:
        raise argparse.ArgumentTypeError(f"expected a time such as 90s, 10m or 1h, found {text!r}")
    return float(match[1]) * _UNITS_S[match[2] or "s"]


def check(args: argparse.Namespace) -> None:
    """Check everything but the artifacts and the folder. Raises SoakInputError, SceneError or OSError."""
    check_result_target(args.json)
    check_result_directory(args.out)
    parse_release_delay(args.release_delay)
    if not SHORTEST_LEG_S <= args.duration <= LONGEST_SOAK_S:
        raise SoakInputError(f"--duration: expected {SHORTEST_LEG_S:g} s to 30 days, found {args.duration:g} s")
    if not SHORTEST_LEG_S <= args.leg <= LONGEST_LEG_S:
        raise SoakInputError(f"--leg: expected {SHORTEST_LEG_S:g} s to a day, found {args.leg:g} s")
    if not 0 <= args.people <= MAX_PEOPLE:
        raise SoakInputError(f"--people: expected 0 to {MAX_PEOPLE}, found {args.people}")
    if not 0 <= args.seed <= MAX_INTEGER:
        raise SoakInputError(f"--seed: expected 0 to {MAX_INTEGER}, found {args.seed}")
    if args.domain is not None and not 0 <= args.domain <= MAX_DOMAIN:
        raise SoakInputError(f"--domain: expected 0 to {MAX_DOMAIN}, found {args.domain}")
    for scene in args.scene or ():
        if not load_scene(scene).landmarks():
            raise SoakInputError(f"--scene {scene}: expected landmarks to drive to, found none; give another scene")
    if args.speed_limit is not None and not 0.02 <= args.speed_limit <= 1.5:
        raise SoakInputError(f"--speed-limit: expected 0.02 to 1.5 m/s, found {args.speed_limit}")
