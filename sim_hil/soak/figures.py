"""Figures of the soak report as PNG bytes; the time axis is the soak's, over all legs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from reporting.plot_style import BAD, COMMAND, INK, MUTED, PERSON, TRUTH, legend_above, new_figure, png, tidy
from sim_hil.scene.map import draw_map, draw_mark, draw_path, map_view
from sim_hil.scene.scene import Scene
from sim_hil.soak.trends import SERIES, jitter_ms, offsets_s, soak_times_s, trend, windows
from sim_hil.soak.verdict import MIB, process_lives

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]
Analysis = Mapping[str, Any]
Samples = Sequence[Mapping[str, Any]]

WINDOWS: Final = 150
_COLOURS: Final = {"edge-run": TRUTH, "edge-bridge": COMMAND, "edge-hil": MUTED}
_MAP_PX: Final = 1400
_PATH, _GOAL, _REACHED, _STOP, _FAULT = (31, 111, 139), (107, 119, 133), (44, 140, 74), (179, 38, 30), (230, 140, 20)


def _minutes(leg: Analysis, offset_s: float, stamps_ns: Sequence[int]) -> Array:
    return soak_times_s(leg, offset_s, stamps_ns) / 60


def timing(legs: Sequence[Analysis]) -> bytes:
    """Plot ticks, semantic delay, generations and the bridge's jitter with trends; orange: a fault was active."""
    figure = new_figure(11.0, 8.4)
    axes = figure.subplots(4, 1, sharex=True)
    columns: list[list[tuple[Array, Array]]] = [[], [], [], []]
    for leg, offset_s in zip(legs, offsets_s(legs), strict=True):
        for life in leg["lives"]:
            at = _minutes(leg, offset_s, life["tick_ns"])
            columns[0].append((at, np.array(life["tick_ms"], float)))
            columns[1].append((at, np.array([np.nan if v is None else v for v in life["delay_s"]], float)))
            columns[2].append((_minutes(leg, offset_s, life["ready_ns"]), np.array(life["generation_ms"], float)))
        columns[3].append((_minutes(leg, offset_s, leg["command_ns"]), jitter_ms(leg)))
    labels = ("tick, ms", "Δt, s", "generation, ms", "bridge jitter, ms")
    for each, label, data, name in zip(axes, labels, columns, SERIES, strict=True):
        _over_time(each, data)
        _trend(each, legs, name)
        _mark(each, legs)
        each.set_ylabel(label, fontsize=9)
        each.set_ylim(bottom=0)
        tidy(each)
    axes[-1].set_xlabel("minutes of the soak", fontsize=9)
    return png(figure)


def _trend(axes: Axes, legs: Sequence[Analysis], name: str) -> None:
    """Draw the trend of one of SERIES; its slope with the interval stands in the legend."""
    at_s, values = windows(legs, SERIES[name])
    line = trend(at_s, values)
    if line is not None:
        ends_s = at_s[[0, -1]]
        unit = SERIES[name].unit
        text = f"{name} each minute: {line.per_h:+.2g} [{line.low:+.2g}, {line.high:+.2g}] {unit} per hour"
        axes.plot(ends_s / 60, line.begin + line.per_h * ends_s / 3600, color=TRUTH, linestyle="--", label=text)
    if axes.get_legend_handles_labels()[0]:
        legend_above(axes)


def _over_time(axes: Axes, data: Sequence[tuple[Array, Array]]) -> None:
    """Plot median and maximum per time window, over all runner lives."""
    at = np.concatenate([times for times, _ in data]) if data else np.array([])
    values = np.concatenate([each for _, each in data]) if data else np.array([])
    good = np.isfinite(values)
    at, values = at[good], values[good]
    if not len(at):
        return
    edges = np.linspace(0, at.max() + 1e-9, WINDOWS + 1)
    where = np.digitize(at, edges) - 1
    windows = [(edges[w] + edges[1] / 2, values[where == w]) for w in np.unique(where)]
    middle = [t for t, _ in windows]
    axes.plot(middle, [each.max() for _, each in windows], color=BAD, linewidth=0.9, label="worst of a window")
    axes.plot(middle, [np.median(each) for _, each in windows], color=INK, linewidth=1.2, label="median")


def _mark(axes: Axes, legs: Sequence[Analysis]) -> None:
    for leg, offset_s in zip(legs, offsets_s(legs), strict=True):
        axes.axvline(offset_s / 60, color=MUTED, linewidth=0.8, linestyle=":")
        for fault in leg["faults"]:
            span = _minutes(leg, offset_s, [fault["t_ns"], fault["end_ns"] or fault["t_ns"]])
            axes.axvspan(span[0], max(span[1], span[0] + 0.01), color="#f2b84b", alpha=0.45, linewidth=0)
        for end in leg["life_ends"]:
            if end["cause"] != "leg":
                axes.axvline(_minutes(leg, offset_s, [end["t_ns"]])[0], color=BAD, linewidth=0.8, alpha=0.6)


def processes(legs: Sequence[Analysis], samples: Sequence[Samples]) -> bytes:
    """Plot memory, descriptors and CPU of each process over time."""
    figure = new_figure(11.0, 6.4)
    axes = figure.subplots(3, 1, sharex=True)
    panels = (
        ("rss_bytes", MIB, "memory (RSS), MiB"),
        ("fds", 1.0, "descriptors"),
        ("cpu_percent", 1.0, "CPU, % of a core"),
    )
    for each, (key, unit, label) in zip(axes, panels, strict=True):
        for name, colour in _COLOURS.items():
            shown = name
            for offset_s, leg in zip(offsets_s(legs), samples, strict=True):
                for times, values in process_lives(leg, name, key):
                    at, scaled = (np.array(times) + offset_s) / 60, np.array(values) / unit
                    each.plot(at, scaled, color=colour, linewidth=1.0, label=shown)
                    shown = "_"
        each.set_ylabel(label, fontsize=9)
        each.set_ylim(bottom=0)
        tidy(each)
    legend_above(axes[0])
    axes[-1].set_xlabel("minutes of the soak", fontsize=9)
    return png(figure)


def histograms(legs: Sequence[Analysis]) -> bytes:
    """Plot histograms of ticks and of the bridge's jitter on a logarithmic scale, so that rare values show."""
    figure = new_figure(5.4, 4.2)
    ticks = [v for leg in legs for life in leg["lives"] for v in life["tick_ms"]]
    jitter = [off for leg in legs for off in jitter_ms(leg).tolist()]
    panels = (
        (ticks, "tick: deadline to command sent, ms", TRUTH),
        (jitter, "bridge jitter without stalls, ms", COMMAND),
    )
    for axes, (values, label, colour) in zip(figure.subplots(2, 1), panels, strict=True):
        if values:
            axes.hist(values, bins=80, color=colour, log=True)
        axes.set_xlabel(label, fontsize=9)
        axes.set_ylabel("count", fontsize=9)
        tidy(axes)
    return png(figure)


def drift_and_battery(legs: Sequence[Analysis]) -> bytes:
    """Plot the odometry error over the path of 10 s segments, and the battery charge that the robot reports."""
    figure = new_figure(11.0, 3.1)
    left, right = figure.subplots(1, 2)
    segments = [segment for leg in legs for segment in leg["drift"]]
    if segments:
        left.scatter([path for _, path in segments], [100 * e for e, _ in segments], s=10, color=PERSON, linewidths=0)
    left.set_xlabel("path in 10 s, m (ground truth)", fontsize=9)
    left.set_ylabel("error of the estimate, cm", fontsize=9)
    for leg, offset_s in zip(legs, offsets_s(legs), strict=True):
        for life in leg["lives"]:
            rows = [(t, soc) for t, soc in life["battery"] if soc is not None]
            if rows:
                right.plot(_minutes(leg, offset_s, [t for t, _ in rows]), [soc for _, soc in rows], color=TRUTH)
    right.set_xlabel("minutes of the soak", fontsize=9)
    right.set_ylabel("battery, % (the simulated robot's)", fontsize=9)
    for axes in (left, right):
        axes.set_ylim(bottom=0)
        tidy(axes)
    return png(figure)


def leg_map(scene: Scene, leg: Analysis) -> bytes:
    """Draw a leg's true path; rings: goals (green: reached), orange dots: faults, red dots: stops."""
    span_m = max(scene.floor_max_m[0] - scene.floor_min_m[0], 1.0)
    px_per_m = min(40.0, _MAP_PX / (span_m + 1))
    image, view = draw_map(scene, px_per_m, names=True), map_view(scene, px_per_m)
    truth = leg["truth"]
    draw_path(image, view, [(x, y) for _, x, y, _ in truth], _PATH, 3)
    reached = {task["number"] for task in leg["tasks"] if task["success"]}
    for begin in leg["task_begins"]:
        task = begin["task"]
        colour = _REACHED if task["number"] in reached else _GOAL
        draw_mark(image, view, (task["goal_xy"][0], task["goal_xy"][1]), colour, 0.45, filled=False)
    if truth:
        stamps = np.array([row[0] for row in truth], float)
        marks = [(fault["t_ns"], _FAULT) for fault in leg["faults"]]
        marks += [(end["t_ns"], _STOP) for end in leg["life_ends"] if end["cause"] != "leg"]
        for t_ns, colour in marks:
            _, x, y, _ = truth[int(np.argmin(np.abs(stamps - t_ns)))]
            draw_mark(image, view, (x, y), colour, 0.14)
        draw_mark(image, view, (truth[0][1], truth[0][2]), _PATH, 0.22)
    done, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    if not done:
        raise ValueError(f"map of {scene.name}: cannot be written as PNG")
    return bytes(data.tobytes())
