"""`edge-bench` without a sub-command: run episodes and write their results."""

from __future__ import annotations

import argparse
import shutil
import socket
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from edge.artifacts.files import ArtifactError
from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    EXIT_INTERRUPTED,
    EXIT_REFUSED,
    stop_signals,
    write_result,
)
from edge.live.options import LiveOptions, live_options
from firmware_bridge.core.config import ConfigError
from firmware_bridge.system.terminal import one_line
from sim_hil.benchmark.arguments import check, parser
from sim_hil.benchmark.conditions.conditions import (
    ConditionsError,
)
from sim_hil.benchmark.conditions.latency import LatencyError
from sim_hil.benchmark.conditions.rewording import reworded
from sim_hil.benchmark.policies.external_protocol import ExternalError
from sim_hil.benchmark.results.report import write_report
from sim_hil.benchmark.results.store import ResultStore, StoreError, read_results
from sim_hil.benchmark.runs import RESULT, BenchRun, execute
from sim_hil.benchmark.suite.episode import SuiteError, load_suite
from sim_hil.benchmark.suite.strata import is_fresh
from sim_hil.benchmark.workers.cluster import ClusterError, ClusterJobs
from sim_hil.benchmark.workers.jobs import Backend, LocalJobs, RefusedRunError
from sim_hil.benchmark.workers.progress import BenchProgress
from sim_hil.benchmark.workers.realtime_episode import check_realtime, drivable
from sim_hil.realtime.robots import GO2, ROBOTS
from sim_hil.scene.scene import SceneError

_BAD_INPUT = (
    ConditionsError,
    LatencyError,
    SuiteError,
    SceneError,
    StoreError,
    ExternalError,
    ClusterError,
    ConfigError,
    OSError,
)


def main(argv: Sequence[str]) -> int:
    """Run the benchmark and return its exit code (see EXAMPLES)."""
    args = parser().parse_args(argv)
    try:
        return _run(args)
    except ArtifactError as error:
        return _report_problem(error, EXIT_REFUSED)
    except RefusedRunError as error:
        return _report_problem(error, error.code)
    except _BAD_INPUT as error:
        return _report_problem(error, EXIT_BAD_INPUT)


def _run(args: argparse.Namespace) -> int:
    conditions, episodes = check(args)
    skipped: list[str] = []
    if conditions.clock == "realtime":
        check_realtime(conditions, jobs=args.jobs, cluster=args.cluster is not None, video=args.video)
        robot = ROBOTS[conditions.robot or GO2.name]
        episodes, skipped = drivable(episodes, robot)
        if skipped:
            _report_problem(f"{len(skipped)} episodes skipped: their robot is not the {robot.hil_robot}", EXIT_DONE)
        if not episodes:
            raise ConditionsError(f"--episodes: expected an episode of the {robot.hil_robot}, found none")
    episodes = list(reworded(episodes, conditions, lambda: load_suite(args.suite)))
    run = BenchRun.plan(args.suite, episodes, conditions, args.first)
    # Signals outermost: a second one must not end the process before the temporary folder is removed.
    with stop_signals() as stop, _output_directory(args.out) as folder, _live_view(args, conditions.clock) as live:
        done = len(read_results(folder)) if args.resume else 0
        with BenchProgress(run.asked, min(done, run.asked), blind=is_fresh(args.suite)) as progress:
            execution = execute(
                run, folder, _backend(args), resume=args.resume, video=args.video,
                flights=_flight_logs(args), stopped=lambda: bool(stop), live=live, watcher=progress.watcher,
            )  # fmt: skip
        store, finished, result = execution.store, execution.finished, execution.result
        result["skipped"] = skipped
        _write_outputs(args, store, result)
    if not finished:
        advice = f"; continue with --resume --out {args.out}" if args.out is not None else ""
        counted = f"{result['summary']['episodes']} of {run.asked} episodes have a result"
        return _report_problem(f"interrupted, {counted}{advice}", EXIT_INTERRUPTED)
    if not store.results:
        return _report_problem("no episode has a result: nothing was measured", EXIT_CHECK_FAILED)
    return EXIT_CHECK_FAILED if store.failed else EXIT_DONE


def _flight_logs(args: argparse.Namespace) -> str:
    if args.flight_logs is not None:
        return str(args.flight_logs)
    return "none" if args.out is None else "causes" if is_fresh(args.suite) else "failed"


def _backend(args: argparse.Namespace) -> Backend:
    if args.cluster is not None:
        return ClusterJobs(args.cluster)
    return LocalJobs(args.jobs)


@contextmanager
def _output_directory(out: Path | None) -> Iterator[Path]:
    if out is not None:
        yield out.absolute()
        return
    folder = Path(tempfile.mkdtemp(prefix="edge-bench-"))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _live_view(args: argparse.Namespace, clock: str) -> Iterator[LiveOptions | None]:
    """Print the address of all episodes' live views, and that for other computers; their runners share port and token.

    Raises ConfigError or LiveError.
    """
    live = live_options(args)
    if live is None:
        yield None
        return
    if clock != "realtime":
        raise ConfigError("--live: expected --clock realtime, whose episodes a runner drives")
    if live.port == 0:
        with socket.socket() as probe:  # every episode listens at the same port
            probe.bind((live.address, 0))
            live = replace(live, port=probe.getsockname()[1])
    with tempfile.TemporaryDirectory(prefix="edge-bench-live-") as folder:
        if live.token_file is None:
            live = replace(live, token_file=Path(folder) / "token")
        token = live.token()
        _report_problem(f"live view, while an episode drives: {live.url(live.port, token)}", EXIT_DONE)
        if (elsewhere := live.url_elsewhere(live.port, token)) is not None:
            _report_problem(f"live view for other computers: {elsewhere}", EXIT_DONE)
        yield live


def _write_outputs(args: argparse.Namespace, store: ResultStore, result: dict[str, Any]) -> None:
    write_result(args.json, result)
    if args.out is not None:
        write_result(str(store.directory / RESULT), result)
        report = write_report(store, result["summary"], f"DynaNav: {Path(args.suite).stem}, {args.policy}")
        sys.stderr.write(f"edge-bench: {report}\n")
    if result["code_changed"]:
        _report_problem("the code changed during the run: its episodes may come from two versions", EXIT_DONE)
    if args.json != "-":
        sys.stdout.write(summary_lines(result))


def summary_lines(result: dict[str, Any]) -> str:
    """Format a run's summary as a table for the terminal."""
    summary = result["summary"]
    rows = [("all", summary)]
    groups = [members for group, members in summary.items() if group.startswith("by_")]
    rows += [(key, means) for members in groups for key, means in members.items()]
    lines = [f"{'':<14}{'episodes':>9}{'SR %':>8}{'SPL %':>8}{'NE m':>8}{'CR %':>8}"]
    for name, means in rows:
        cells = "".join(
            f"{'–' if means[key] is None else format(means[key], '.2f'):>8}" for key in ("sr", "spl", "ne_m", "cr")
        )
        lines.append(f"{name:<14}{means['episodes']:>9}{cells}")
    if summary["sr_ci95"] is not None:
        (a, b), (c, d) = summary["sr_ci95"], summary["cr_ci95"]
        lines.append(f"95 % intervals: SR {a:.1f} to {b:.1f}, CR {c:.1f} to {d:.1f}")
    delay = result["latency"]["delay_s"]
    if delay["mean"] is not None:
        lines.append(f"delay: mean {delay['mean']:.2f} s, p99 {delay['p99']:.2f} s, max {delay['max']:.2f} s")
    lines.append(f"{result['simulated_s']:.0f} s simulated in {result['wall_s']:.0f} s")
    return "\n".join(lines) + "\n"


def _report_problem(message: object, code: int) -> int:
    sys.stderr.write(f"edge-bench: {one_line(message)}\n")
    return code
