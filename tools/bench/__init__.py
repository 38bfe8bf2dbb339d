"""Benchmarks that print one table each: `python -m tools.bench.NAME`."""

import argparse
import sys
from pathlib import Path

from edge.core.cli import EXIT_BAD_INPUT
from firmware_bridge.system.terminal import CommandParser, one_line


def command_parser(page: str | None, *, artifacts: bool = False) -> argparse.ArgumentParser:
    """Create a parser with the module's docstring as help and the benchmarks' common options."""
    p = CommandParser(description=page, formatter_class=argparse.RawDescriptionHelpFormatter)
    if artifacts:
        p.add_argument("--artifacts", type=Path, required=True, metavar="DIR", help="artifact directory")
    p.add_argument("--json", metavar="FILE|-", help="write figures and samples as JSON")
    return p


def bad_input(name: str, error: Exception) -> int:
    """Report bad arguments or input in one line; returns the exit code."""
    sys.stderr.write(f"{name}: {one_line(error)}\n")
    return EXIT_BAD_INPUT
