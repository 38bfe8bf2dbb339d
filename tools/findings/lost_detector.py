"""A detector of lost robots that reads earlier texts and odometry alone: what could be known without a camera."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.core.geometry import wrap_angle
from edge.state.reasoning_text import Plan, Stop, Turn
from tools.findings.lost_instants import Instant, deviations

Array = NDArray[np.float64]

WINDOW: Final = 5
"""Latest texts that the detector reads."""
FOLDS: Final = 5
"""The detector scores an episode only with the weights of the other folds."""
FALSE_ALARMS: Final = (0.01, 0.05, 0.10)
"""Shares of the instants on the route at which the detector's recall is reported."""
ALARM: Final = 0.05
"""The share for which the time until the alarm is reported."""
RESAMPLES: Final = 1000
RIDGE: Final = 1.0
LEVEL_RIDGE: Final = 0.1
"""Of the constant: a fold may have no lost robot at all."""
STEPS: Final = 25
FEATURES: Final = (
    "turn back", "overruled", "overdue", "receding", "changes", "time on the leg", "unnamed rotation", "passed",
    "standing",
)  # fmt: skip


def detector_figures(episodes: Sequence[Sequence[Instant]]) -> dict[str, Any] | None:
    """Return the detector's figures; None where no robot, or each, was lost."""
    labels = [np.array([each.lost for each in instants], bool) for instants in episodes]
    scores = detector_scores([features(instants) for instants in episodes], labels)
    all_scores, all_labels = np.concatenate(scores), np.concatenate(labels)
    area = area_under_roc(all_scores, all_labels)
    if area is None:
        return None
    rng = np.random.default_rng(0)
    areas = []
    for _ in range(RESAMPLES):
        drawn = rng.integers(len(episodes), size=len(episodes))
        found = area_under_roc(np.concatenate([scores[k] for k in drawn]), np.concatenate([labels[k] for k in drawn]))
        areas += [] if found is None else [found]
    threshold = threshold_at(all_scores, all_labels, ALARM)
    waits = [
        next((at.time_s - run.begin_s for at, score in zip(instants, own, strict=True)
              if run.contains(at) and score > threshold), None)
        for instants, own in zip(episodes, scores, strict=True)
        for run in deviations(instants)
    ]  # fmt: skip
    found_s = sorted(wait for wait in waits if wait is not None)
    return {
        "area_under_roc": area,
        "area_under_roc_ci95": [float(v) for v in np.percentile(areas, (2.5, 97.5))] if areas else None,
        "recall_at_false_alarms": {
            f"{share:g}": float(np.mean(all_scores[all_labels] > threshold_at(all_scores, all_labels, share)))
            for share in FALSE_ALARMS
        },
        "alarm_s_median": float(np.median(found_s)) if found_s else None,
        "alarms": len(found_s),
        "weights": dict(zip(FEATURES, _weights(episodes, labels), strict=True)),
    }


def _weights(episodes: Sequence[Sequence[Instant]], labels: Sequence[NDArray[np.bool_]]) -> list[float]:
    """Return the change of the log odds by one standard deviation of each feature, fitted to all episodes."""
    rows = np.concatenate([features(instants) for instants in episodes])
    score = fit(rows, np.concatenate(labels))
    middle, spread = rows.mean(0), rows.std(0)
    base = score(middle[None])[0]
    return [float(score((middle + spread * unit)[None])[0] - base) for unit in np.eye(len(FEATURES))]


def features(instants: Sequence[Instant]) -> Array:
    """Return what the detector reads at each instant [n, FEATURES]: texts until then, and odometry."""
    rows: list[list[float]] = []
    leg_at = turn_at = 0  # where this leg began, and where this turn was first named
    for k, now in enumerate(instants):
        before = instants[k - 1] if k else now
        if k and _leg(now) != _leg(before):
            leg_at = k
        if k and (_leg(now), _aim(now)) != (_leg(before), _aim(before)):
            turn_at = k
        recent = instants[max(0, k + 1 - WINDOW) : k + 1]
        first, oldest = instants[turn_at], recent[0]
        same = [each for each in recent if (_leg(each), _aim(each)) == (_leg(now), _aim(now))]
        rotated = abs(wrap_angle(now.heading_rad - oldest.heading_rad))
        progress = now.said.progress
        rows.append(
            [
                float(now.says_back),
                sum(each.overruled for each in recent) / WINDOW,
                _capped(now.driven_m - first.driven_m - _distance_m(first), 10.0),
                _capped(_distance_m(now) + now.driven_m - _distance_m(same[0]) - same[0].driven_m, 10.0),
                sum(_aim(a) != _aim(b) for a, b in itertools.pairwise(recent)) / WINDOW,
                _capped((now.time_s - instants[leg_at].time_s) / 60.0, 2.0),
                rotated if _leg(oldest) == _leg(now) else 0.0,
                0.0 if progress is None else _capped(progress.passed / 3.0, 2.0),
                float(now.driven_m - oldest.driven_m < 0.5 and now.time_s > oldest.time_s),
            ]
        )
    return np.array(rows, np.float64).reshape(-1, len(FEATURES))


def _leg(instant: Instant) -> int:
    return 0 if instant.said.progress is None else instant.said.progress.step


def _aim(instant: Instant) -> str:
    """Return what the plan is: a turn's side, to stop, or to turn back."""
    plan: Plan | None = instant.said.plan
    if plan is None:
        return ""
    return plan.action.side if isinstance(plan.action, Turn) else type(plan.action).__name__


def _distance_m(instant: Instant) -> float:
    plan = instant.said.plan
    return float(plan.action.distance_m) if plan is not None and isinstance(plan.action, Turn | Stop) else 0.0


def _capped(value: float, most: float) -> float:
    return min(max(value, -most), most)


def detector_scores(rows: Sequence[Array], labels: Sequence[NDArray[np.bool_]]) -> list[Array]:
    """Return each episode's scores from a logistic regression that was fitted to the episodes of the other folds."""
    scores = [np.zeros(len(each)) for each in rows]
    for fold in range(FOLDS):
        taught = [k for k in range(len(rows)) if k % FOLDS != fold and len(rows[k])]
        asked = [k for k in range(len(rows)) if k % FOLDS == fold and len(rows[k])]
        if not taught or not asked:
            continue
        model = fit(np.concatenate([rows[k] for k in taught]), np.concatenate([labels[k] for k in taught]))
        for k in asked:
            scores[k] = model(rows[k])
    return scores


def fit(rows: Array, labels: NDArray[np.bool_]) -> Callable[[Array], Array]:
    """Return a logistic regression's score (log odds); Newton's method with a ridge, on standardised columns."""
    middle, spread = rows.mean(0), np.maximum(rows.std(0), 1e-6)

    def inputs(each: Array) -> Array:
        return np.column_stack((np.ones(len(each)), (each - middle) / spread))

    x, y = inputs(rows), labels.astype(np.float64)
    weights, ridge = np.zeros(x.shape[1]), RIDGE * np.eye(x.shape[1])
    ridge[0, 0] = LEVEL_RIDGE
    for _ in range(STEPS):
        p = 1.0 / (1.0 + np.exp(-np.clip(x @ weights, -30.0, 30.0)))
        slope = x.T @ (p - y) + ridge @ weights
        weights -= np.linalg.solve((x * (p * (1 - p))[:, None]).T @ x + ridge, slope)
    return lambda each: inputs(each) @ weights


def area_under_roc(scores: Array, labels: NDArray[np.bool_]) -> float | None:
    """Return the share of (lost, not lost) pairs that the scores order rightly, ties half; None without both kinds."""
    lost, fine = scores[labels], np.sort(scores[~labels])
    if not len(lost) or not len(fine):
        return None
    below, upto = (np.searchsorted(fine, lost, side=side) for side in ("left", "right"))
    return float(np.mean((below + upto) / 2.0) / len(fine))


def threshold_at(scores: Array, labels: NDArray[np.bool_], false_alarms: float) -> float:
    """Return the lowest score above which at most that share of the instants on the route lies."""
    fine = np.sort(scores[~labels])[::-1]
    return float(fine[min(int(false_alarms * len(fine)), len(fine) - 1)]) if len(fine) else np.inf
