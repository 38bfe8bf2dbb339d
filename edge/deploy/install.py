"""`edge-install`: what has to be done on the device itself before the runner may start."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import load_artifacts
from edge.artifacts.trust import KeyFileError
from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_DONE,
    EXIT_REFUSED,
    check_result_target,
    command_line,
    messages,
    write_result,
)
from edge.deploy import board, boot, dds_binding, install_units
from edge.deploy.unit_text import UnitError
from edge.inference import engines
from edge.reasoning.prompt import InstructionError
from firmware_bridge.core.config import ConfigError
from firmware_bridge.system.terminal import CommandParser

EXAMPLES = """examples:
  edge-install engines --artifacts out/orin
  edge-install engines --artifacts out/orin --engines /var/lib/tic-vla/engines --json -
  edge-install units --artifacts out/orin --robot go2.toml --instruction "walk to the vending machine" --out units
  sudo edge-install units --home /opt/tic-vla-edge --artifacts /opt/tic-vla-edge/current/artifacts \\
       --robot /etc/tic-vla-edge/go2.toml --instruction-file /etc/tic-vla-edge/instruction.txt \\
       --network 192.168.123.161/32 --system
  edge-install dds
  sudo edge-install board --wheel tic_vla_edge-0.1.0-py3-none-any.whl --artifacts out/cpu --extras cpu,unitree
  sudo edge-install rollback
  sudo edge-install boot --watchdog 30 --power-mode 40W

units needs a robot file with operator_arm = true in [safety], or --arm-at-start. An interrupted build of engines keeps
the finished ones: run it again to go on.

exit codes: 0 done, 1 a step failed or systemd finds fault with the units, 2 bad arguments or input,
            3 refused (artifacts, device), 130 interrupted
"""


def parser() -> argparse.ArgumentParser:
    """Command line of `edge-install`."""
    p = CommandParser(
        "edge-install", description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = p.add_subparsers(dest="command", required=True)
    build = commands.add_parser(
        "engines", help="build the engines of TensorRT and OpenVINO now, so that none is built at run time"
    )
    build.add_argument("--artifacts", type=Path, required=True, metavar="DIR", help="artifact directory")
    build.add_argument(
        "--engines", type=Path, metavar="DIR", help="where to keep them (default: DIR.engines beside it)"
    )
    build.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    service = commands.add_parser(
        "units", help="write systemd units, users and firewall of bridge and runner, and check them"
    )
    install_units.add_arguments(service)
    dds_binding.add_arguments(commands.add_parser("dds", help="install a Cyclone DDS binding that works on this board"))
    board.add_parsers(commands)
    boot.add_arguments(
        commands.add_parser("boot", help="set the hardware watchdog and a Jetson's power mode at start-up")
    )
    return p


_print = messages("edge-install")


@command_line(
    "edge-install",
    {
        ArtifactError: EXIT_REFUSED,
        engines.EngineError: EXIT_REFUSED,
        **dict.fromkeys((OSError, ConfigError, InstructionError, KeyFileError, UnitError), EXIT_BAD_INPUT),
    },
)
def main(
    argv: Sequence[str] | None = None, machine: engines.Machine | None = None, host: install_units.Host | None = None
) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    if args.command == "dds":
        return dds_binding.run(args, _print)
    if args.command == "boot":
        return boot.run(args, _print)
    if args.command in board.COMMANDS:
        return board.run(args, _print)
    check_result_target(args.json)
    if args.command == "units":
        return install_units.run(args, _print, host)
    return _build_engines(args, machine)


def _build_engines(args: argparse.Namespace, machine: engines.Machine | None) -> int:
    started_ns = time.monotonic_ns()
    directory = args.artifacts.absolute()
    where = args.engines.absolute() if args.engines is not None else engines.default_directory(directory)
    if where == directory or directory in where.parents:
        _print(f"--engines {args.engines}: lies inside the artifact directory, which is sealed; name another")
        return EXIT_BAD_INPUT
    artifacts = load_artifacts(directory)
    graphs = engines.build(artifacts, where, _print, machine)
    if not graphs:
        _print(f"{artifacts.target}: no graph needs an engine")
    wall_s = round((time.monotonic_ns() - started_ns) / 1e9, 3)
    write_result(args.json, {"engines": str(where), "graphs": graphs, "wall_s": wall_s})
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
