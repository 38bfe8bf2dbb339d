"""Summary of a benchmark run: rates in percent with bootstrap intervals, and differences between two runs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from sim_hil.benchmark.results.bootstrap import Range, mean_ci95, paired_ci95
from sim_hil.benchmark.results.record import EpisodeResult, ResultError
from sim_hil.benchmark.suite.strata import LENGTHS_M, band_of, kind_of, turns_of

CROWD_LEVELS = ((0, "0"), (20, "1-20"), (40, "21-40"), (60, "41-60"), (10_000, "61 and more"))
"""Crowd levels: (maximum number of people, name)."""

METRICS: dict[str, Callable[[EpisodeResult], float]] = {
    "sr": lambda result: 100.0 * result.success,
    "spl": lambda result: result.spl,
    "ne_m": lambda result: result.ne_m,
    "cr": lambda result: 100.0 * result.collided,
}
"""Value of one episode for each metric (paper equations 6 to 10)."""
BOUNDS: dict[str, Range | None] = {"sr": (0.0, 100.0), "spl": (0.0, 100.0), "ne_m": None, "cr": (0.0, 100.0)}
"""Lowest and highest value of one episode for each metric; None: unbounded."""
_SAME = ("task", "scene", "robot", "people", "seed", "shortest_m", "timeout_s")
"""Fields that must agree in two results with the same id: the id alone does not identify an episode."""

GROUPS: dict[str, Callable[[EpisodeResult], str]] = {
    "scene": lambda result: kind_of(result.scene),
    "crowd": lambda result: crowd_level(result.people),
    "robot": lambda result: result.robot,
    "length": lambda result: band_of(result.shortest_m) or "other",
    "turns": lambda result: str(turns_of(result.task)),
}
"""Name of the group of one episode, by kind of group; `length` and `turns` exist in a stratified suite alone."""
_STRATA = ("length", "turns")


def group_names(results: Sequence[EpisodeResult]) -> list[str]:
    """Return the kinds of groups that results have, keys of GROUPS."""
    stratified = bool(results) and all(turns_of(result.task) is not None for result in results)
    return [name for name in GROUPS if stratified or name not in _STRATA]


def crowd_level(people: int) -> str:
    """Return the name of the crowd level for a number of people."""
    return next(name for most, name in CROWD_LEVELS if people <= most)


def summarise(results: Sequence[EpisodeResult]) -> dict[str, Any]:
    """Return `episodes`, each metric's mean and `*_ci95`, and the same for each group under `by_scene` and so on."""
    results = sorted(results, key=lambda result: result.id)  # a sum's last digits depend on the order
    grouped = {
        f"by_{name}": {key: _means(members) for key, members in grouped_by(results, name)}
        for name in group_names(results)
    }
    return {**_means(results), **grouped}


def grouped_by(results: Iterable[EpisodeResult], name: str) -> list[tuple[str, list[EpisodeResult]]]:
    """Group results by a key of GROUPS; crowds and lengths in ascending order, other groups by name."""
    groups: dict[str, list[EpisodeResult]] = {}
    for result in results:
        groups.setdefault(GROUPS[name](result), []).append(result)
    order = [*(level for _, level in CROWD_LEVELS), *LENGTHS_M]
    return sorted(groups.items(), key=lambda item: (order.index(item[0]) if item[0] in order else 0, item[0]))


def interval_of(results: Sequence[EpisodeResult], name: str) -> Range | None:
    """Return the 95 % interval of a metric's mean; None for fewer than two results."""
    # Resampling depends on the order, and parallel jobs return results in any order.
    results = sorted(results, key=lambda result: result.id)
    return mean_ci95([METRICS[name](result) for result in results], [result.task for result in results], BOUNDS[name])


def _means(results: Sequence[EpisodeResult]) -> dict[str, Any]:
    means: dict[str, Any] = {"episodes": len(results)}
    for name, value_of in METRICS.items():
        values = [value_of(result) for result in results]
        interval = interval_of(results, name)
        means[name] = round(sum(values) / len(values), 4) if values else None
        means[f"{name}_ci95"] = None if interval is None else [round(bound, 4) for bound in interval]
    return means


def compare(before: Sequence[EpisodeResult], after: Sequence[EpisodeResult]) -> dict[str, Any]:
    """Return the differences `after - before` over common episodes, with paired bootstrap intervals.

    `significant`: the interval does not contain zero. Raises ResultError if an id names two different episodes.
    """
    first, second = ({result.id: result for result in results} for results in (before, after))
    ids = sorted(name for name in first if name in second)
    pairs = [(first[name], second[name]) for name in ids]
    for one, other in pairs:
        _check_same_episode(one, other)
    tasks = [one.task for one, _ in pairs]
    differences: dict[str, Any] = {}
    for name, value_of in METRICS.items():
        a, b = [value_of(one) for one, _ in pairs], [value_of(other) for _, other in pairs]
        interval = paired_ci95(a, b, tasks, BOUNDS[name])
        differences[name] = {
            "before": round(sum(a) / len(a), 4) if a else None,
            "after": round(sum(b) / len(b), 4) if b else None,
            "difference": round((sum(b) - sum(a)) / len(a), 4) if a else None,
            "ci95": None if interval is None else [round(bound, 4) for bound in interval],
            "significant": interval is not None and not interval[0] <= 0 <= interval[1],
        }
    return {
        "episodes": len(pairs),
        "only_before": sorted(set(first) - set(second)),
        "only_after": sorted(set(second) - set(first)),
        "succeeded_in_before_only": [a.id for a, b in pairs if a.success and not b.success],
        "succeeded_in_after_only": [b.id for a, b in pairs if b.success and not a.success],
        "differences": differences,
    }


def _check_same_episode(before: EpisodeResult, after: EpisodeResult) -> None:
    for name in _SAME:
        was, now = getattr(before, name), getattr(after, name)
        if was != now:
            raise ResultError(
                f"episode {before.id}: expected the same {name} in both runs, found {was} and {now}; the runs used two "
                "versions of the suite: repeat one of them"
            )
