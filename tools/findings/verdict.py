"""From the results of runs to what holds: differences by episode, with bootstrap intervals over tasks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from sim_hil.benchmark.results.bootstrap import Range, mean_ci95
from sim_hil.benchmark.results.record import EpisodeResult, ResultError
from sim_hil.benchmark.results.summary import BOUNDS, METRICS, compare
from tools.findings.rows import CLAIMS, Finding, Level, Pair

HOLDS, FAILS, OPEN = "holds", "does not hold", "undecided"
OTHERS: Final = ("spl", "ne_m", "cr")

Results = Mapping[str, Sequence[EpisodeResult]]
"""Of every run by its name."""


@dataclass(frozen=True)
class Judged:
    """A claim with what was measured; rates in percent, differences in points."""

    row: str
    claim: str
    source: str
    metric: str
    n: int
    """Episodes that all of its runs have."""
    before: float | None
    """Mean of the first runs; None for a claim about one run."""
    after: float
    value: float
    """The difference, or of one run its metric."""
    ci95: Range | None
    least: float
    """What it has to be above (below, for what is to be small)."""
    verdict: str
    runs: tuple[str, ...]
    also: Mapping[str, Any]
    """Differences of the other metrics, where there is one pair of runs."""


def verdict_of(interval: Range | None, least: float) -> str:
    """Return whether a number's interval is above or below `least`, or undecided."""
    if interval is None:
        return OPEN
    if interval[0] > least:
        return HOLDS
    return FAILS if interval[1] < least else OPEN


def judge_all(results: Results, claims: Sequence[Finding | Level] = CLAIMS) -> list[Judged]:
    """Test every claim whose runs all exist."""
    return [judge(claim, results) for claim in claims if all(results.get(name) for name in claim.runs)]


def judge(claim: Finding | Level, results: Results) -> Judged:
    """Test one claim. Raises ResultError if its runs share no episode, or have different episodes of one name."""
    return _level(claim, results) if isinstance(claim, Level) else _finding(claim, results)


def _level(claim: Level, results: Results) -> Judged:
    members = sorted(results[claim.run], key=lambda each: each.id)
    values = [METRICS[claim.metric](each) for each in members]
    interval = mean_ci95(values, [each.task for each in members], BOUNDS[claim.metric])
    value = sum(values) / len(values)
    turned = interval if interval is None or claim.sign > 0 else (-interval[1], -interval[0])
    return Judged(
        claim.row, claim.claim, claim.source, claim.metric, len(values), None, round(value, 3), round(value, 3),
        _rounded(interval), claim.bound, verdict_of(turned, claim.sign * claim.bound), claim.runs, {},
    )  # fmt: skip


def _finding(claim: Finding, results: Results) -> Judged:
    ids = set.intersection(*({each.id for each in results[name]} for name in claim.runs))
    if not ids:
        raise ResultError(f"{claim.row}: {', '.join(claim.runs)} have no episode in common")
    order = sorted(ids)
    gain, before, after = _gain(claim.pairs, order, results, claim.metric)
    if claim.minus:
        less, _, _ = _gain(claim.minus, order, results, claim.metric)
        gain = [a - b for a, b in zip(gain, less, strict=True)]
    tasks = _tasks(results[claim.runs[0]], order)
    bounds = BOUNDS[claim.metric]
    span = None if bounds is None else (bounds[1] - bounds[0]) * (2 if claim.minus else 1)
    interval = mean_ci95(gain, tasks, None if span is None else (-span, span))
    also: dict[str, Any] = {}
    if len(claim.pairs) == 1 and not claim.minus:
        differences = compare(results[claim.pairs[0][0]], results[claim.pairs[0][1]])["differences"]
        also = {name: differences[name] for name in OTHERS}
    return Judged(
        claim.row, claim.claim, claim.source, claim.metric, len(order), round(before, 3), round(after, 3),
        round(sum(gain) / len(gain), 3), _rounded(interval), claim.least, verdict_of(interval, claim.least),
        claim.runs, also,
    )  # fmt: skip


def _gain(
    pairs: Sequence[Pair], order: Sequence[str], results: Results, metric: str
) -> tuple[list[float], float, float]:  # fmt: skip
    """Return each episode's difference, averaged over pairs, and the means of both sides."""
    value_of = METRICS[metric]
    first: list[float] = [0.0] * len(order)
    second: list[float] = [0.0] * len(order)
    for names in pairs:
        compare(results[names[0]], results[names[1]])  # raises if one name means two different episodes
        for side, name in ((first, names[0]), (second, names[1])):
            by_id = {each.id: each for each in results[name]}
            for index, episode_id in enumerate(order):
                side[index] += value_of(by_id[episode_id]) / len(pairs)
    gain = [b - a for a, b in zip(first, second, strict=True)]
    return gain, sum(first) / len(first), sum(second) / len(second)


def _tasks(members: Sequence[EpisodeResult], order: Sequence[str]) -> list[str]:
    task_of = {each.id: each.task for each in members}
    return [task_of[episode_id] for episode_id in order]


def _rounded(interval: Range | None) -> Range | None:
    return None if interval is None else (round(interval[0], 3), round(interval[1], 3))
