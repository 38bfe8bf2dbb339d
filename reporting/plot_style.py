"""The look that all reports share: colours, figures, axes, and the histogram of the delay. No global state."""

from __future__ import annotations

import io

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

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
    """An empty figure drawn with matplotlib's object interface."""
    figure = Figure(figsize=(width_in, height_in), dpi=DPI, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def png(figure: Figure) -> bytes:
    """The figure as PNG; the bytes depend on what is drawn alone."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def tidy(axes: Axes) -> None:
    """Light grid behind, no box."""
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.spines["left"].set_color(MUTED)
    axes.spines["bottom"].set_color(MUTED)
    axes.tick_params(colors=INK, labelsize=8)
    axes.grid(color="#e4e8ec", linewidth=0.6)
    axes.set_axisbelow(True)


def legend_above(axes: Axes) -> None:
    """The legend in a row above the axes."""
    axes.legend(fontsize=8, frameon=False, loc="lower right", bbox_to_anchor=(1, 0.98), ncols=4, borderaxespad=0)


def percentile(samples: Array, percent: float) -> float:
    """Nearest rank, a value that occurred: the same as the runner's `edge.core.stats.percentiles`."""
    return float(np.percentile(samples, percent, method="inverted_cdf"))


def delay_histogram(delays_s: Array) -> bytes:
    """Age Δt of the semantic state over all ticks that had one."""
    figure = new_figure(5.4, 3.1)
    axes = figure.add_subplot()
    if len(delays_s):
        p50, p99 = percentile(delays_s, 50), percentile(delays_s, 99)
        # Ticks are 0.1 s apart, so a finer bin would show the comb of the ticks instead of the delay.
        axes.hist(delays_s, bins=np.arange(0, delays_s.max() + 0.1, 0.1).tolist(), color=PERSON)
        axes.axvline(p50, color=INK, linewidth=1, linestyle=":", label=f"p50 {p50:.2f} s")
        axes.axvline(p99, color=INK, linewidth=1, linestyle="--", label=f"p99 {p99:.2f} s")
        axes.axvline(delays_s.max(), color=MUTED, linewidth=1, label=f"max {delays_s.max():.2f} s")
        legend_above(axes)
    axes.set_xlim(left=0)
    axes.set_xlabel("Δt = now − capture of the anchor frame, in s", fontsize=9)
    axes.set_ylabel("ticks", fontsize=9)
    tidy(axes)
    return png(figure)
