"""Style of all plots: colours, figures, axes and histograms, drawn with matplotlib's object interface."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

INK = "#1d2733"
MUTED = "#6b7785"
TRUTH = "#1f6f8b"
COMMAND = "#d1603d"
WALL = "#46525e"
PERSON = "#8a5fbf"
GOOD = "#2c8c4a"
BAD = "#b3261e"
DPI = 160


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure."""
    # Most runs of a command draw nothing, and matplotlib loads for half a second.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), dpi=DPI, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def png(figure: Figure) -> bytes:
    """Return the figure as PNG; its bytes depend only on the figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def tidy(axes: Axes) -> None:
    """Draw a light grid behind the data and no box."""
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.spines["left"].set_color(MUTED)
    axes.spines["bottom"].set_color(MUTED)
    axes.tick_params(colors=INK, labelsize=8)
    axes.grid(color="#e4e8ec", linewidth=0.6)
    axes.set_axisbelow(True)


def legend_above(axes: Axes) -> None:
    """Draw the legend in a row above the axes."""
    axes.legend(fontsize=8, frameon=False, loc="lower right", bbox_to_anchor=(1, 0.98), ncols=4, borderaxespad=0)


def percentile(samples: Array, percent: float) -> float:
    """Return the nearest-rank percentile, as `edge.core.stats.percentiles` does."""
    return float(np.percentile(samples, percent, method="inverted_cdf"))


def draw_histogram(axes: Axes, samples: Array, bin_width: float, colour: str, unit: str, digits: int) -> None:
    """Draw a histogram from 0 with lines at p50, p99 and the maximum.

    Bins are centred on the multiples of their width: on an edge, rounding would decide between two bins.
    """
    largest = float(samples.max())
    bins = (np.arange(int(largest / bin_width + 0.5) + 2) - 0.5) * bin_width
    axes.hist(samples, bins=bins.tolist(), color=colour)
    lines = (("p50", percentile(samples, 50), ":", INK), ("p99", percentile(samples, 99), "--", INK))
    for name, value, dash, line_colour in (*lines, ("max", largest, "-", MUTED)):
        label = f"{name} {value:.{digits}f} {unit}"
        axes.axvline(value, color=line_colour, linewidth=1, linestyle=dash, label=label)
    legend_above(axes)


def delay_histogram(delays_s: Array) -> bytes:
    """Draw the age Δt of the semantic state over all ticks that had one, s."""
    figure = new_figure(5.4, 3.1)
    axes = figure.add_subplot()
    if len(delays_s):
        # Ticks are 0.1 s apart, so a finer bin would show the comb of the ticks instead of the delay.
        draw_histogram(axes, delays_s, 0.1, PERSON, "s", 2)
    axes.set_xlim(left=0)
    axes.set_xlabel("Δt = now − capture of the anchor frame, in s", fontsize=9)
    axes.set_ylabel("ticks", fontsize=9)
    tidy(axes)
    return png(figure)
