"""Fuzz one decoder of the bridge.

    python -m tools.fuzz --decoder can --inputs 1000000 --seed 0

Random and mutated input reaches the backend as from its network; no runner asks the bridge's rules to arm. The run
fails on an exception, on a request or a sent message that could move the robot, and on a report with an impossible
number.
Exit codes: 0 nothing found; 1 found; 2 bad arguments; 130 interrupted.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, command_line
from firmware_bridge.core.config import ConfigError, load_robot_config
from firmware_bridge.system.terminal import CommandParser
from sim_hil.realtime.robots import ROBOT_FILES, free_domain
from tools.fuzz.harness import FuzzError, Target, fuzz, to_stderr

ROBOTS = {
    "can": "carter_can_sim.toml",
    "mavlink": "carter_mavlink_sim.toml",
    "ros2": "carter_ros2_sim.toml",
    "unitree": "go2_sim.toml",
}
"""Robot file of each decoder's default."""


def open_target(decoder: str, robot: Path) -> Target:
    """Open the target of a decoder; only its own library is loaded. Raises ConfigError for another robot's file."""
    domain = free_domain() if decoder in ("unitree", "ros2") else None
    config = load_robot_config(robot, domain=domain)
    if config.protocol != decoder:
        raise ConfigError(f"{robot}: expected protocol {decoder}, found {config.protocol}")
    if decoder == "can":
        from tools.fuzz.can_target import CanTarget

        return CanTarget(config)
    if decoder == "mavlink":
        from tools.fuzz.mavlink_target import MavlinkTarget

        return MavlinkTarget(config)
    from tools.fuzz.dds_targets import ros2_target, unitree_target

    return unitree_target(config) if decoder == "unitree" else ros2_target(config)


@command_line("fuzz")
def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser(
        prog="python -m tools.fuzz", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--decoder", choices=sorted(ROBOTS), required=True)
    parser.add_argument("--inputs", type=int, default=1_000_000, metavar="N", help="default 1000000")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="default 0")
    parser.add_argument("--robot", type=Path, metavar="FILE.toml", help="default: the simulated robot's file")
    args = parser.parse_args(argv)
    if args.inputs < 1:
        sys.stderr.write(f"fuzz: --inputs: expected 1 or more, found {args.inputs}\n")
        return EXIT_BAD_INPUT
    try:
        target = open_target(args.decoder, args.robot or ROBOT_FILES / ROBOTS[args.decoder])
    except ConfigError as error:
        sys.stderr.write(f"fuzz: {error}\n")
        return EXIT_BAD_INPUT
    try:
        result = fuzz(args.decoder, target, args.inputs, args.seed, to_stderr)
    except FuzzError as error:
        sys.stderr.write(f"fuzz: {error}\n")
        return EXIT_CHECK_FAILED
    finally:
        target.close()
    sys.stdout.write(json.dumps(asdict(result), indent=2) + "\n")
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
