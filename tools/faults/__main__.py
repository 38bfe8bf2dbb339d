"""Inject every fault into real processes on loopback and measure, on the robot's side, how soon the robot stops.

edge-hil, edge-bridge and edge-run run as a user would start them; edge-run has a plan that keeps the robot moving, and
switches for internal faults. A sniffer, a separate process, stamps every request that reaches the robot.
"""

from __future__ import annotations

import argparse
import fnmatch
import json
import os
import random
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rich.console import Console

from edge.artifacts.files import read_manifest
from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    EXIT_INTERRUPTED,
    check_result_directory,
    check_result_target,
    command_line,
    messages,
    write_result,
)
from edge.flightlog.recorder import space_refusal
from firmware_bridge.system.terminal import CommandParser
from sim_hil.protocols.fault_socket import FaultError
from sim_hil.realtime.children import StepError, uninterrupted
from sim_hil.realtime.host_stall import HostStall
from sim_hil.realtime.robots import GO2, MAX_DOMAIN, ROBOTS, StackRobot
from sim_hil.realtime.stack import socket_dir
from tools.faults.measure import Sample, injection
from tools.faults.report import RowResult, markdown, read_results, result, show
from tools.faults.rig.busy import MOST_BUSY, busy_processes
from tools.faults.rig.processes import Rig
from tools.faults.rows import CONTRACT, Judge, Row, rows
from tools.report.machine import machine_facts

_print = messages("faults")

PER_ROW = 5
"""Injections a row by default; slow rows get their share of it."""
EXAMPLES = """examples:
  python -m tools.faults --artifacts out/nano --out out/faults
  python -m tools.faults --artifacts out/nano --out out/faults --rows "camera*" --rows "runner SIG*" --per-row 20
  python -m tools.faults --robot carter-can --contract --per-row 20 --artifacts out/nano --out out/contract/carter-can
  python -m tools.faults --artifacts out/nano --out out/faults --per-row 20 --resume --load 2
  python -m tools.faults --table out/contract/go2 out/contract/carter-can
  python -m tools.faults --list
exit codes: 0 every bound held, 1 a bound did not hold or an injection failed, 2 bad arguments, 130 interrupted"""


def parser() -> argparse.ArgumentParser:
    """Return the argument parser."""
    p = CommandParser(
        "python -m tools.faults",
        description=__doc__,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("--artifacts", type=Path, metavar="DIR", help="directory made by edge-export")
    p.add_argument("--out", type=Path, default=Path("out/faults"), metavar="DIR", help="default: out/faults")
    p.add_argument("--rows", action="append", metavar="GLOB", help="only rows whose name matches (may be repeated)")
    p.add_argument(
        "--per-row", type=int, metavar="N", help=f"injections of every row (default: {PER_ROW}, of slow rows fewer)"
    )
    p.add_argument(
        "--load",
        type=int,
        default=0,
        metavar="N",
        help="keep N busy processes of ordinary priority beside, while the robot drives (default: 0)",
    )
    p.add_argument("--seed", type=int, default=0, help="seed of the injection times (default: 0)")
    p.add_argument("--robot", choices=tuple(ROBOTS), default=GO2.name, help=f"robot to drive (default: {GO2.name})")
    p.add_argument("--domain", type=int, metavar="N", help="DDS domain of a robot with DDS (default: a free one)")
    p.add_argument("--contract", action="store_true", help="only the rows of the table of backends and faults")
    p.add_argument(
        "--resume", action="store_true", help="keep the injections that --out already has, and make the missing ones"
    )
    p.add_argument(
        "--table", nargs="+", type=Path, metavar="DIR", help="print the results in these folders as a table, and exit"
    )
    p.add_argument("--list", action="store_true", help="print the rows with their criteria and exit")
    p.add_argument("--json", metavar="FILE|-", help="also write the result to this file; - is stdout")
    return p


def chosen(globs: Sequence[str] | None, robot: StackRobot = GO2, *, contract: bool = False) -> list[Row]:
    """Return the robot's rows whose names match. Raises ValueError if a pattern matches none."""
    everything = rows(robot)
    if contract:
        everything = tuple(row for row in everything if row.name in CONTRACT)
    for glob in globs or ():
        if not any(fnmatch.fnmatch(row.name, glob) for row in everything):
            raise ValueError(f"--rows {glob!r}: no such row; see --list")
    return [row for row in everything if not globs or any(fnmatch.fnmatch(row.name, glob) for glob in globs)]


def count(row: Row, per_row: int | None) -> int:
    """Return the number of injections of a row; None: the default, of which slow rows get a share."""
    return max(1, round(row.share * PER_ROW)) if per_row is None else per_row


def run_row(
    rig: Rig,
    row: Row,
    times: int,
    rng: random.Random,
    host: HostStall,
    *,
    kept: RowResult | None = None,
    busy: int = 0,
    keep: Callable[[RowResult], None] = lambda result: None,
) -> RowResult:
    """Make all injections of one row. Raises FaultError if the robot's side does not answer.

    `kept`: the row's result of an earlier call, which counts; `keep` takes the result after every injection.
    """
    samples = [] if kept is None else list(kept.samples)
    repeated = 0 if kept is None else kept.repeated
    done = RowResult(row, samples, repeated, 0.0 if kept is None else kept.load, busy)
    for index in range(len(samples), times):
        sample = attempt(rig, row, rng, host)
        _show(row, f"{index + 1}/{times}", sample)
        if sample.hindered:
            repeated += 1
            if row.judged_by is not Judge.UNCHANGED and (sample.wrong or not sample.stood):
                samples.append(sample)  # the robot stopped as required, or did what it must not
            sample = attempt(rig, row, rng, host)
            _show(row, f"{index + 1}/{times} again", sample)
            sample.wrong += sample.hindered
        samples.append(sample)
        done = RowResult(row, samples, repeated, round(os.getloadavg()[0], 1), busy)
        keep(done)
    return done


def attempt(rig: Rig, row: Row, rng: random.Random, host: HostStall) -> Sample:
    """Make one injection, then wait for the row's pause."""
    begun_ns = time.monotonic_ns()
    try:
        rig.stand_in = row.by_bridge
        rig.ensure_moving()
        begun_ns = time.monotonic_ns()  # without the start of a runner: the pause is between two effects
        sample = injection(rig, row, rng, host)
    except (FaultError, StepError) as error:
        # A fault without effect or a runner that does not drive fails only this injection.
        sample = Sample(None, 0.0, [str(error).splitlines()[0]])
        rig.kill_runner()
        rig.clear()  # raises if edge-hil has ended, which ends the whole run
    time.sleep(max(0.0, row.spacing_s - (time.monotonic_ns() - begun_ns) / 1e9))
    return sample


def _show(row: Row, which: str, sample: Sample) -> None:
    latency = "never" if sample.latency_ms is None else f"{sample.latency_ms:.0f} ms"
    wrong = "; ".join(sample.wrong + sample.hindered)
    _print(f"{row.name} {which}: {latency} of {row.bound_ms:.0f} ms{wrong and f' ({wrong})'}")


def run(args: argparse.Namespace, wanted: Sequence[Row]) -> list[RowResult]:
    """Inject into all rows; results until an interrupt or a failure of the rig stay in their file (`result_file`).

    Raises StepError if no flight could be recorded, FaultError if edge-hil does not answer.
    """
    robot, file = ROBOTS[args.robot], result_file(args.out, args.load)
    results = {one.row.name: one for one in (read_results(file, rows(robot)) if args.resume else [])}

    def keep(one: RowResult) -> None:
        results[one.row.name] = one
        write_result(str(file), result(list(results.values()), machine_facts(), robot.name, args.load))

    with ExitStack() as stack:
        folder = stack.enter_context(socket_dir())
        refusal = space_refusal(folder / "flight.mcap")
        if refusal is not None:
            raise StepError(f"{folder}: {refusal}")
        stack.callback(keep_logs, folder, args.out)
        host = stack.enter_context(HostStall())
        rig = stack.enter_context(Rig(folder, args.artifacts.absolute(), args.domain, _print, stack_robot=robot))
        _print(f"starting the robot's side: {robot.name}, {rig.config.address}")
        rig.start()
        rig.busy = stack.enter_context(busy_processes(args.load))
        rng = random.Random(args.seed)
        for row in wanted:
            times, kept = count(row, args.per_row), results.get(row.name)
            run_row(rig, row, times, rng, host, kept=kept, busy=args.load, keep=keep)
    return list(results.values())


def result_file(out: Path, busy: int) -> Path:
    """Return the file of the results on the quiet machine, or beside so many busy processes."""
    return out / (f"faults-load-{busy}.json" if busy else "faults.json")


def read_tables(folders: Sequence[Path]) -> list[Mapping[str, Any]]:
    """Read the results in these folders, each quiet before loaded. Raises OSError or ValueError."""
    found: list[Mapping[str, Any]] = []
    for folder in folders:
        loaded = sorted(folder.glob("faults-load-*.json"))
        quiet = result_file(folder, 0)
        files = [quiet, *loaded] if quiet.exists() or not loaded else loaded
        found += [json.loads(file.read_text("utf-8")) for file in files]
    return found


def keep_logs(folder: Path, out: Path) -> None:
    """Copy the processes' logs beside the result."""
    with uninterrupted():
        kept = out / "log"
        kept.mkdir(parents=True, exist_ok=True)
        for old in kept.glob("*.log"):
            old.unlink()
        for log in folder.glob("*.log"):
            (kept / log.name).write_bytes(log.read_bytes())


@command_line("faults")
def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    args = parser().parse_args(argv)
    try:
        wanted = chosen(args.rows, ROBOTS[args.robot], contract=args.contract)
        check_result_target(args.json)
        if args.per_row is not None and args.per_row < 1:
            raise ValueError(f"--per-row {args.per_row}: expected at least 1")
        if not 0 <= args.load <= MOST_BUSY:
            raise ValueError(f"--load {args.load}: expected 0 to {MOST_BUSY} busy processes")
        if args.table is not None:
            print(markdown(read_tables(args.table)))
            return EXIT_DONE
        if not args.list and (args.artifacts is None or not args.artifacts.is_dir()):
            raise ValueError(f"--artifacts {args.artifacts}: expected a directory made by edge-export")
        if not args.list:
            read_manifest(args.artifacts)
        check_result_directory(args.out)
        if args.domain is not None and not 0 <= args.domain <= MAX_DOMAIN:
            raise ValueError(f"--domain: expected 0 to {MAX_DOMAIN}, found {args.domain}")
        args.out.mkdir(parents=True, exist_ok=True)
    except (ValueError, OSError) as error:
        _print(str(error))
        return EXIT_BAD_INPUT
    if args.list:
        for row in wanted:
            print(f"{row.name}: {row.fault or '-'}, {row.judged_by.value} within {row.bound_ms:.0f} ms")
        return EXIT_DONE
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        results = run(args, wanted)
    except KeyboardInterrupt:
        _print(f"interrupted, all processes ended; the results so far are in {args.out}")
        return EXIT_INTERRUPTED
    except (StepError, FaultError, OSError, ValueError) as error:
        _print(str(error))
        return EXIT_CHECK_FAILED
    summary = result(results, machine_facts(), args.robot, args.load)
    write_result(args.json, summary)
    show(results, Console(stderr=args.json == "-", width=150))
    return EXIT_DONE if summary["pass"] else EXIT_CHECK_FAILED


def _interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
