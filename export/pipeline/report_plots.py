"""The two plots of the export's report, as PNG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from reporting.plot_style import BAD, COMMAND, GOOD, INK, PERSON, TRUTH, new_figure, png, tidy

WIDTH_IN = 5.4
_STYLES = tuple(zip((TRUTH, COMMAND, PERSON, GOOD, "#b8860b"), ("-", "--", ":", "-.", (0, (5, 5))), strict=True))
"""Colour and dash of each line; the dash distinguishes them in a grey print."""


@dataclass(frozen=True)
class Dot:
    """Row of a dot plot; a marked one is drawn filled."""

    label: str
    value: float
    marked: bool


@dataclass(frozen=True)
class Line:
    """Line of a line plot: (x, y) points in order of x."""

    label: str
    points: tuple[tuple[float, float], ...]


def dot_plot(dots: Sequence[Dot], x_label: str, limit: float) -> bytes:
    """Draw values on a logarithmic axis, one row each; 0 is on the left edge."""
    figure = new_figure(WIDTH_IN, 0.9 + 0.25 * len(dots))
    axes = figure.add_subplot()
    values = [value for value in [*(dot.value for dot in dots), limit] if value > 0] or [1.0]
    low, high = (10.0 ** round_(math.log10(of(values))) for round_, of in ((math.floor, min), (math.ceil, max)))
    rows = range(len(dots), 0, -1)
    for row, dot in zip(rows, dots, strict=True):
        x = max(dot.value, low)
        axes.plot([low, x], [row, row], color="#dfe4e9", linewidth=1)
        fill = TRUTH if dot.marked else "white"
        axes.plot([x], [row], marker="o", markeredgecolor=TRUTH, markerfacecolor=fill, clip_on=False)
    axes.axvline(limit, color=BAD, linewidth=1, linestyle="--")
    axes.set_xscale("log")
    axes.set_xlim(low, max(high, 10 * low))
    axes.set_ylim(0.5, len(dots) + 0.5)
    tidy(axes)
    axes.set_yticks(rows, [dot.label for dot in dots], parse_math=False)
    axes.set_xlabel(x_label, fontsize=9)
    return png(figure)


def line_plot(lines: Sequence[Line], x_label: str, y_label: str, limit: float) -> bytes:
    """Draw lines from zero up. A limit above twice the largest value appears in the legend only."""
    figure = new_figure(WIDTH_IN, 2.4 + 0.18 * len(lines))
    axes = figure.add_subplot()
    for index, line in enumerate(lines):
        colour, dash = _STYLES[index % len(_STYLES)]
        axes.plot(*zip(*line.points, strict=True), color=colour, linestyle=dash, label=line.label)
    largest = max(y for line in lines for _, y in line.points)
    near = 0 < limit <= 2 * largest
    # A line at infinity is not visible, but its name is in the legend.
    axes.axhline(
        limit if near else math.nan,
        color=BAD,
        linewidth=1,
        linestyle="--",
        label=f"gate: {limit:g}{'' if near else ', off the scale'}",
    )
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    tidy(axes)
    figure.legend(fontsize=8, frameon=False, loc="outside upper left", labelcolor=INK)
    axes.set_xlabel(x_label, fontsize=9)
    axes.set_ylabel(y_label, fontsize=9)
    return png(figure)
