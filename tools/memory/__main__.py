"""Measure which part of the runner makes memory grow.

    python -m tools.memory --artifacts out/nano                          every part alone, minutes
    python -m tools.memory --artifacts out/nano --parts generation tick  two of them
    python -m tools.memory --artifacts out/nano --stack 10               the real processes, 10 minutes

Each part repeats its operation at many times its real rate, so that a leak of an hour shows in a minute. The figures
are growth per operation over the later half: bytes that the C library's heap has in use, memory blocks of Python, and
resident memory, also as MiB/h of a real run.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from edge.artifacts.files import ArtifactError, read_manifest
from edge.core.cli import EXIT_CHECK_FAILED, EXIT_DONE, check_result_target, command_line, write_result
from firmware_bridge.core.robot_state import DdsError
from sim_hil.protocols.fault_socket import FaultError
from sim_hil.realtime.children import StepError, uninterrupted
from sim_hil.realtime.robots import GO2, ROBOTS, free_domain
from sim_hil.realtime.stack import socket_dir
from tools.bench import bad_input, command_parser
from tools.memory.gauge import LIMIT_MIB_PER_H, Growth, growth, read_own
from tools.memory.parts import PARTS, Workshop
from tools.memory.stack import SWITCHES, StackRun, as_json, drive, judged, table, trends_of

READINGS = 40
WARM_UP = 0.05
"""Share of the operations before the first reading."""


def measure(name: str, workshop: Workshop, operations: int) -> Growth:
    """Repeat a part's operation and return its growth. Raises what the part raises."""
    part = PARTS[name]
    done: list[int] = []
    readings: list[dict[str, int]] = []
    warm = max(1, round(WARM_UP * operations))
    with part.open(workshop) as operation:
        for number in range(warm):
            operation(number)
        for number in range(warm, warm + operations):
            operation(number)
            if (number - warm + 1) % max(1, operations // READINGS) == 0:
                done.append(number - warm + 1)
                readings.append(read_own(objects=False))
    return growth(name, part.per_h, done, readings)


def parser() -> argparse.ArgumentParser:
    """Return the argument parser."""
    p = command_parser(__doc__, artifacts=True)
    p.add_argument("--parts", nargs="+", choices=tuple(PARTS), default=list(PARTS), metavar="PART", help=_names(PARTS))
    p.add_argument("--operations", type=int, metavar="N", help="operations of each part (default: each part's own)")
    p.add_argument("--stack", type=float, metavar="MINUTES", help="drive the real processes instead")
    p.add_argument("--robot", choices=tuple(ROBOTS), default=GO2.name, help="robot of --stack (default: go2)")
    p.add_argument(
        "--without", nargs="+", choices=tuple(SWITCHES), default=[], metavar="PART",
        help="switch parts of the runner off: " + ", ".join(SWITCHES),
    )  # fmt: skip
    p.add_argument("--trace", type=int, default=0, metavar="FRAMES", help="trace the runner's Python memory (slow)")
    p.add_argument("--out", type=Path, default=Path("out/memory"), metavar="DIR", help="default: out/memory")
    return p


def _names(parts: Iterable[str]) -> str:
    return "parts to measure, of " + ", ".join(parts)


def alone(args: argparse.Namespace) -> tuple[dict[str, Any], bool]:
    """Measure the parts and print a line for each; returns the result and whether all keep the limit."""
    workshop, found = Workshop(args.artifacts, free_domain()), []
    print(
        f"{'part':<12}{'operations':>12}{'heap B/op':>12}{'blocks/op':>12}{'heap MiB/h':>12}{'RSS MiB/h':>12}{'s':>6}"
    )
    for name in args.parts:
        started_s = time.monotonic()
        one = measure(name, workshop, args.operations or PARTS[name].operations)
        figures = f"{one.heap_bytes:12.2f}{one.blocks:12.4f}{one.heap_mib_per_h:12.3f}{one.rss_mib_per_h:12.3f}"
        print(f"{name:<12}{one.operations:>12}{figures}{time.monotonic() - started_s:6.0f}", flush=True)
        found.append(one)
    parts = {one.part: {**asdict(one), "heap_mib_per_h": one.heap_mib_per_h, "rss_mib_per_h": one.rss_mib_per_h}
             for one in found}  # fmt: skip
    return {"parts": parts}, all(one.heap_mib_per_h <= LIMIT_MIB_PER_H for one in found)


def together(args: argparse.Namespace) -> tuple[dict[str, Any], bool]:
    """Drive the real processes and print their trends; returns the result and whether all keep the limit."""
    with socket_dir() as folder:
        run = StackRun(folder, args.artifacts, ROBOTS[args.robot], args.stack, tuple(args.without), args.trace)
        try:
            readings = drive(run, print)
        finally:
            keep_logs(folder, args.out)
    trends = trends_of(readings)
    print("\n".join(table(trends)))
    grown = judged(trends)
    if grown:
        print(f"above {LIMIT_MIB_PER_H} MiB/h: {', '.join(grown)}")
    about = {"robot": args.robot, "minutes": args.stack, "without": args.without}
    return {**about, **as_json(readings)}, not grown


def keep_logs(folder: Path, out: Path) -> None:
    """Copy logs and readings of the processes. Raises OSError."""
    with uninterrupted():
        for file in [*folder.glob("*.log"), *folder.glob("memory-*")]:
            shutil.copyfile(file, out / file.name)


@command_line("memory")
def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    args = parser().parse_args(argv)
    try:
        check_result_target(args.json)
        if args.operations is not None and args.operations < READINGS:
            raise ValueError(f"--operations {args.operations}: expected at least {READINGS}")
        if args.stack is not None and not 0 < args.stack <= 24 * 60:
            raise ValueError(f"--stack {args.stack}: expected minutes above 0, at most a day")
        read_manifest(args.artifacts)
        if args.stack is not None:
            args.out.mkdir(parents=True, exist_ok=True)
    except (ArtifactError, OSError, ValueError) as error:
        return bad_input("memory", error)
    try:
        result, good = alone(args) if args.stack is None else together(args)
    except (ArtifactError, DdsError, FaultError, StepError, OSError) as error:
        sys.stderr.write(f"memory: {error}\n")
        return EXIT_CHECK_FAILED
    write_result(args.json, {"tagged": "measured", "limit_mib_per_h": LIMIT_MIB_PER_H, **result})
    return EXIT_DONE if good else EXIT_CHECK_FAILED


if __name__ == "__main__":
    sys.exit(main())
