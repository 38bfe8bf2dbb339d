"""Command line of `edge-bench`: runs the benchmark's episodes and measures success, collisions and latency.

This module loads no simulation, which takes seconds: bad arguments are refused at once.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final

from edge.core.cli import check_result_directory, check_result_target
from edge.live.options import add_live_arguments
from edge.state.switches import Decoding, RecoverySwitch, Speculation
from firmware_bridge.system.terminal import CommandParser
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
from sim_hil.benchmark.conditions.latency import LatencyProfile, parse_latency
from sim_hil.benchmark.policies.external_protocol import Address, ExternalError
from sim_hil.benchmark.results.store import check_new
from sim_hil.benchmark.suite.episode import Episode, load_suite, suite_names
from sim_hil.benchmark.workers.task import FLIGHT_CHOICES, VIDEO_CHOICES
from sim_hil.realtime.robots import GO2, ROBOTS

REFUSALS: Final = (ExternalError, ValueError, OSError)
"""Errors of `check`."""
MAX_JOBS: Final = 256
"""Largest number of episodes in parallel on one machine."""
SUMMARY: Final = "Run the benchmark's episodes and measure success, collisions and latency."
SUBCOMMANDS: Final = ("compare", "report", "validate")
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


def parser() -> argparse.ArgumentParser:
    """Return the argument parser of a run."""
    p = CommandParser(
        "edge-bench", description=SUMMARY, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--suite", required=True, metavar="NAME|FILE", help=f"one of: {', '.join(suite_names())}; or a file")
    p.add_argument("--episodes", action="append", default=[], metavar="GLOB", help="ids to run; may be repeated")
    p.add_argument(
        "--first", type=int, metavar="N",
        help="run N episodes, drawn without regard to their kind; always the same, and the first of a larger N",
    )  # fmt: skip
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
        "--turn-starts", type=int, metavar="SEED",
        help="begin with random headings; the instruction says how to turn where the route is not ahead",
    )  # fmt: skip
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
        "--flight-logs", choices=FLIGHT_CHOICES, help="episodes of an artifact policy whose flight log is kept and "
        "explained in the report: all, failed (or collided), none; causes keeps the causes of failures alone (default: "
        "failed with --out, causes for dynanav-fresh)",
    )  # fmt: skip
    add_live_arguments(p)
    p.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    return p


def check(args: argparse.Namespace) -> tuple[Conditions, list[Episode]]:
    """Check everything but the policy's files; return conditions and chosen episodes.

    Raises ConditionsError, LatencyError, SuiteError, StoreError, ExternalError or OSError.
    """
    check_result_target(args.json)
    if args.out is None and (args.resume or args.video != "none"):
        raise ConditionsError("--resume and --video need a directory: add --out DIR")
    check_result_directory(args.out)
    if args.out is not None and not args.resume:
        check_new(args.out)
    if args.first is not None and args.first < 1:
        raise ConditionsError(f"--first: expected a number of episodes from 1, found {args.first}")
    if not 1 <= args.jobs <= MAX_JOBS:
        raise ConditionsError(f"--jobs: expected 1 to {MAX_JOBS}, found {args.jobs}")
    if args.cluster is not None:
        host_and_port(args.cluster)
    return conditions_of(args), choose(load_suite(args.suite), args.episodes)


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
        turn_starts=args.turn_starts,
        decoding=args.decoding,
        recovery=args.recovery,
        speculation=args.speculation,
        stays=args.stay,
        camera=args.camera,
        external_timeout_s=args.external_timeout,
        robot=args.robot or (GO2.name if args.clock == "realtime" else None),
    )


def choose(episodes: Sequence[Episode], patterns: Sequence[str]) -> list[Episode]:
    """Return the episodes whose id matches a pattern, all without patterns. Raises ConditionsError if none matches."""
    for pattern in patterns:
        if not any(fnmatchcase(episode.id, pattern) for episode in episodes):
            some = ", ".join(episode.id for episode in episodes[:3])
            raise ConditionsError(
                f"--episodes {pattern!r}: expected a pattern of ids such as {some}, ...; none matches"
            )
    wanted = patterns or ("*",)
    return [episode for episode in episodes if any(fnmatchcase(episode.id, pattern) for pattern in wanted)]


def host_and_port(cluster: str) -> tuple[str, int]:
    """Parse HOST:PORT of `--cluster`. Raises ConditionsError."""
    host, _, port = cluster.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not all(33 <= ord(each) < 127 for each in host) or re.fullmatch("[0-9]{1,5}", port) is None:
        raise ConditionsError(f"--cluster {cluster!r}: expected HOST:PORT of a Ray cluster, such as 10.0.0.5:6379")
    if not 1 <= int(port) <= 65_535:
        raise ConditionsError(f"--cluster {cluster}: expected a port from 1 to 65535")
    return host, int(port)
