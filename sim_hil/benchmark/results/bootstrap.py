"""Bootstrap confidence intervals over tasks and their episodes; seeded, so equal results give equal intervals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

RESAMPLES = 10_000
SEED = 85  # random seed of every interval in a report
_TAG = 0xB007
_Z2 = 1.959964**2  # 97.5 % point of the normal distribution, squared

Range = tuple[float, float]


def mean_ci95(values: Sequence[float], tasks: Sequence[str], bounds: Range | None = None) -> Range | None:
    """Return the 95 % interval of the mean of per-episode values; None for fewer than two values.

    Two-stage percentile bootstrap, because episodes of one task are correlated: draw tasks with replacement, then as
    many episodes of each task as it has. With `bounds` (lowest, highest) a rate over tasks of one episode has Wilson's
    interval, and so have equal values, for which resampling is uninformative: [95.7, 100] % for 85 successes in 85
    episodes. Raises ValueError if the numbers of values and tasks differ.
    """
    if len(values) != len(tasks):
        raise ValueError(f"bootstrap: expected a task for every value, found {len(values)} and {len(tasks)}")
    if len(values) < 2:
        return None
    array = np.asarray(values, dtype=np.float64)
    if bounds is not None and np.ptp(array) == 0:
        value, share = float(array[0]), _Z2 / (len(array) + _Z2)
        return value - share * (value - bounds[0]), value + share * (bounds[1] - value)
    if bounds is not None and len(set(tasks)) == len(tasks) and np.isin(array, bounds).all():
        return _wilson(array, bounds)
    low, high = np.percentile(_resampled_means(array, tasks), (2.5, 97.5))
    return float(low), float(high)


def _wilson(values: NDArray[np.float64], bounds: Range) -> Range:
    """Return Wilson's 95 % interval of the mean of values that are either the lowest or the highest."""
    low, high = bounds
    count, share = len(values), float(np.mean((values - low) / (high - low)))
    middle = (share + _Z2 / (2 * count)) / (1 + _Z2 / count)
    half = np.sqrt(_Z2 * (share * (1 - share) / count + _Z2 / (4 * count**2))) / (1 + _Z2 / count)
    return low + (high - low) * float(middle - half), low + (high - low) * float(middle + half)


def paired_ci95(
    before: Sequence[float],
    after: Sequence[float],
    tasks: Sequence[str],
    bounds: Range | None = None,
) -> Range | None:
    """Return the 95 % interval of the mean of `after - before` per episode; `bounds` are those of one value."""
    if len(before) != len(after):
        raise ValueError(f"paired bootstrap: expected as many values on both sides, found {len(before)}, {len(after)}")
    most = None if bounds is None else bounds[1] - bounds[0]
    differences = [b - a for a, b in zip(before, after, strict=True)]
    return mean_ci95(differences, tasks, None if most is None else (-most, most))


def _resampled_means(values: NDArray[np.float64], tasks: Sequence[str]) -> NDArray[np.float64]:
    _, task_of, sizes = np.unique(np.asarray(tasks), return_inverse=True, return_counts=True)
    by_task = np.zeros((len(sizes), int(sizes.max())))  # [task, episode], padded with zeros
    for task in range(len(sizes)):
        by_task[task, : sizes[task]] = values[task_of == task]
    rng = np.random.default_rng((SEED, _TAG))
    picked = rng.integers(0, len(sizes), size=(RESAMPLES, len(sizes)))
    sums = np.zeros(picked.shape)
    for turn in range(by_task.shape[1]):  # one episode of every drawn task at a time, to limit memory
        which = rng.integers(0, sizes[picked])
        sums += np.where(turn < sizes[picked], by_task[picked, which], 0.0)
    return np.asarray(sums.sum(axis=1) / sizes[picked].sum(axis=1))
