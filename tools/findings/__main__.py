"""Test the paper's findings on our models: paired runs of the benchmark, differences, intervals, one page."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from edge.artifacts.files import ArtifactError
from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    EXIT_INTERRUPTED,
    EXIT_REFUSED,
    check_result_target,
    command_line,
    messages,
    stop_signals,
    write_result,
)
from firmware_bridge.system.terminal import CommandParser
from reporting.progress import duration
from sim_hil.benchmark.arguments import MAX_JOBS, choose
from sim_hil.benchmark.conditions.conditions import Conditions, ConditionsError
from sim_hil.benchmark.conditions.latency import LatencyError, LatencyProfile, parse_latency
from sim_hil.benchmark.language.instructions import is_held_out
from sim_hil.benchmark.results.record import EpisodeResult, ResultError
from sim_hil.benchmark.results.store import StoreError, read_results
from sim_hil.benchmark.runs import RESULT, RunsError, read_result, run_episodes
from sim_hil.benchmark.suite.episode import Episode, SuiteError, load_suite
from sim_hil.benchmark.suite.strata import is_fresh
from sim_hil.benchmark.workers.jobs import RefusedRunError
from sim_hil.benchmark.workers.progress import BenchProgress
from sim_hil.scene.scene import SceneError
from tools.findings.report import write_findings
from tools.findings.rows import ROWS, RUNS, WORDINGS_ROW, Finding, Level, claims_of, runs_of
from tools.findings.verdict import judge_all

COMMAND: Final = "findings"
EXAMPLES: Final = """examples:
  python -m tools.findings --artifacts out/models --out out/findings --jobs 2
  python -m tools.findings --artifacts out/models --out out/findings --rows async,words --episodes 'office-*'
  python -m tools.findings --artifacts out/nano --out out/findings --rows score,words,wordings   # one model alone
  python -m tools.findings --artifacts out/models --out out/findings --latency profile:orin.latency.json --dry-run

--artifacts has one folder per model, written by edge-export: rl (shipped), no-rl (before PPO), and of `edge-train
imitate --from`: full, no-latency, no-motion-offset, waypoints, no-reasoning. The report lists rows whose models are
missing or equal. --suite also reads the file of `edge-train evaluate` (RUN/evaluate/training.toml). Run the command
again to continue an interrupted run.
exit codes: 0 done (even if no finding holds), 1 an episode has no result, 2 bad arguments or input,
            3 refused (artifacts), 130 interrupted
"""
_print = messages(COMMAND)
_BAD_INPUT = (ConditionsError, LatencyError, SuiteError, SceneError, StoreError, ResultError, OSError)


@dataclass(frozen=True)
class Plan:
    """Possible runs by name with their folders (equal conditions run once), and reasons for impossible ones.

    `claims`: claims that these runs test.
    """

    conditions: Mapping[str, Conditions]
    folders: Mapping[str, str]
    missing: Mapping[str, str]
    claims: Sequence[Finding | Level]


def parser() -> argparse.ArgumentParser:
    """Return the argument parser."""
    p = CommandParser(
        "python -m tools.findings", description=__doc__, epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    p.add_argument("--artifacts", type=Path, required=True, metavar="ROOT", help="folder of the exported models")
    p.add_argument("--out", type=Path, required=True, metavar="DIR", help="runs, findings.md, findings.json, pictures")
    p.add_argument("--rows", metavar="ROW,…", help=f"of: {', '.join(ROWS)} (default: all)")
    p.add_argument("--suite", default="dynanav", metavar="NAME|FILE", help="(default: dynanav)")
    p.add_argument("--episodes", action="append", default=[], metavar="GLOB", help="ids to run; may be repeated")
    p.add_argument("--latency", default="2", metavar="S|profile:FILE", help="latency of reasoning (default: 2)")
    p.add_argument("--jobs", type=int, default=1, metavar="N", help="episodes at a time (default: 1)")
    p.add_argument("--dry-run", action="store_true", help="list the runs and exit")
    p.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    return p


@command_line(COMMAND, {ArtifactError: EXIT_REFUSED, **dict.fromkeys(_BAD_INPUT, EXIT_BAD_INPUT)})
def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    args = parser().parse_args(argv)
    try:
        return _main(args)
    except RefusedRunError as error:
        _print(str(error))
        return error.code
    except KeyboardInterrupt:
        _print(f"interrupted; run the command again to continue; results so far: {args.out}/findings.md")
        return EXIT_INTERRUPTED


def _main(args: argparse.Namespace) -> int:
    check_result_target(args.json)
    if not args.artifacts.is_dir():
        raise ConditionsError(f"--artifacts {args.artifacts}: expected a folder of exported models")
    if not 1 <= args.jobs <= MAX_JOBS:
        raise ConditionsError(f"--jobs: expected 1 to {MAX_JOBS}, found {args.jobs}")
    base = parse_latency(args.latency)
    rows = rows_of(args.rows)
    episodes = choose(load_suite(args.suite), args.episodes)
    held_out = any(is_held_out(text) for episode in episodes for text in episode.instructions)
    plan = plan_of(args.artifacts, rows, base, held_out=held_out)
    if args.rows is not None and not plan.conditions:
        raise ConditionsError(next(iter(plan.missing.values()), "--rows: nothing to run"))
    if args.dry_run:
        for line in plan_lines(plan, len(episodes)):
            _print(line)
        return EXIT_DONE
    args.out.mkdir(parents=True, exist_ok=True)
    broken: list[RunsError | StoreError] = []
    unfit: dict[str, str] = {}
    try:
        with stop_signals() as stop:
            for name in dict.fromkeys(plan.folders.values()):
                try:
                    _run(args, name, plan.conditions[name], episodes, stop)
                except (RunsError, StoreError) as error:  # continue: the other runs, and its results, are still useful
                    broken.append(error)
                    _print(str(error))
                except ConditionsError as error:  # impossible with this suite or this model
                    unfit[name] = str(error)
                    _print(f"{name}: {error}")
    except KeyboardInterrupt:
        _report(args, plan, base, len(episodes), unfit)
        raise
    result = _report(args, plan, base, len(episodes), unfit)
    write_result(args.json, result)
    if args.json != "-":
        for each in result["findings"]:
            sys.stdout.write(
                f"{each['verdict']:<14} {each['claim']}: {each['value']:+.1f} {each['ci95'] or ''} n {each['n']}\n"
            )
    _print(f"{args.out / 'findings.md'}")
    if not result["findings"]:
        _print("no claim could be judged: no run has a result")
    return EXIT_CHECK_FAILED if broken or not result["findings"] else EXIT_DONE


def rows_of(text: str | None) -> list[str]:
    """Return the rows of `--rows`. Raises ConditionsError for an unknown one."""
    if text is None:
        return list(ROWS)
    rows = [part.strip() for part in text.split(",") if part.strip()]
    if unknown := [row for row in rows if row not in ROWS]:
        raise ConditionsError(f"--rows {unknown[0]}: expected of {', '.join(ROWS)}")
    return rows


def plan_of(root: Path, rows: Sequence[str], base: LatencyProfile, *, held_out: bool = True) -> Plan:
    """Plan the possible runs of some rows; `held_out`: the suite has wordings that training lacks."""
    conditions: dict[str, Conditions] = {}
    folders: dict[str, str] = {}
    claims, left_out = claims_of(root)
    if not held_out:
        left_out[f"row {WORDINGS_ROW}"] = "the episodes' wordings have training's patterns; test it on dynanav"
        claims = [claim for claim in claims if claim.row != WORDINGS_ROW]
    missing = {row: why for row, why in left_out.items() if row.removeprefix("row ") in rows}
    by_conditions: dict[str, str] = {}
    for name in runs_of(rows, claims):
        try:
            asked = RUNS[name].conditions(root, base)
        except ConditionsError as error:
            missing[name] = str(error)
            continue
        conditions[name] = asked
        folders[name] = by_conditions.setdefault(json.dumps(asked.as_json(), sort_keys=True), name)
    return Plan(conditions, folders, missing, claims)


def plan_lines(plan: Plan, episodes: int) -> list[str]:
    """Format the plan."""
    lines = [f"{len(set(plan.folders.values()))} runs of {episodes} episodes"]
    for name, asked in plan.conditions.items():
        same = plan.folders[name]
        lines.append(f"  {name}: {asked.describe() if same == name else f'the same as {same}'}")
    return lines + [f"  not run: {name}: {why}" for name, why in plan.missing.items()]


def _run(
    args: argparse.Namespace, name: str, conditions: Conditions, episodes: Sequence[Episode], stop: Sequence[int]
) -> None:  # fmt: skip
    folder = args.out / "runs" / name
    done = len(read_results(folder)) if folder.is_dir() else 0
    _print(f"{name}: {conditions.describe()}; {done} of {len(episodes)} episodes are done")
    started_ns = time.monotonic_ns()
    with BenchProgress(len(episodes), done, blind=is_fresh(args.suite)) as progress:
        run_episodes(
            args.suite,
            episodes,
            conditions,
            folder,
            jobs=args.jobs,
            stopped=lambda: bool(stop),
            watcher=progress.watcher,
        )
    _print(f"{name}: done in {duration((time.monotonic_ns() - started_ns) / 1e9)}")


def _report(
    args: argparse.Namespace, plan: Plan, base: LatencyProfile, asked: int, unfit: Mapping[str, str]
) -> dict[str, Any]:
    """Write the report of all complete runs."""
    results: dict[str, list[EpisodeResult]] = {}
    missing, trained = dict(plan.missing), True
    for name, folder in plan.folders.items():
        path = args.out / "runs" / folder
        found = read_results(path) if path.is_dir() else []
        result = read_result(path) if (path / RESULT).is_file() else {"summary": {"finished": False}}
        if not found or not result["summary"]["finished"]:
            missing[name] = unfit.get(folder, f"{len(found)} of {asked} episodes so far")
            continue
        results[name] = found
        trained = trained and bool(result["trained"])
    about = {
        "suite": args.suite,
        "asked": asked,
        "latency": base.name,
        "latency_source": base.source,
        "latency_tagged": base.tagged,
        "trained": trained,
    }
    described = {name: plan.conditions[name].describe() for name in results}
    return write_findings(args.out, about, judge_all(results, plan.claims), results, described, missing)


if __name__ == "__main__":
    sys.exit(main())
