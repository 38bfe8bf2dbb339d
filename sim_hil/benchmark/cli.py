"""`edge-bench`: run the benchmark's episodes and measure success, collisions and latency."""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from edge.artifacts.files import ArtifactError
from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    EXIT_INTERRUPTED,
    EXIT_REFUSED,
    check_result_target,
    command_line,
    stop_signals,
    write_result,
)
from edge.state.switches import Decoding, RecoverySwitch, Speculation
from firmware_bridge.core.config import ConfigError
from sim_hil.benchmark.conditions.conditions import (
    BASELINES,
    CLOCKS,
    DEFAULT_LATENCY_S,
    DRIFTS,
    MODES,
    WORDINGS,
    Conditions,
    ConditionsError,
    PolicySpec,
)
from sim_hil.benchmark.conditions.latency import LatencyError, LatencyProfile, parse_latency
from sim_hil.benchmark.conditions.rewording import reworded
from sim_hil.benchmark.policies.external_protocol import Address, ExternalError
from sim_hil.benchmark.results.report import write_report
from sim_hil.benchmark.results.store import ResultStore, StoreError, read_results
from sim_hil.benchmark.runs import RESULT, BenchRun, choose, execute
from sim_hil.benchmark.suite.episode import SuiteError, load_suite, suite_names
from sim_hil.benchmark.workers.cluster import ClusterError, ClusterJobs
from sim_hil.benchmark.workers.jobs import Backend, LocalJobs, RefusedRunError
from sim_hil.benchmark.workers.progress import BenchProgress
from sim_hil.benchmark.workers.realtime_episode import check_realtime, drivable
from sim_hil.benchmark.workers.task import VIDEO_CHOICES
from sim_hil.realtime.robots import GO2, ROBOTS
from sim_hil.scene.scene import SceneError

EXAMPLES = """examples:
  edge-bench --suite dynanav --policy expert --jobs 2 --out out/expert
  edge-bench --suite dynanav --episodes 'hospital-*' --policy artifacts:out/nano --latency 2 --out out/nano-2s
  edge-bench --suite dynanav --policy artifacts:out/nano --latency profile:flight.mcap --drift severe --json -
  edge-bench --suite dynanav --policy external:127.0.0.1:7001 --latency 1.5 --video failed --out out/theirs
  edge-bench --suite dynanav --policy expert --cluster 10.0.0.5:6379 --out out/expert
  edge-bench --suite dynanav --policy artifacts:out/nano --clock realtime --out out/here    # this machine's latency
  edge-bench --suite dynanav --policy artifacts:out/nano --clock realtime --robot carter-can --out out/can
  edge-bench compare out/nano-2s out/nano-5s      # paired differences with intervals
  edge-bench report out/nano-2s                   # write report.html again
  edge-bench validate --help                      # check a suite: goals reachable, landmarks visible

docs/benchmark.md has the command of every row of the paper's tables.
exit codes: 0 done, 1 an episode has no result, 2 bad arguments or input, 3 refused (artifacts), 130 interrupted
"""

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


def parser() -> argparse.ArgumentParser:
    """Return the argument parser of a run."""
    p = argparse.ArgumentParser(
        "edge-bench", description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--suite", required=True, metavar="NAME|FILE", help=f"one of: {', '.join(suite_names())}; or a file")
    p.add_argument("--episodes", action="append", default=[], metavar="GLOB", help="ids to run; may be repeated")
    p.add_argument(
        "--policy",
        required=True,
        metavar="P",
        help=f"artifacts:DIR, external:ADDR, point-goal-net:FILE, {', '.join(BASELINES)}",
    )
    p.add_argument(
        "--clock", choices=CLOCKS, default="lockstep",
        help="lockstep (default): virtual time, deterministic; realtime: edge-hil, edge-bridge and edge-run",
    )  # fmt: skip
    p.add_argument(
        "--robot", choices=tuple(ROBOTS), help=f"realtime: robot that drives its body's episodes (default {GO2.name})"
    )
    p.add_argument("--mode", choices=MODES, help="reasoning mode of an artifact policy (default async)")
    p.add_argument(
        "--latency", metavar="S|profile:FILE",
        help="duration of one generation (external policy: of one answer): seconds, or profile:FILE with a latency "
        "profile, an edge-run result or a flight log (default: 2 s, 0.25 s without reasoning; external: none)",
    )  # fmt: skip
    p.add_argument("--drift", choices=DRIFTS, default="none", help="odometry drift (paper, table 14; default none)")
    p.add_argument("--variant", metavar="NAME", help="model variant: DIR/NAME, checked against its manifest")
    p.add_argument("--wording", type=int, default=0, metavar="N", help="index of the instruction, from 0 (default 0)")
    p.add_argument(
        "--wordings", choices=WORDINGS, default="benchmark",
        help="sentence patterns of the instructions: the benchmark's own (default), or those used in training",
    )  # fmt: skip
    p.add_argument(
        "--swap-instructions",
        type=int,
        metavar="SEED",
        help="control experiment: give every task the instruction of another task in the same scene",
    )
    p.add_argument(
        "--decoding", choices=[each.value for each in Decoding],
        help="decoding of an artifact policy: greedy as in the paper (free), or within rules (default: the manifest's)",
    )  # fmt: skip
    p.add_argument(
        "--recovery", choices=[each.value for each in RecoverySwitch],
        help="recoveries of an artifact policy; off: only the plan moves the robot (default: the manifest's)",
    )  # fmt: skip
    p.add_argument(
        "--speculation", choices=[each.value for each in Speculation],
        help="whether a call verifies guessed tokens; the results are equal bit for bit (default: the manifest's)",
    )  # fmt: skip
    p.add_argument(
        "--stay", action=argparse.BooleanOptionalAction, default=False,
        help="halt at the stop that the reasoning text gives, as edge-run does (default: only the goal ends the run)",
    )  # fmt: skip
    p.add_argument(
        "--camera", default="auto", metavar="WxH", help="render images of this size even if the policy uses none"
    )
    p.add_argument("--external-timeout", type=float, default=60.0, metavar="S", help="for one answer, s (default 60)")
    p.add_argument(
        "--jobs", type=int, default=1, metavar="N", help="episodes run in parallel, one process each (default 1)"
    )
    p.add_argument("--cluster", metavar="ADDR", help="run the episodes on the Ray cluster at HOST:PORT")
    p.add_argument("--out", type=Path, metavar="DIR", help="directory for results, logs, videos and report.html")
    p.add_argument("--resume", action="store_true", help="continue the interrupted run in --out")
    p.add_argument("--video", choices=VIDEO_CHOICES, default="none", help="episodes to record on video (default none)")
    p.add_argument(
        "--flight-logs", choices=VIDEO_CHOICES, help="episodes of an artifact policy whose flight log is kept and "
        "explained in the report: all, failed (or collided), none (default: failed with --out; lockstep only)",
    )  # fmt: skip
    p.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    return p


@command_line("edge-bench")
def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code (see EXAMPLES)."""
    argv = sys.argv[1:] if argv is None else list(argv)
    if argv and argv[0] in ("compare", "report"):
        from sim_hil.benchmark.results import compare

        return compare.main(argv)
    if argv and argv[0] == "validate":
        from sim_hil.benchmark.suite import validate

        return int(validate.main(argv[1:]))
    args = parser().parse_args(argv)
    try:
        return _run(args)
    except ArtifactError as error:
        return _report_problem(error, EXIT_REFUSED)
    except RefusedRunError as error:
        return _report_problem(error, error.code)
    except _BAD_INPUT as error:
        return _report_problem(error, EXIT_BAD_INPUT)


def conditions_of(args: argparse.Namespace) -> Conditions:
    """Build the run's conditions from the arguments. Raises ConditionsError, LatencyError or ExternalError."""
    policy = PolicySpec.parse(args.policy)
    if policy.kind == "external":
        Address.parse(policy.where)
    mode = args.mode
    if policy.kind == "artifacts":
        mode = mode or "async"
    latency = None if args.latency is None else parse_latency(args.latency)
    if latency is None and policy.kind == "artifacts" and args.clock == "lockstep":
        latency = LatencyProfile.constant(DEFAULT_LATENCY_S[mode])
    return Conditions(
        policy=policy,
        clock=args.clock,
        mode=mode,
        latency=latency,
        drift=args.drift,
        variant=args.variant,
        wording=args.wording,
        wordings=args.wordings,
        swap_instructions=args.swap_instructions,
        decoding=args.decoding,
        recovery=args.recovery,
        speculation=args.speculation,
        stays=args.stay,
        camera=args.camera,
        external_timeout_s=args.external_timeout,
        robot=args.robot or (GO2.name if args.clock == "realtime" else None),
    )


def _run(args: argparse.Namespace) -> int:
    check_result_target(args.json)
    if args.out is None and (args.resume or args.video != "none"):
        raise ConditionsError("--resume and --video need a directory: add --out DIR")
    conditions = conditions_of(args)
    episodes = choose(load_suite(args.suite), args.episodes)
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
    run = BenchRun.plan(args.suite, episodes, conditions)
    with _output_directory(args.out) as folder, stop_signals() as stop:
        done = len(read_results(folder)) if args.resume else 0
        with BenchProgress(len(run.episodes), done) as progress:
            execution = execute(
                run, folder, _backend(args), resume=args.resume, video=args.video,
                flights=args.flight_logs or ("none" if args.out is None else "failed"), stopped=lambda: bool(stop),
                watcher=progress.watcher,
            )  # fmt: skip
        store, finished, result = execution.store, execution.finished, execution.result
        result["skipped"] = skipped
        _write_outputs(args, store, result)
    if not finished:
        advice = f"; continue with --resume --out {args.out}" if args.out is not None else ""
        counted = f"{result['summary']['episodes']} of {len(run.episodes)} episodes have a result"
        return _report_problem(f"interrupted, {counted}{advice}", EXIT_INTERRUPTED)
    if not store.results:
        return _report_problem("no episode has a result: nothing was measured", EXIT_CHECK_FAILED)
    return EXIT_CHECK_FAILED if store.failed else EXIT_DONE


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
    rows += [(key, means) for group in ("by_scene", "by_crowd", "by_robot") for key, means in summary[group].items()]
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
    sys.stderr.write(f"edge-bench: {message}\n")
    return code


if __name__ == "__main__":
    sys.exit(main())
