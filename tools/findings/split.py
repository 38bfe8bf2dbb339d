"""Split the loss: replace one link of the chain by the truth at a time, and measure what that is worth.

The episodes are of training's kind (layouts and sentence patterns that no stage has used), so that they may be looked
at; `dynanav-fresh` stays unread.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import load_artifacts
from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    EXIT_INTERRUPTED,
    EXIT_REFUSED,
    check_result_directory,
    check_result_target,
    command_line,
    messages,
    stop_signals,
    write_result,
    write_whole,
)
from firmware_bridge.system.input_file import read_json
from firmware_bridge.system.terminal import CommandParser
from sim_hil.benchmark.arguments import MAX_JOBS
from sim_hil.benchmark.conditions.conditions import ConditionsError
from sim_hil.benchmark.results.bootstrap import paired_ci95
from sim_hil.benchmark.results.record import EpisodeResult, ResultError
from sim_hil.benchmark.results.store import StoreError
from sim_hil.benchmark.results.summary import BOUNDS, METRICS, interval_of
from sim_hil.benchmark.suite.strata import kind_of
from sim_hil.benchmark.workers.worker_pool import WorkerJob, Workers
from tools.findings.split_policies import VARIANTS
from tools.findings.split_worker import KINDS, MODULE, SCENARIO_SEED, SplitJob, code, result_path

COMMAND: Final = "split"
EXAMPLES: Final = """examples:
  python -m tools.findings.split --artifacts out/nano --out out/split --jobs 2
  python -m tools.findings.split --artifacts out/nano --out out/split --episodes 150      # continues the run
  python -m tools.findings.split --artifacts out/nano --out out/split --variants ours,expert-text
  python -m tools.findings.split --out out/split --report                                 # table so far, no run

Results are in OUT/VARIANT/NUMBER.json, the table in OUT/split.md and OUT/split.json. Run the command again to continue
an interrupted run; it is refused if artifacts, latency or code have changed.
exit codes: 0 done, 1 an episode has no result, 2 bad arguments or input, 3 refused (artifacts), 130 interrupted
"""
BASE: Final = "ours"
SHOWN: Final = ("sr", "cr", "spl")
ABOUT: Final = "about.json"
_REACHED: Final = {True: "reached", False: "missed"}
_print = messages(COMMAND)


def parser() -> argparse.ArgumentParser:
    """Return the argument parser."""
    p = CommandParser(
        "python -m tools.findings.split", description=__doc__, epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    p.add_argument("--artifacts", type=Path, metavar="DIR", help="exported model; not needed with --report")
    p.add_argument("--out", type=Path, required=True, metavar="DIR", help="results and table")
    p.add_argument("--episodes", type=int, default=100, metavar="N", help="number of episodes (default: 100)")
    p.add_argument("--variants", metavar="NAME,…", help=f"of: {', '.join(VARIANTS)} (default: all)")
    p.add_argument("--latency", type=float, default=1.333, metavar="S", help="time of a generation, s (default: 1.333)")
    p.add_argument("--jobs", type=int, default=1, metavar="N", help="episodes at a time (default: 1)")
    p.add_argument("--report", action="store_true", help="write the table of the results so far and exit")
    p.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    return p


@command_line(
    COMMAND, {ArtifactError: EXIT_REFUSED, **dict.fromkeys((ConditionsError, StoreError, OSError), EXIT_BAD_INPUT)}
)
def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    args = parser().parse_args(argv)
    check_result_target(args.json)
    check_result_directory(args.out)
    variants = variants_of(args.variants)
    if not 1 <= args.jobs <= MAX_JOBS or not 1 <= args.episodes <= 10_000 or not 0 < args.latency <= 60:
        raise ConditionsError(
            f"expected 1 to {MAX_JOBS} jobs, 1 to 10000 episodes and a latency up to 60 s, found {args.jobs}, "
            f"{args.episodes} and {args.latency:g}"
        )
    failed: list[str] = []
    interrupted = False
    if args.report and not args.out.is_dir():
        raise StoreError(f"--out {args.out}: expected the directory of a run, found none: --report drives nothing")
    if not args.report:
        if args.artifacts is None:
            raise ConditionsError("--artifacts: expected the directory of an exported model, found none")
        manifest_sha256 = load_artifacts(args.artifacts).manifest_sha256
        check_same_run(args.out, manifest_sha256, args.latency)
        try:
            failed = _run(args, variants, manifest_sha256)
        except KeyboardInterrupt:
            interrupted = True
    content = table(args.out)
    write_whole(args.out / "split.json", json.dumps(content, indent=1) + "\n")
    write_whole(args.out / "split.md", markdown(content))
    write_result(args.json, content)
    if args.json != "-":
        sys.stdout.write(markdown(content))
    if interrupted:
        _print("interrupted; run the command again to continue")
        return EXIT_INTERRUPTED
    return EXIT_CHECK_FAILED if failed or not content["variants"] else EXIT_DONE


def variants_of(text: str | None) -> list[str]:
    """Return the names of `--variants`. Raises ConditionsError for an unknown one."""
    if text is None:
        return list(VARIANTS)
    names = [part.strip() for part in text.split(",") if part.strip()]
    if not names or (unknown := [name for name in names if name not in VARIANTS]):
        raise ConditionsError(f"--variants {(unknown or [text])[0]!r}: expected of {', '.join(VARIANTS)}")
    return names


def check_same_run(out: Path, manifest_sha256: str, latency_s: float) -> None:
    """Write the run's conditions, or raise StoreError if `out` has a run with others."""
    about = {
        "manifest_sha256": manifest_sha256, "latency_s": latency_s, "scenario_seed": SCENARIO_SEED,
        "kinds": dict(KINDS), "code": code(),
    }  # fmt: skip
    path = out / ABOUT
    if path.is_file():
        found = read_json(path)
        if found != about:
            key = next(name for name in about if found.get(name) != about[name])
            raise StoreError(
                f"{out}: expected {key} {about[key]} as in this command, found {found.get(key)}; name another directory"
            )
        return
    out.mkdir(parents=True, exist_ok=True)
    write_whole(path, json.dumps(about, indent=1) + "\n")


def _run(args: argparse.Namespace, variants: Sequence[str], manifest_sha256: str) -> list[str]:
    """Drive what is missing; return the keys of jobs that failed. Raises KeyboardInterrupt when asked to stop."""
    waiting: deque[WorkerJob] = deque()
    folder, artifacts, version = str(args.out.absolute()), str(args.artifacts.absolute()), code()
    for number in range(args.episodes):
        missing = tuple(name for name in variants if not result_path(args.out, name, number).is_file())
        if missing:
            job = SplitJob(folder, artifacts, args.latency, number, missing, manifest_sha256, version)
            waiting.append(WorkerJob(f"{number:04d}", vars(job), args.out / f"{number:04d}.log"))
    failed: list[str] = []
    with stop_signals() as stop, Workers((sys.executable, "-m", MODULE), args.jobs) as workers:
        for events in workers.run(waiting, lambda: bool(stop)):
            for event in events:
                if event.message is not None and "done" in event.message:
                    _print(f"{event.key} {event.message['done']}: {_REACHED[bool(event.message['success'])]}")
                elif event.message is not None:
                    failed.append(event.key)
                    _print(f"{event.key} {event.message['failed']}: {event.message['why']}")
                elif event.failure:
                    failed.append(event.key)
                    _print(f"{event.key}: {event.failure}")
    return failed


def read_variant(out: Path, variant: str) -> dict[str, EpisodeResult]:
    """Return the results of one variant by number. Raises StoreError for a damaged file."""
    found = {}
    for path in sorted((out / variant).glob("[0-9]*.json")):
        try:
            found[path.stem] = EpisodeResult.of_json(read_json(path))
        except (ValueError, ResultError) as error:
            raise StoreError(f"{path}: {error}; delete it and run the command again") from error
    return found


def table(out: Path) -> dict[str, Any]:
    """Return every variant's rates and their paired differences to `ours` with 95 % intervals, and rates by building.

    Raises StoreError for results of one number that are of different tasks.
    """
    base = read_variant(out, BASE)
    variants: dict[str, Any] = {}
    for name, variant in VARIANTS.items():
        results = read_variant(out, name)
        if not results:
            continue
        if other := [number for number in set(results) & set(base) if results[number].task != base[number].task]:
            raise StoreError(f"{out}: {name}/{other[0]}.json is of another task than {BASE}'s; delete one of them")
        row: dict[str, Any] = {"description": variant.description, "episodes": len(results)}
        row["delay_s"] = _mean([each.delay_s["mean"] for each in results.values() if each.delay_s is not None])
        common = sorted(set(results) & set(base))
        for key in SHOWN:
            value_of = METRICS[key]
            row[key] = _mean([value_of(each) for each in results.values()])
            row[f"{key}_ci95"] = interval_of(list(results.values()), key)
            before, after = ([value_of(side[number]) for number in common] for side in (base, results))
            tasks = [base[number].task for number in common]
            row[f"{key}_gain"] = _mean([b - a for a, b in zip(before, after, strict=True)])
            row[f"{key}_gain_ci95"] = paired_ci95(before, after, tasks, BOUNDS[key])
        row["pairs"] = len(common)
        row["sr_by_kind"] = {
            kind: _mean([METRICS["sr"](each) for each in results.values() if kind_of(each.scene) == kind])
            for kind in KINDS
        }
        variants[name] = row
    return {"base": BASE, "variants": variants, "tagged": "measured"}


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def markdown(content: Mapping[str, Any]) -> str:
    """Return the table as a page of Markdown."""
    lines = [
        f"| variant | what is replaced | n | SR % | CR % | SPL % | SR less that of ours | CR less | SPL less |"
        f" {' | '.join(f'SR {kind}' for kind in KINDS)} |",
        f"|---|---|{'---:|' * (7 + len(KINDS))}",
    ]
    for name, row in content["variants"].items():
        rates = [_cell(row[key], row[f"{key}_ci95"], "") for key in SHOWN]
        gains = ["" if name == BASE else _cell(row[f"{key}_gain"], row[f"{key}_gain_ci95"], "+") for key in SHOWN]
        kinds = [_cell(row["sr_by_kind"][kind], None, "") for kind in KINDS]
        lines.append(
            f"| `{name}` | {row['description']} | {row['episodes']} | {' | '.join([*rates, *gains, *kinds])} |"
        )
    return "\n".join(lines) + "\n"


def _cell(value: float | None, interval: Sequence[float] | None, sign: str) -> str:
    if value is None:
        return "–"
    span = "" if interval is None else f" ({interval[0]:{sign}.1f} to {interval[1]:{sign}.1f})"
    return f"{value:{sign}.1f}{span}"


if __name__ == "__main__":
    sys.exit(main())
