"""Findings as a page of Markdown, a JSON object and two pictures."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from edge.core.cli import write_whole
from reporting.plot_style import BAD, COMMAND, GOOD, INK, MUTED, TRUTH, new_figure, png, tidy
from sim_hil.benchmark.results.summary import interval_of, summarise
from tools.findings.rows import SWEEP_S
from tools.findings.verdict import FAILS, HOLDS, OPEN, Judged, Results

SCHEMA: Final = 1
COLOURS: Final = {HOLDS: GOOD, FAILS: BAD, OPEN: MUTED}
NAMES: Final = {"sr": "SR", "spl": "SPL", "cr": "CR", "ne_m": "NE"}
HOW: Final = """\
Each run drives the same episodes; a difference is taken episode by episode. Intervals are of 95 %, percentile
bootstraps over tasks and their episodes (10 000 resamples, seeded). A claim *holds* when its whole interval is on its
side of the bound, *does not hold* when its whole interval is on the other, and is *undecided* in between. All numbers
are measured.

Every model was trained once, from one seed. Intervals cover the choice of episodes, not of trainings: two trainings of
the same network differ too. Ablations are compared with `full`, which has the same drives, encoder, language model and
amount of imitation.

The primary claim about PPO is the one over all latencies of 3 to 5 s. The claims at single latencies are secondary:
of five, one may hold by chance.
"""


def write_findings(
    out: Path,
    about: Mapping[str, object],
    judged: Sequence[Judged],
    results: Results,
    described: Mapping[str, str],
    missing: Mapping[str, str],
) -> dict[str, Any]:
    """Write findings.md, findings.json and the pictures; return the JSON.

    `described` and `missing`: the conditions of each run, or why it is missing.
    """
    content = {
        "schema": SCHEMA,
        **about,
        "findings": [asdict(each) for each in judged],
        "runs": {name: {"conditions": described[name], **summarise(results[name])} for name in results},
        "not_run": dict(missing),
        "tagged": "measured",
    }
    write_whole(out / "findings.json", json.dumps(content, indent=1) + "\n")
    pictures = []
    if judged:
        pictures.append(draw_findings(judged, out / "findings.png"))
    if sum(f"rl-{s}s" in results for s in SWEEP_S) > 1:
        pictures.append(draw_latency(results, out / "latency.png"))
    write_whole(out / "findings.md", markdown(content, judged, pictures))
    return content


def markdown(content: Mapping[str, Any], judged: Sequence[Judged], pictures: Sequence[Path]) -> str:
    """Render the page."""
    lines = ["# Findings", "", f"Suite `{content['suite']}`, {content['asked']} episodes requested, latency ", ""]
    lines[2] += f"{content['latency']}.{'' if content['trained'] else ' **The weights are untrained.**'}"
    lines += [
        HOW,
        "| claim | of | n | from | to | measured (95 %) | bound | |",
        "|---|---|---:|---:|---:|---:|---:|---|",
    ]
    lines += [_row(each) for each in judged]
    lines += ["", *(f"![{path.stem}]({path.name})\n" for path in pictures)]
    others = [each for each in judged if each.also]
    if others:
        lines += ["## Other metrics of the same pairs", "", "| claim | SPL | NE, m | CR |", "|---|---:|---:|---:|"]
    for each in others:
        cells = [_change(each.also[name]) for name in ("spl", "ne_m", "cr")]
        lines.append(f"| {each.claim} | {' | '.join(cells)} |")
    lines += [
        "",
        "## Runs",
        "",
        "| run | n | SR % | SPL % | NE m | CR % | conditions |",
        "|---|---:|---:|---:|---:|---:|---|",
    ]
    for name, run in content["runs"].items():
        cells = [_mean(run, key) for key in ("sr", "spl", "ne_m", "cr")]
        lines.append(f"| {name} | {run['episodes']} | {' | '.join(cells)} | {run['conditions']} |")
    if content["not_run"]:
        lines += ["", "## Not run", "", *(f"* {name}: {why}" for name, why in content["not_run"].items())]
    return "\n".join(lines) + "\n"


def _row(each: Judged) -> str:
    name = NAMES[each.metric]
    # A difference has a sign; a level has none.
    sign = "" if each.before is None else "+"
    low, high = each.ci95 or (each.value, each.value)
    before = "" if each.before is None else f"{each.before:.1f}"
    value = f"{each.value:{sign}.1f} ({low:{sign}.1f} to {high:{sign}.1f})"
    return (
        f"| {each.claim} | {each.source} | {each.n} | {before} | {name} {each.after:.1f} | {value} | {each.least:g} | "
        f"**{each.verdict}** |"
    )


def _change(difference: Mapping[str, Any]) -> str:
    interval = difference["ci95"]
    span = "" if interval is None else f" ({interval[0]:+.1f} to {interval[1]:+.1f})"
    return f"{difference['difference']:+.1f}{span}"


def _mean(run: Mapping[str, Any], key: str) -> str:
    interval = run[f"{key}_ci95"]
    return f"{run[key]:.1f}" + ("" if interval is None else f" ({interval[0]:.1f} to {interval[1]:.1f})")


def draw_findings(judged: Sequence[Judged], path: Path) -> Path:
    """Draw every claim's number with its interval and bound, one row each."""
    figure = new_figure(9.0, 1.0 + 0.42 * len(judged))
    axis = figure.subplots()
    for row, each in enumerate(reversed(judged)):
        colour = COLOURS[each.verdict]
        low, high = each.ci95 or (each.value, each.value)
        axis.plot((low, high), (row, row), color=colour, linewidth=2.5, solid_capstyle="butt")
        axis.plot((each.value,), (row,), "o", color=colour, markersize=6)
        axis.plot((each.least, each.least), (row - 0.35, row + 0.35), color=INK, linewidth=1.2, linestyle=":")
    tidy(axis)
    axis.set_yticks(range(len(judged)), [f"{each.claim} (n {each.n})" for each in reversed(judged)], fontsize=8)
    axis.set_xlabel("points, with the interval of 95 %; dotted: the bound")
    axis.axvline(0.0, color=INK, linewidth=0.8)
    path.write_bytes(png(figure))
    return path


def draw_latency(results: Results, path: Path) -> Path:
    """Draw SR and CR over latency, before and after PPO (the paper's Figure 5)."""
    figure = new_figure(8.0, 3.4)
    for axis, metric in zip(figure.subplots(1, 2), ("sr", "cr"), strict=True):
        for prefix, label, colour in (("no-rl", "before PPO", COMMAND), ("rl", "after PPO", TRUTH)):
            seconds = [s for s in SWEEP_S if results.get(f"{prefix}-{s}s")]
            means = [summarise(results[f"{prefix}-{s}s"])[metric] for s in seconds]
            intervals = [
                interval_of(results[f"{prefix}-{s}s"], metric) or (m, m) for s, m in zip(seconds, means, strict=True)
            ]
            errors = [[m - i[0] for m, i in zip(means, intervals, strict=True)],
                      [i[1] - m for m, i in zip(means, intervals, strict=True)]]  # fmt: skip
            axis.errorbar(seconds, means, yerr=errors, color=colour, marker="o", capsize=3, label=label)
        axis.set_xlabel("latency of reasoning, s")
        axis.set_ylabel(f"{NAMES[metric]}, %")
        axis.set_ylim(0, 100)
        tidy(axis)
        axis.legend(frameon=False, fontsize=8)
    path.write_bytes(png(figure))
    return path
