"""Pictures of the report: RunData → PNG bytes, with matplotlib's object interface (no global state)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke
from matplotlib.ticker import StrMethodFormatter

from reporting.plot_style import (
    BAD,
    COMMAND,
    GOOD,
    INK,
    MUTED,
    PERSON,
    TRUTH,
    WALL,
    draw_histogram,
    legend_above,
    new_figure,
    png,
    tidy,
)
from tools.report.run_data import Array, Record, RunData, odometry_in_world

OVERHEAD_KINDS = frozenset({"light", "sign"})  # not on the floor
FLAT_KINDS = frozenset({"door", "window", "notice_board"})  # on a wall
_DEADLINE_MS = 100.0


def top_down(data: RunData) -> bytes:
    """Draw the scene from above: path among walls, objects and people; the path's colour is time."""
    corners = np.concatenate([np.asarray(f["polygon"], float) for f in data.trace.scene["footprints"]])
    corners = np.concatenate([corners, data.trace.pose[:, :2]])
    return _seen_from_above(data, corners.min(axis=0) - 0.5, corners.max(axis=0) + 0.5)


def close_up(data: RunData) -> bytes | None:
    """Draw the scene around the path; None if the path fills most of the whole picture."""
    scene = np.concatenate([np.asarray(f["polygon"], float) for f in data.trace.scene["footprints"]])
    low, high = data.trace.pose[:, :2].min(axis=0) - 1.5, data.trace.pose[:, :2].max(axis=0) + 1.5
    # Wider than tall, because the page is wide, but not a strip.
    lack = np.maximum(0.0, np.array([2.2, 0.35]) * (high - low)[::-1] - (high - low)) / 2
    low = np.maximum(low - lack, scene.min(axis=0) - 0.4)
    high = np.minimum(high + lack, scene.max(axis=0) + 0.4)
    if np.prod(high - low) > 0.5 * np.prod(np.ptp(scene, axis=0)):
        return None
    return _seen_from_above(data, low, high)


def _seen_from_above(data: RunData, low: Array, high: Array) -> bytes:
    size = high - low
    width_in = 11.0
    figure = new_figure(width_in, float(np.clip(width_in * size[1] / size[0] + 1.3, 3.0, 12.0)))
    axes = figure.add_subplot()
    _draw_footprints(axes, data.trace.scene["footprints"], points_per_m=0.92 * width_in * 72 / size[0])
    _draw_people(axes, data.trace.people)
    path = _draw_path(axes, data.trace.pose, (data.trace.pose_ns - data.log.start_ns) / 1e9)
    _, odometry = odometry_in_world(data)
    axes.plot(odometry[:, 0], odometry[:, 1], color=COMMAND, linewidth=1.6, linestyle=(0, (4, 3)), zorder=6)
    _draw_start_goal(axes, data.trace.scene, data.trace.pose[-1])
    axes.set_aspect("equal")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_xlabel("x in m", fontsize=9)
    axes.set_ylabel("y in m", fontsize=9)
    tidy(axes)
    bar = figure.colorbar(path, ax=axes, location="bottom", aspect=60, shrink=0.6, pad=0.02)
    bar.set_label("true path, coloured by time since the first control tick in s", fontsize=8, color=INK)
    bar.ax.tick_params(labelsize=8)
    figure.legend(handles=_top_down_legend(), loc="outside upper center", fontsize=8, frameon=False, ncols=7)
    return png(figure)


def _top_down_legend() -> list[Line2D]:
    return [
        Line2D([], [], color=TRUTH, linewidth=3, label="true path"),
        Line2D([], [], color=COMMAND, linestyle=(0, (4, 2)), label="odometry, aligned at the first tick"),
        Line2D([], [], color=PERSON, linewidth=1.2, label="people (dot: at the end)"),
        Line2D([], [], color=GOOD, marker="o", linestyle="", markersize=8, label="start"),
        Line2D([], [], color="#b8860b", marker="*", linestyle="", markersize=11, label="goal"),
        Line2D([], [], color=INK, marker="X", linestyle="", markersize=8, label="end"),
    ]


def _draw_footprints(axes: Axes, footprints: Sequence[Record], points_per_m: float) -> None:
    middle = np.mean(np.concatenate([np.asarray(f["polygon"], float) for f in footprints]), axis=0)
    label_end_m = {1: -np.inf, -1: -np.inf}  # end of the last label on each side
    for footprint in sorted(footprints, key=lambda f: float(np.mean([x for x, _ in f["polygon"]]))):
        polygon, kind = np.asarray(footprint["polygon"], float), footprint["kind"]
        if kind in OVERHEAD_KINDS:
            continue
        colour = WALL if kind == "wall" else "#9c6b3f" if kind in FLAT_KINDS else "#d8c9a8"
        axes.add_patch(Polygon(polygon, closed=True, facecolor=colour, edgecolor=INK, linewidth=0.6))
        if kind == "wall":
            continue
        text, centre = str(footprint["label"]), polygon.mean(axis=0)
        half_m = len(text) * 2.0 / points_per_m
        up = 1 if centre[1] < middle[1] else -1
        if kind in FLAT_KINDS:
            _label_on_wall(axes, text, polygon, middle)
            continue
        above_neighbour = centre[0] - half_m < label_end_m[up]
        label_end_m[up] = centre[0] + half_m
        at = (centre[0], polygon[:, 1].max() if up > 0 else polygon[:, 1].min())
        _annotate(axes, text, at, (0, up * (12 if above_neighbour else 3)), 7, INK)


def _label_on_wall(axes: Axes, text: str, polygon: Array, middle: Array) -> None:
    """Label doors and boards beyond their wall, so that the room stays free."""
    centre, size = polygon.mean(axis=0), np.ptp(polygon, axis=0)
    if size[1] > size[0]:  # on an end wall, inside, where there is more space
        inside = 1 if centre[0] < middle[0] else -1
        _annotate(axes, text, (centre[0], centre[1]), (inside * 4, 0), 6, MUTED)
        return
    beyond = 1 if centre[1] > middle[1] else -1
    _annotate(axes, text, (centre[0], centre[1]), (0, beyond * 10), 6, MUTED)


def _annotate(
    axes: Axes, text: str, at: tuple[float, float], offset_pt: tuple[int, int], size_pt: int, colour: str
) -> None:
    dx, dy = offset_pt
    axes.annotate(
        text,
        at,
        xytext=offset_pt,
        textcoords="offset points",
        ha="center" if dx == 0 else "left" if dx > 0 else "right",
        va="center" if dy == 0 else "bottom" if dy > 0 else "top",
        fontsize=size_pt,
        color=colour,
        zorder=10,
        path_effects=[withStroke(linewidth=2, foreground="white")],
        annotation_clip=True,
    )


def _draw_people(axes: Axes, people: Sequence[Array]) -> None:
    if not people or not len(people[0]):
        return
    tracks = np.stack([poses for poses in people if len(poses) == len(people[0])])
    for person in range(tracks.shape[1]):
        axes.plot(tracks[:, person, 0], tracks[:, person, 1], color=PERSON, linewidth=1.2, alpha=0.55, zorder=3)
        axes.plot(*tracks[-1, person, :2], color=PERSON, marker="o", markersize=6, alpha=0.9, zorder=3)


def _draw_path(axes: Axes, pose: Array, time_s: Array) -> LineCollection:
    points = pose[:, :2]
    path = LineCollection(
        np.stack([points[:-1], points[1:]], axis=1).tolist(), cmap="viridis", linewidth=4.0, zorder=5, capstyle="round"
    )
    path.set_array(time_s[:-1])
    axes.add_collection(path)
    return path


def _draw_start_goal(axes: Axes, scene: Record, end: Array) -> None:
    x_m, y_m, theta = scene["start"]
    axes.plot(x_m, y_m, marker="o", color=GOOD, markersize=9, markeredgecolor="white", zorder=8)
    axes.plot(*scene["goal"], marker="*", color="#b8860b", markersize=15, markeredgecolor="white", zorder=8)
    axes.plot(end[0], end[1], marker="X", color=INK, markersize=9, markeredgecolor="white", zorder=9)
    axes.annotate(
        "",
        (x_m + 0.6 * np.cos(theta), y_m + 0.6 * np.sin(theta)),
        (x_m, y_m),
        arrowprops={"arrowstyle": "->", "color": GOOD, "lw": 1.6},
        zorder=8,
    )


def tick_histogram(durations_ms: Array) -> bytes:
    """Draw the duration of every control tick, ms; counts on a log scale, so that one outlier is visible."""
    figure = new_figure(5.4, 3.1)
    axes = figure.add_subplot()
    right = max(_DEADLINE_MS * 1.1, float(durations_ms.max()) * 1.05)
    axes.axvline(_DEADLINE_MS, color=BAD, linewidth=1.6, label="deadline 100 ms")
    draw_histogram(axes, durations_ms, max(1.0, right / 200), TRUTH, "ms", 1)
    axes.set_xlim(0, right)
    axes.set_xlabel("tick duration in ms", fontsize=9)
    axes.set_yscale("log")
    axes.set_ylim(bottom=0.7)
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.set_ylabel("ticks (log)", fontsize=9)
    tidy(axes)
    return png(figure)


def time_line(data: RunData) -> bytes:
    """Draw Δt, forward speed and turn rate over the run; ticks that did not drive are shaded."""
    figure = new_figure(11.0, 6.2)
    delay, speed, turn = figure.subplots(3, 1, sharex=True)
    ticks = data.log.ticks
    tick_s = (np.array([t["now_ns"] for t in ticks], np.int64) - data.log.start_ns) / 1e9
    pose_s = (data.trace.pose_ns - data.log.start_ns) / 1e9
    driven = (pose_s >= tick_s[0] - 1) & (pose_s <= tick_s[-1] + 2)
    command = np.array([t["command"] for t in ticks], float)

    delay.plot(tick_s, [np.nan if t["delay_s"] is None else t["delay_s"] for t in ticks], color=PERSON, linewidth=1.3)
    delay.set_ylabel("Δt in s", fontsize=9)
    delay.set_ylim(bottom=0)
    for axes, true, axis, unit in ((speed, 0, 0, "forward, m/s"), (turn, 2, 2, "turn rate, rad/s")):
        velocity = data.trace.velocity[driven, true]
        axes.plot(pose_s[driven], velocity, color=TRUTH, linewidth=0.6, alpha=0.4, label="true")
        axes.plot(pose_s[driven], _smooth(velocity), color=TRUTH, linewidth=1.4, label="true, mean of 1 s")
        axes.step(tick_s, command[:, axis], where="post", color=COMMAND, linewidth=1.2, label="commanded")
        axes.set_ylabel(unit, fontsize=9)
        legend_above(axes)
    turn.set_xlabel("time since the first control tick in s", fontsize=9)
    for axes in (delay, speed, turn):
        for start_s, end_s in _spans(tick_s, [t["reason"] != "ok" for t in ticks]):
            axes.axvspan(start_s, end_s, color="#f3e3c3", alpha=0.7, linewidth=0)
        tidy(axes)
    return png(figure)


def _smooth(values: Array, width: int = 10) -> Array:
    """Compute the moving mean over `width` samples (1 s of poses), because a trotting body sways with every step."""
    window = np.ones(width)
    return np.convolve(values, window, "same") / np.convolve(np.ones_like(values), window, "same")


def _spans(time_s: Array, flags: Sequence[bool]) -> list[tuple[float, float]]:
    """Return runs of True as (start, end) times."""
    spans: list[tuple[float, float]] = []
    begin: float | None = None
    for at_s, flag in zip(time_s, flags, strict=True):
        if flag and begin is None:
            begin = float(at_s)
        if not flag and begin is not None:
            spans.append((begin, float(at_s)))
            begin = None
    if begin is not None:
        spans.append((begin, float(time_s[-1])))
    return spans
