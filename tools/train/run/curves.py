"""Plots of a run's log, one per stage: losses on top, then rates and the other values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from reporting.plot_style import new_figure, png, tidy
from tools.train.run.run_dir import RunDir

Series = dict[str, list[tuple[int, float]]]
"""(step, value) pairs by the name of the value."""
LOG_RATIO: Final = 20.0
"""Ratio of largest to smallest loss above which the axis is logarithmic."""
COLOURS: Final = ("#1f6f8b", "#d1603d", "#8a5fbf", "#2c8c4a", "#b8860b", "#5b6774")
SMOOTH: Final = 40
"""Points of the moving average that is drawn over long noisy lines."""


def draw_curves(run_dir: RunDir) -> list[Path]:
    """Write `curves/STAGE.png` for every stage in the log and return the paths."""
    written = []
    for stage, series in stages_of(run_dir).items():
        if not any(len(points) > 1 for points in series.values()):
            continue
        run_dir.curves.mkdir(parents=True, exist_ok=True)
        path = run_dir.curves / f"{stage}.png"
        draw(stage, series, path)
        written.append(path)
    return written


def stages_of(run_dir: RunDir) -> dict[str, Series]:
    """Return the log's finite values by stage and name, in the order of the steps."""
    stages: dict[str, Series] = {}
    for line in run_dir.lines():
        series = stages.setdefault(str(line["stage"]), {})
        for name, value in line.items():
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if name not in ("stage", "step") and number and abs(value) < float("inf"):
                series.setdefault(name, []).append((int(line["step"]), float(value)))
    return stages


def panels_of(names: Sequence[str]) -> list[list[str]]:
    """Group names by axis: losses, shares, and every other value on its own axis."""
    losses = [name for name in names if "loss" in name]
    rates = [name for name in names if name not in losses and any(part in name for part in _RATES)]
    return [group for group in (losses, rates, *([name] for name in names if name not in (*losses, *rates))) if group]


_RATES: Final = ("success", "accuracy", "share", "collided", "recall", "precision", "rate_of")


def draw(title: str, series: Mapping[str, Sequence[tuple[int, float]]], path: Path) -> None:
    """Draw one plot as a PNG file that depends on the values alone."""
    panels = panels_of(list(series))
    figure = new_figure(8.0, 1.0 + 2.2 * len(panels))
    axes = figure.subplots(len(panels), 1, squeeze=False, sharex=True)[:, 0]
    for axis, names in zip(axes, panels, strict=True):
        for name, colour in zip(names, COLOURS * (1 + len(names) // len(COLOURS)), strict=False):
            steps, values = zip(*series[name], strict=True)
            many = len(values) > 4 * SMOOTH
            axis.plot(steps, values, color=colour, linewidth=1.2, alpha=0.3 if many else 1.0,
                      marker="o" if len(values) < 30 else "", markersize=3, label=None if many else name)  # fmt: skip
            if many:
                axis.plot(steps, smoothed(values), color=colour, linewidth=1.6, label=name)
        drawn = [value for name in names for _, value in series[name]]
        if "loss" in names[0] and min(drawn) > 0 and max(drawn) > LOG_RATIO * min(drawn):
            axis.set_yscale("log")
        tidy(axis)
        axis.legend(loc="best", fontsize=8, frameon=False)
    axes[0].set_title(title)
    axes[-1].set_xlabel("step")
    path.write_bytes(png(figure))


def smoothed(values: Sequence[float]) -> list[float]:
    """Return the moving average over up to SMOOTH values."""
    sums = [0.0]
    for value in values:
        sums.append(sums[-1] + value)
    return [(sums[i + 1] - sums[max(0, i + 1 - SMOOTH)]) / min(i + 1, SMOOTH) for i in range(len(values))]
