"""From samples to verdicts: medians over rounds, paired ratios against the best peer, the bars of the issue."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from tools.bench.peers.contenders import OURS, OWN_STACK

Series = Mapping[str, Sequence[float]]
"""Contender → one value a round, in the same rounds for all."""


@dataclass(frozen=True)
class Metric:
    """A measured quantity, its direction, and the bar that the issue sets (ratio against the best peer)."""

    key: str
    title: str
    unit: str
    higher_is_better: bool
    bar: float | None
    against_own_stack: bool = False
    """Whether plain ONNX Runtime counts as a peer here (it does where the bar is about splitting, not the runtime)."""


METRICS = (
    Metric("encoder_ms", "encoder, one frame", "ms", False, 1.0),
    Metric("prefill_ms", "prefill", "ms", False, 1.1),
    Metric("decode_tokens_per_s", "decode", "tok/s", True, 1.8),
    Metric("action_ms", "action expert, one step", "ms", False, 2.0, against_own_stack=True),
    Metric("tick_ms", "control tick (encoder + action)", "ms", False, None),
    Metric("language_rss_mb", "peak memory, language model (RSS)", "MB", False, 1.0),
    Metric("everything_rss_mb", "peak memory, all parts (RSS)", "MB", False, 1.0),
    Metric("language_anon_mb", "the same without mapped files, language model", "MB", False, None),
    Metric("everything_anon_mb", "the same without mapped files, all parts", "MB", False, None),
)


@dataclass(frozen=True)
class Row:
    """One contender in one metric."""

    contender: str
    median: float
    low: float
    high: float
    n: int
    ours: bool
    own_stack: bool


@dataclass(frozen=True)
class Verdict:
    """One metric: its rows from best to worst and how ours stands against the best peer."""

    metric: Metric
    rows: tuple[Row, ...]
    best_peer: str | None
    ratio: float | None
    """How many times better ours is than the best peer (median of the paired ratios); None without one of the two."""
    reached: bool | None
    """None where there is no bar or nothing to compare."""


def paired_ratio(metric: Metric, ours: Sequence[float], peer: Sequence[float]) -> float:
    """Median over rounds of how many times better ours is; raises ValueError when the rounds do not match."""
    pairs = zip(ours, peer, strict=True)
    return statistics.median(o / p if metric.higher_is_better else p / o for o, p in pairs)


def judge(metric: Metric, series: Series, stacks: Mapping[str, str]) -> Verdict:
    """Rank the contenders of a metric and compare ours with the best peer."""
    rows = [
        Row(
            name,
            statistics.median(values),
            min(values),
            max(values),
            len(values),
            stacks[name] == OURS,
            stacks[name] in OWN_STACK,
        )
        for name, values in series.items()
        if values
    ]
    rows.sort(key=lambda row: -row.median if metric.higher_is_better else row.median)
    mine = next((row.contender for row in rows if row.ours), None)
    peers = (row for row in rows if not row.ours and (metric.against_own_stack or not row.own_stack))
    best = next((row.contender for row in peers), None)
    ratio = paired_ratio(metric, series[mine], series[best]) if mine and best else None
    reached = None if ratio is None or metric.bar is None else ratio >= metric.bar
    return Verdict(metric, tuple(rows), best, ratio, reached)


def judge_all(series: Mapping[str, Series], stacks: Mapping[str, str]) -> list[Verdict]:
    """Verdicts of every metric that was measured."""
    return [judge(metric, series[metric.key], stacks) for metric in METRICS if series.get(metric.key)]


def verdict_text(verdict: Verdict) -> str:
    """`1.31× (bar 1.1×: reached)` and the like."""
    if verdict.ratio is None:
        return "not compared"
    text = f"{verdict.ratio:.2f}× against {verdict.best_peer}"
    if verdict.metric.bar is None:
        return text
    return f"{text} (bar {verdict.metric.bar:g}×: {'reached' if verdict.reached else 'NOT reached'})"


def markdown(verdicts: Sequence[Verdict], heading: str, notes: Sequence[str]) -> str:
    """The summary as Markdown."""
    lines = [f"# {heading}", "", *(f"- {note}" for note in notes), "", "| | ours against the best peer |", "|---|---|"]
    lines += [f"| {v.metric.title} | {verdict_text(v)} |" for v in verdicts]
    for v in verdicts:
        lines += ["", f"## {v.metric.title}, {v.metric.unit}", "", "| contender | median | min | max | n |"]
        lines += ["|---|---|---|---|---|"]
        for row in v.rows:
            name = f"**{row.contender}**" if row.ours else row.contender + (" (our own stack)" if row.own_stack else "")
            lines.append(f"| {name} | {row.median:.4g} | {row.low:.4g} | {row.high:.4g} | {row.n} |")
    return "\n".join(lines) + "\n"
