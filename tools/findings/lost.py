"""How soon does the robot notice that it is lost? Read from the episodes that `tools.findings.split` has driven.

For each generation the text is compared with the text that would have been true at its newest frame. A detector, a
logistic regression on earlier texts and odometry alone, shows how much of being lost could be known without a camera.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    check_result_target,
    command_line,
    messages,
    write_result,
    write_whole,
)
from firmware_bridge.system.terminal import CommandParser
from sim_hil.benchmark.conditions.conditions import ConditionsError
from sim_hil.benchmark.results.record import read_log
from sim_hil.benchmark.results.store import EPISODES, StoreError
from tools.findings.lost_detector import ALARM, detector_figures
from tools.findings.lost_instants import Instant, deviations, instants_of
from tools.findings.split import BASE, read_variant
from tools.findings.split_policies import VARIANTS
from tools.findings.split_worker import EXPERT, scenario_of

COMMAND: Final = "lost"
EXAMPLES: Final = """examples:
  python -m tools.findings.lost --split out/split
  python -m tools.findings.lost --split out/split --variant free-decoding --json lost.json

It reads the results of python -m tools.findings.split and drives nothing. The table is also in SPLIT/lost-VARIANT.md.
exit codes: 0 done, 1 no episode with texts, 2 bad arguments or input
"""


def figures(episodes: Sequence[Sequence[Instant]]) -> dict[str, Any]:
    """Return how often and how soon lost robots notice it: by their texts, and by the detector."""
    every = [each for instants in episodes for each in instants]
    lost, said = sum(each.lost for each in every), sum(each.says_back for each in every)
    right = sum(each.lost and each.says_back for each in every)
    runs = [run for instants in episodes for run in deviations(instants)]
    noticed = sorted(run.noticed_s for run in runs if run.noticed_s is not None)
    backs = sorted(run.back_s for run in runs if run.back_s is not None)
    return {
        "episodes": len(episodes),
        "instants": len(every),
        "lost": lost,
        "true_back": sum(each.true_back for each in every),
        "back_recall_where_true": _share([each.says_back for each in every if each.true_back]),
        "progress_right_on_route": _share([each.true_progress for each in every if not each.lost]),
        "progress_right_lost": _share([each.true_progress for each in every if each.lost]),
        "back_recall": right / lost if lost else None,
        "back_precision": right / said if said else None,
        "deviations": len(runs),
        "noticed": len(noticed),
        "noticed_s_median": float(np.median(noticed)) if noticed else None,
        "returned": len(backs),
        "back_s_median": float(np.median(backs)) if backs else None,
        "detector": detector_figures(episodes),
        "tagged": "measured",
    }


def _share(values: Sequence[bool]) -> float | None:
    return sum(values) / len(values) if values else None


def markdown(content: Mapping[str, Any]) -> str:
    """Return the figures as a page of Markdown."""
    rows = {
        "episodes, generations": f"{content['episodes']}, {content['instants']}",
        "lost at": f"{content['lost']} generations",
        "progress right: on the route, lost": f"{_percent(content['progress_right_on_route'])}, "
        f"{_percent(content['progress_right_lost'])}",
        'the text says "turn back": of those lost': _percent(content["back_recall"]),
        "the same of those where the true text says so": f"{_percent(content['back_recall_where_true'])} of "
        f"{content['true_back']}",
        "the robot is lost: of those that say so": _percent(content["back_precision"]),
        "deviations; noticed by the text, after (median)": f"{content['deviations']}; {content['noticed']}, "
        f"{_seconds(content['noticed_s_median'])}",
        "came back to the route, after (median)": f"{content['returned']}, {_seconds(content['back_s_median'])}",
    }
    if (found := content["detector"]) is not None:
        low, high = found["area_under_roc_ci95"] or (float("nan"),) * 2
        rows["detector: area under the ROC curve"] = f"{found['area_under_roc']:.3f} ({low:.3f} to {high:.3f})"
        for share, recall in found["recall_at_false_alarms"].items():
            rows[f"detector: recall at {float(share):.0%} false alarms"] = _percent(recall)
        rows[f"detector: alarms at {ALARM:.0%}, after (median)"] = (
            f"{found['alarms']} of {content['deviations']}, {_seconds(found['alarm_s_median'])}"
        )
    lines = ["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows.items())]
    return "\n".join(lines) + "\n"


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{value:.1%}"


def _seconds(value: float | None) -> str:
    return "–" if value is None else f"{value:.1f} s"


def read_instants(split: Path, variant: str) -> list[list[Instant]]:
    """Return the generations of each episode of a variant. Raises StoreError, OSError."""
    episodes = []
    for number, result in read_variant(split, variant).items():
        path = split / "logs" / variant / EPISODES / f"{result.id}.json"
        try:
            log = read_log(path)
        except (ValueError, OSError) as error:
            raise StoreError(f"{path}: {error}; drive the variant again with tools.findings.split") from error
        episodes.append(instants_of(log, scenario_of(int(number))))
    return episodes


def parser() -> argparse.ArgumentParser:
    """Return the argument parser."""
    names = [name for name in VARIANTS if name != EXPERT]
    p = CommandParser(
        "python -m tools.findings.lost", description=__doc__, epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    p.add_argument("--split", type=Path, required=True, metavar="DIR", help="folder of tools.findings.split")
    p.add_argument("--variant", choices=names, default=BASE, help=f"variant whose texts are read (default: {BASE})")
    p.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    return p


@command_line(COMMAND, dict.fromkeys((ConditionsError, StoreError, OSError), EXIT_BAD_INPUT))
def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    args = parser().parse_args(argv)
    check_result_target(args.json)
    episodes = [instants for instants in read_instants(args.split, args.variant) if instants]
    if not episodes:
        messages(COMMAND)(f"{args.split}: no episode of {args.variant} with texts; run tools.findings.split first")
        return EXIT_CHECK_FAILED
    content = {"variant": args.variant, **figures(episodes)}
    write_whole(args.split / f"{COMMAND}-{args.variant}.md", markdown(content))
    write_result(args.json, content)
    if args.json != "-":
        sys.stdout.write(markdown(content))
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
