"""Figures of the benchmark report as PNG bytes."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from reporting.plot_style import BAD, GOOD, INK, MUTED, TRUTH, legend_above, new_figure, png, tidy
from sim_hil.benchmark.results.record import EpisodeResult
from sim_hil.benchmark.results.summary import GROUPS, METRICS, grouped_by, interval_of
from sim_hil.scene.map import draw_map, draw_mark, draw_path, map_view
from sim_hil.scene.scene import Scene

Path2 = NDArray[np.float64]

_TITLES = {"scene": "scene", "crowd": "people in the scene", "robot": "robot"}
_MAP_PX = 1400
_SUCCESS, _COLLIDED, _FAILED = (44, 140, 74), (230, 140, 20), (179, 38, 30)
_START, _GOAL = (31, 111, 139), (44, 140, 74)


def rates(results: Sequence[EpisodeResult]) -> bytes:
    """Plot success and collision rate with 95 % bootstrap intervals, by scene, crowd and robot."""
    groups = [(name, grouped_by(results, name)) for name in GROUPS]
    widths = [max(1, len(members)) + 0.6 for _, members in groups]
    figure = new_figure(11.0, 3.6)
    all_axes = figure.subplots(1, len(groups), sharey=True, width_ratios=widths)
    for axes, (name, members) in zip(all_axes, groups, strict=True):
        at = np.arange(len(members), dtype=float)
        for offset, metric, colour, label in ((-0.2, "sr", TRUTH, "success"), (0.2, "cr", BAD, "collision")):
            means = np.array([float(np.mean([METRICS[metric](result) for result in each])) for _, each in members])
            spans = [interval_of(each, metric) or (mean, mean) for (_, each), mean in zip(members, means, strict=True)]
            errors = np.array([[m - low, high - m] for m, (low, high) in zip(means, spans, strict=True)]).T
            axes.bar(at + offset, means, 0.36, color=colour, alpha=0.9, label=f"{label} rate")
            axes.errorbar(at + offset, means, np.maximum(errors, 0), fmt="none", ecolor=INK, elinewidth=1, capsize=2.5)
            for x, mean in zip(at + offset, means, strict=True):
                axes.annotate(f"{mean:.0f}", (x, 3), ha="center", fontsize=7, color="white" if mean > 8 else INK)
        axes.set_xticks(at, [f"{key}\n({len(each)})" for key, each in members])
        axes.set_xlabel(_TITLES[name], fontsize=9)
        axes.set_ylim(0, 105)
        tidy(axes)
    all_axes[0].set_ylabel("% of episodes", fontsize=9)
    legend_above(all_axes[-1])
    return png(figure)


def scene_map(
    scene: Scene, results: Sequence[EpisodeResult], paths: Sequence[Path2], goals: Sequence[Sequence[float]]
) -> bytes:
    """Draw a scene from above with each episode's goal (x m, y m) and true path [n, 2] m, coloured by its end."""
    span_m = max(scene.floor_max_m[0] - scene.floor_min_m[0], 1.0)
    px_per_m = min(40.0, _MAP_PX / (span_m + 1))
    image, view = draw_map(scene, px_per_m, names=True), map_view(scene, px_per_m)
    for goal in goals:
        draw_mark(image, view, (goal[0], goal[1]), _GOAL, 0.5, filled=False)
    for result, path in sorted(zip(results, paths, strict=True), key=lambda pair: pair[0].success):
        colour = _FAILED if not result.success else _COLLIDED if result.collided else _SUCCESS
        draw_path(image, view, [(float(x), float(y)) for x, y in path], colour, 2)
        draw_mark(image, view, (float(path[0, 0]), float(path[0, 1])), _START, 0.2)
        draw_mark(image, view, (float(path[-1, 0]), float(path[-1, 1])), colour, 0.15)
    done, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    if not done:
        raise ValueError(f"map of {scene.name}: cannot be written as PNG")
    return bytes(data.tobytes())


def error_and_time(results: Sequence[EpisodeResult], width_in: float) -> bytes:
    """Plot each episode's final distance to the goal over the share of its time limit used."""
    figure = new_figure(width_in, 3.1)
    axes = figure.add_subplot()
    for label, colour, chosen in (
        ("reached", GOOD, [r for r in results if r.success]),
        ("not reached", BAD, [r for r in results if not r.success]),
    ):
        share = [100 * r.time_s / r.timeout_s for r in chosen]
        axes.scatter(share, [r.ne_m for r in chosen], s=14, color=colour, label=label, alpha=0.8, linewidths=0)
    axes.set_xlabel("% of the episode's time limit used", fontsize=9)
    axes.set_ylabel("distance to the goal at the end, m", fontsize=9)
    axes.set_xlim(0, 103)
    axes.set_ylim(bottom=0)
    axes.axvline(100, color=MUTED, linewidth=1)
    legend_above(axes)
    tidy(axes)
    return png(figure)
