"""`edge-bench compare A B` and `edge-bench report DIR`: evaluate finished runs."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from edge.core.cli import EXIT_BAD_INPUT, EXIT_DONE, check_result_target, command_line, write_result
from firmware_bridge.system.terminal import CommandParser, one_line
from sim_hil.benchmark.conditions.conditions import Conditions, ConditionsError
from sim_hil.benchmark.results.record import ResultError
from sim_hil.benchmark.results.store import (
    CONFIG,
    ResultStore,
    StoreError,
    read_config,
    read_failed,
    read_results,
)
from sim_hil.benchmark.results.summary import compare, summarise
from sim_hil.benchmark.suite.strata import is_fresh

EXAMPLES = """examples:
  edge-bench compare out/async out/sync
  edge-bench compare out/nano-2s out/nano-5s --json difference.json
  edge-bench report out/nano-2s

A difference is B minus A over the episodes that both runs contain; its interval is a paired bootstrap
over tasks and their episodes.
exit codes: 0 done, 2 bad arguments or input
"""
_UNITS = {"sr": "SR, points", "spl": "SPL, points", "ne_m": "NE, m", "cr": "CR, points"}
_CONFIG_KEYS = {"suite": str, "suite_sha256": str, "episodes": list, "conditions": dict, "versions": dict}


@command_line("edge-bench")
def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code; `argv` includes the sub-command's name."""
    parser = CommandParser(
        "edge-bench", description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    jobs = parser.add_subparsers(dest="job", required=True)
    comparing = jobs.add_parser("compare", epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter)
    comparing.add_argument("before", type=Path, metavar="A", help="directory of a run")
    comparing.add_argument("after", type=Path, metavar="B", help="directory of another run of the same suite")
    comparing.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    reporting = jobs.add_parser("report", epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter)
    reporting.add_argument("directory", type=Path, metavar="DIR", help="directory of a run")
    args = parser.parse_args(argv)
    try:
        if args.job == "report":
            return _report(args.directory)
        check_result_target(args.json)
        result = compared(args.before, args.after)
        write_result(args.json, result)
        if args.json != "-":
            sys.stdout.write(_lines(result))
        return EXIT_DONE
    except (StoreError, ConditionsError, ResultError, OSError) as error:
        sys.stderr.write(f"edge-bench {args.job}: {one_line(error)}\n")
        return EXIT_BAD_INPUT


def compared(before: Path, after: Path) -> dict[str, Any]:
    """Return both runs' conditions and their paired differences.

    Raises StoreError or ResultError if the runs cannot be compared.
    """
    configs = [_finished_config(directory) for directory in (before, after)]
    if configs[0]["suite"] != configs[1]["suite"]:
        raise StoreError(
            f"{after}: expected a run of the suite {configs[0]['suite']!r} as in {before}, found "
            f"{configs[1]['suite']!r}"
        )
    result = compare(read_results(before), read_results(after))
    if not result["episodes"]:
        raise StoreError(f"{before} and {after}: expected episodes in common, found none")
    described = [Conditions.of_json(config["conditions"]).describe() for config in configs]
    return {"suite": configs[0]["suite"], "before": {"run": str(before), "conditions": described[0]},
            "after": {"run": str(after), "conditions": described[1]}, **result}  # fmt: skip


def _finished_config(directory: Path) -> dict[str, Any]:
    """Read the configuration of a run with all keys that a comparison or a report reads. Raises StoreError."""
    config = read_config(directory)
    for key, kind in _CONFIG_KEYS.items():
        if not isinstance(config.get(key), kind):
            raise StoreError(
                f"{directory / CONFIG}: expected the configuration of a benchmark run with {key!r} as {kind.__name__}, "
                f"found {config.get(key)!r:.80}; restore the file, or name the directory of another run"
            )
    return config


def _report(directory: Path) -> int:
    config = _finished_config(directory)
    store = ResultStore(directory, config, read_results(directory), failed=read_failed(directory))
    from sim_hil.benchmark.results.report import write_report  # it loads matplotlib, which takes seconds

    title = f"DynaNav: {Path(config['suite']).stem}, {Conditions.of_json(config['conditions']).policy}"
    sys.stdout.write(f"{write_report(store, summarise(store.results), title)}\n")
    return EXIT_DONE


def _lines(result: dict[str, Any]) -> str:
    lines = [f"A: {result['before']['conditions']}", f"B: {result['after']['conditions']}"]
    lines.append(f"{result['episodes']} episodes in both")
    lines.append(f"{'':<14}{'A':>9}{'B':>9}{'B - A':>9}   95 % interval")
    for name, row in result["differences"].items():
        interval = "–" if row["ci95"] is None else f"{row['ci95'][0]:+.2f} to {row['ci95'][1]:+.2f}"
        mark = "" if row["significant"] else "   (contains zero)"
        values = f"{row['before']:>9.2f}{row['after']:>9.2f}{row['difference']:>+9.2f}"
        lines.append(f"{_UNITS[name]:<14}{values}   {interval}{mark}")
    for key in ("succeeded_in_before_only", "succeeded_in_after_only"):
        if result[key]:
            ids = str(len(result[key])) if is_fresh(result["suite"]) else ", ".join(result[key])
            lines.append(f"{key.replace('_', ' ').replace('before', 'A').replace('after', 'B')}: {ids}")
    return "\n".join(lines) + "\n"
