"""`edge-calib`: replaces modelled numbers of a device or a robot by measured ones."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Mapping
from typing import Final

from edge.core.cli import command_line
from firmware_bridge.system.terminal import CommandParser

JOBS: Final[Mapping[str, tuple[str, str]]] = {
    "latency": ("calib.latency", "measure how long generations take beside control, for edge-bench and edge-train"),
    "odometry": ("calib.odometry", "fit scale, bias and drift of a robot's odometry to a flight log"),
    "power": ("calib.power", "measure power at rest and in every stage, and fit the plan's energy model"),
}

EXAMPLES: Final = """examples:
  edge-calib latency --artifacts out/nano --out orin.latency.json
  edge-calib odometry flight.mcap --robot go2.toml --out go2.odometry.toml
  edge-calib power --artifacts out/nano --out orin.power.toml
exit codes: 0 done, 1 what was measured is not good enough to be used, 2 bad arguments or input, 3 refused: the device
cannot be measured, 130 interrupted
"""


def parser() -> argparse.ArgumentParser:
    """Command line of `edge-calib`; a job's own options come from its module."""
    p = CommandParser(
        "edge-calib", description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    jobs = p.add_subparsers(dest="job", required=True, metavar="JOB")
    for name, (module, summary) in JOBS.items():
        job = jobs.add_parser(name, help=summary, description=summary)
        importlib.import_module(module).add_arguments(job)
    return p


@command_line("edge-calib")
def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    return int(importlib.import_module(JOBS[args.job][0]).run(args))


if __name__ == "__main__":
    sys.exit(main())
