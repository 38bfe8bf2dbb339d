"""Histograms of the reports."""

from __future__ import annotations

import numpy as np

from reporting.plot_style import PERSON, draw_histogram, new_figure


def test_as_many_values_of_each_tenth_of_a_second_fill_bins_of_equal_height() -> None:
    """Δt is a multiple of the tick's period, which no floating-point number is exactly."""
    delays_s = np.concatenate([np.arange(14, 28) * 0.1, np.arange(14, 28) / 10, np.arange(14, 28) * 0.1 + 1e-9])
    axes = new_figure(5.4, 3.1).add_subplot()
    draw_histogram(axes, delays_s, 0.1, PERSON, "s", 2)
    heights = [round(bar.get_height()) for bar in axes.patches]
    assert heights[:14] == [0] * 14 and heights[14:28] == [3] * 14 and sum(heights) == 3 * 14
