"""`edge-replay`: runs the policy again on a flight log and compares the outputs with the recorded ones."""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    EXIT_REFUSED,
    check_result_target,
    command_line,
    messages,
    write_result,
)
from edge.core.stats import percentiles
from edge.flightlog.reader import Damage, RecordingError, damage_notice, parts
from edge.flightlog.replay.policy import Comparison, Replayer
from edge.flightlog.replay.records import NO_TICK, RecordedRun, RecordedTick, read_events, read_run
from edge.inference import engines
from edge.inference.warm_up import open_proven
from firmware_bridge.system.terminal import CommandParser

EXAMPLES = """examples:
  edge-replay flight.mcap --artifacts out/nano
  edge-replay flight.mcap --artifacts out/nano --from 30 --to 45 --json -
  edge-replay flight.mcap --artifacts out/new --force     # how far another policy would have driven apart

sub-commands, each with --help:
  edge-replay explain flight.mcap                 # why the robot stopped, collided, went astray or ran out of time
  edge-replay video flight.mcap --out flight.mp4  # picture with plan and waypoints drawn in it

On the machine and with the artifacts of the run, plans and texts are equal bit for bit. A log of a run that was killed
is replayed as far as it is whole; further parts (flight.002.mcap ...) are read with the first.
exit codes: 0 within the tolerance, 1 beyond it or less than 90 % of the plans could be made again, 2 bad arguments or
input, 3 refused (artifacts), 130 interrupted
"""

LEAST_SHARE = 0.9
"""Required share of replayed ticks with a plan: the agreement of a few proves nothing about the run."""
_PROGRESS_PERIOD_NS = 2_000_000_000


class OptionError(ValueError):
    """An argument that makes no sense; one line."""


@dataclass(frozen=True)
class Tolerance:
    """Largest differences between recorded and replayed outputs."""

    trajectory_cm: float
    heading_deg: float
    command: float
    """m/s and rad/s."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value >= 0):
                option = f"--tolerance-{name.rpartition('_')[2]}"
                raise OptionError(f"{option}: expected a finite number, 0 or more, found {value}")


def parser() -> argparse.ArgumentParser:
    """Command line of `edge-replay`."""
    p = CommandParser(
        "edge-replay", description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("file", type=Path, metavar="FILE.mcap", help="flight log of edge-run --record")
    p.add_argument("--artifacts", type=Path, required=True, metavar="DIR", help="the artifacts of that run")
    p.add_argument("--engines", type=Path, metavar="DIR", help="engines of edge-install (default: ARTIFACTS.engines)")
    p.add_argument("--from", dest="from_s", type=float, default=0.0, metavar="S", help="s after the first tick")
    p.add_argument("--to", dest="to_s", type=float, default=math.inf, metavar="S", help="s after the first tick")
    p.add_argument("--tolerance-cm", type=float, default=0.1, metavar="CM", help="of a plan's points (default: 0.1)")
    p.add_argument(
        "--tolerance-deg", type=float, default=0.1, metavar="DEG", help="of a plan's headings (default: 0.1)"
    )
    p.add_argument(
        "--tolerance-command", type=float, default=0.005, metavar="V", help="of commands, m/s, rad/s (default: 0.005)"
    )
    p.add_argument("--force", action="store_true", help="also with other artifacts than those of the run")
    p.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    return p


_LONGEST_S = 1e9  # beyond every log
_print = messages("edge-replay")


def replay(
    path: Path, artifacts: Artifacts, run: RecordedRun, from_s: float, to_s: float
) -> tuple[Comparison, int, str | None]:
    """Replay a log; return the comparison, the log's tick count and one line about its damage, None for a whole log.

    Raises RecordingError, ArtifactError, OSError.
    """
    opened = open_proven(artifacts)
    first_ns = next((event.now_ns for event in read_events(path) if isinstance(event, RecordedTick)), None)
    if first_ns is None:
        raise RecordingError(f"{path}: {NO_TICK}")
    to_ns = first_ns + round(min(to_s, _LONGEST_S) * 1e9)
    replayer = Replayer(
        artifacts,
        opened.policy,
        opened.language,
        run,
        from_ns=first_ns + round(min(from_s, _LONGEST_S) * 1e9),
        to_ns=to_ns,
    )
    damages: list[Damage] = []
    ticks, printed_ns = 0, time.monotonic_ns()
    for event in read_events(path, damages):
        replayer.step(event)
        if isinstance(event, RecordedTick):
            ticks += 1
            if event.now_ns > to_ns:
                break
            if time.monotonic_ns() - printed_ns >= _PROGRESS_PERIOD_NS:
                printed_ns = time.monotonic_ns()
                found = replayer.comparison
                at_s = (event.now_ns - first_ns) / 1e9
                _print(f"at {at_s:.0f} s of the log: {found.ticks} ticks and {found.generations} generations run again")
    return replayer.comparison, ticks, damage_notice(damages, first_ns) if damages else None


def verdict(found: Comparison, tolerance: Tolerance) -> tuple[str, ...]:
    """Return one line per difference beyond the tolerance; empty: the outputs agree."""
    lines: list[str] = []
    for name, unit, values, allowed in (
        ("plan", "cm", found.trajectory_cm, tolerance.trajectory_cm),
        ("heading", "deg", found.heading_deg, tolerance.heading_deg),
        ("command", "m/s or rad/s", found.command, tolerance.command),
    ):
        worst = max(values, default=0.0)
        if worst > allowed:
            lines.append(f"{name} up to {worst:.4g} {unit} apart, {allowed:g} allowed")
    if found.different_texts:
        some = ", ".join(map(str, found.different_texts[:5]))
        lines.append(f"{len(found.different_texts)} of {found.generations} texts differ (generation {some})")
    reason = f": {found.skipped.most_common(1)[0][0]}" if found.skipped else ""
    if found.ticks == 0:
        lines.append(f"no tick in this part of the log could be run again{reason}")
    elif found.ticks < LEAST_SHARE * found.driven:
        lines.append(
            f"only {found.ticks} of {found.driven} ticks with a plan could be run again{reason}; expected "
            f"{LEAST_SHARE:.0%}; name a part of the log that is whole with --from and --to"
        )
    return tuple(lines)


def as_result(found: Comparison, ticks: int, beyond: Sequence[str]) -> dict[str, Any]:
    """Return the comparison for --json; deviations are None where nothing was compared."""

    def spread(values: list[float]) -> dict[str, float | None]:
        finite = [value if math.isfinite(value) else 1e9 for value in values]  # JSON has no infinity
        return percentiles(finite, "p50", "p99", "max")

    return {
        "ticks": {
            "recorded": ticks,
            "driven": found.driven,
            "compared": found.ticks,
            "equal": found.ticks_equal,
            "worst": found.worst_tick,
        },
        "generations": {
            "compared": found.generations,
            "texts_equal": found.texts_equal,
            "different": found.different_texts[:100],
            "poses_interpolated": found.poses_interpolated,
            "ways_from_frames": found.ways_from_frames,
        },
        "commands": {"compared": len(found.command)},
        "trajectory_cm": spread(found.trajectory_cm),
        "heading_deg": spread(found.heading_deg),
        "command": spread(found.command),
        "skipped": dict(found.skipped),
        "beyond": list(beyond),
        "tagged": "measured",
    }


def table(result: dict[str, Any]) -> str:
    """Format the result as text."""
    ticks, generations = result["ticks"], result["generations"]
    lines = [
        f"ticks        {ticks['compared']} of {ticks['recorded']} run again, {ticks['equal']} equal bit for bit",
        f"generations  {generations['compared']} run again, {generations['texts_equal']} texts equal",
        f"{'':13}{'median':>12}{'p99':>12}{'max':>12}",
    ]
    for name, key, unit in (
        ("plan", "trajectory_cm", "cm"),
        ("heading", "heading_deg", "deg"),
        ("command", "command", "m/s, rad/s"),
    ):
        values = [result[key][point] for point in ("p50", "p99", "max")]
        if values[0] is None:
            lines.append(f"{name:13}{'not compared':>12}")
        else:
            lines.append(f"{name:13}" + "".join(f"{value:12.4g}" for value in values) + f"  {unit}")
    lines += [f"skipped      {count} x {reason}" for reason, count in result["skipped"].items()]
    if generations["poses_interpolated"]:
        lines.append(f"note         {generations['poses_interpolated']} prompts with past motion from the ticks' poses")
    if generations["ways_from_frames"]:
        lines.append(f"note         {generations['ways_from_frames']} prompts with the path through their frames alone")
    lines += [f"beyond       {line}" for line in result["beyond"]]
    return "\n".join(lines) + "\n"


def _open(args: argparse.Namespace, run: RecordedRun) -> tuple[Artifacts, bool]:
    """Return the artifacts and whether they are the run's; raises ArtifactError for others without --force."""
    artifacts = load_artifacts(args.artifacts.absolute())
    same = artifacts.manifest_sha256 == run.manifest_sha256
    if not same:
        other = (
            f"{args.artifacts}: not the same artifacts as in the run: manifest {artifacts.manifest_sha256[:12]}…, "
            f"recorded {run.manifest_sha256[:12]}…"
        )
        if not args.force:
            raise ArtifactError(f"{other}; name those of the run, or compare all the same with --force")
        _print(other)
    if engines.needed(artifacts):
        folder = args.engines or engines.default_directory(artifacts.directory)
        engines.check(artifacts, folder)
        artifacts = engines.with_engines(artifacts, folder)
    return artifacts, same


@command_line(
    "edge-replay",
    {
        ArtifactError: EXIT_REFUSED,
        engines.EngineError: EXIT_REFUSED,
        RecordingError: EXIT_BAD_INPUT,
        OptionError: EXIT_BAD_INPUT,
        OSError: EXIT_BAD_INPUT,
    },
)
def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    cv2.setNumThreads(1)
    started_ns = time.monotonic_ns()
    check_result_target(args.json)
    tolerance = Tolerance(args.tolerance_cm, args.tolerance_deg, args.tolerance_command)
    if not (0 <= args.from_s < args.to_s):
        raise OptionError(f"--from {args.from_s:g} --to {args.to_s:g}: expected 0 or more, and --to after --from")
    run = read_run(args.file)
    artifacts, same = _open(args, run)
    found, ticks, damage = replay(args.file, artifacts, run, args.from_s, args.to_s)
    if damage is not None:
        _print(damage)
    beyond = verdict(found, tolerance)
    result = {
        "file": str(args.file),
        "parts": len(parts(args.file)),
        "artifacts": str(args.artifacts),
        "same_artifacts": same,
        "mode": run.mode,
        "damage": damage,
        "tolerance": vars(tolerance),
        **as_result(found, ticks, beyond),
        "wall_s": round((time.monotonic_ns() - started_ns) / 1e9, 3),
    }
    write_result(args.json, result)
    if args.json != "-":
        sys.stdout.write(table(result))
    return EXIT_CHECK_FAILED if beyond else EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
