"""`report.html` of a benchmark run: one self-contained page built from the run's files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.core.cli import write_whole
from reporting.page import Cell, Figure, Table, mark, render
from reporting.plot_style import BAD, GOOD, INK, MUTED, TRUTH, delay_histogram, legend_above, new_figure, png, tidy
from sim_hil.benchmark.conditions.conditions import Conditions
from sim_hil.benchmark.results.causes import cause_tables, read_causes
from sim_hil.benchmark.results.failures import cause_table, failure_sheet, failures
from sim_hil.benchmark.results.record import EpisodeResult, read_log
from sim_hil.benchmark.results.store import EPISODES, VIDEOS, ResultStore
from sim_hil.benchmark.results.summary import METRICS, group_names, grouped_by, interval_of
from sim_hil.benchmark.results.video import last_picture
from sim_hil.benchmark.suite.strata import is_fresh
from sim_hil.layouts.scenes import open_scene
from sim_hil.scene.map import draw_map, draw_mark, draw_path, map_view
from sim_hil.scene.scene import Scene, SceneError

REPORT = "report.html"
SHOWN_TEXTS = 12
SHOWN_ENDINGS = 12
SHOWN_HITS = 4
_CARD_PX = 640
_HEADLINE = {
    "sr": ("success rate", "%"),
    "spl": ("SPL", "%"),
    "ne_m": ("navigation error", "m"),
    "cr": ("collisions", "%"),
}

Path2 = NDArray[np.float64]

_OF_EPISODES = (
    "error_and_time", "delays", "maps", "endings", "failure_sheet", "failure_cards", "texts", "episodes",
)  # fmt: skip
"""Values of the page that show single episodes."""
_TITLES = {
    "scene": "scene",
    "crowd": "people in the scene",
    "robot": "robot",
    "length": "length of the path",
    "turns": "turns",
}
_MAP_PX = 1400
_SUCCESS, _COLLIDED, _FAILED = (44, 140, 74), (230, 140, 20), (179, 38, 30)
_START, _GOAL = (31, 111, 139), (44, 140, 74)


def write_report(store: ResultStore, summary: Mapping[str, object], title: str) -> Path:
    """Write the page into the run's directory and return its path. Raises OSError."""
    path = store.directory / REPORT
    results = sorted(store.results, key=lambda result: result.id)
    conditions = Conditions.of_json(store.config["conditions"])
    failed = [(run.id, str(run.attempts), run.why) for run in store.failed]
    page = render(
        "benchmark",
        title=title,
        conditions=conditions.describe(),
        suite=store.config["suite"],
        finished=len(results),
        requested=max(len(results), int(str(summary.get("asked", len(store.config["episodes"]))))),
        untrained=not store.config.get("trained", True),
        tiles=_headline(summary),
        failed=Table(("episode", "attempts", "why"), failed, numeric=frozenset({1})),
        **(_results(store, results, summary, conditions) if results else {}),
    )
    write_whole(path, page)
    return path


def _results(
    store: ResultStore, results: Sequence[EpisodeResult], summary: Mapping[str, Any], conditions: Conditions
) -> dict[str, object]:
    """Return the values of the part of the page about finished episodes."""
    if is_fresh(store.config["suite"]):
        return _strata(store, results, summary, conditions)
    logs = {result.id: _log(store.directory, result.id) for result in results}
    delays = np.array([d for log in logs.values() if log for d in log["columns"]["delay_s"] if d is not None], float)
    caption = "Age of the semantic state in every control period that had one."
    return {
        **_rates(results, summary),
        "error_and_time": Figure(
            error_and_time(results, width_in=5.4 if len(delays) else 11.0),
            "Distance to the goal against time used", "One point per episode.", wide=not len(delays),
        ),
        "delays": Figure(delay_histogram(delays), "Histogram of the delay", caption) if len(delays) else None,
        "maps": _maps(results, logs),
        "endings": _endings(store.directory, results),
        **_failures(store.directory, results),
        "texts": _texts(results, logs),
        "episodes": _episode_table(store.directory, results),
        "facts": _fact_table(store.config, conditions),
    }  # fmt: skip


def _rates(results: Sequence[EpisodeResult], summary: Mapping[str, Any]) -> dict[str, object]:
    """Return the values of the part of the page about rates by group."""
    caption = "The number of episodes is below each name."
    figure = Figure(rates(results), "Bars of success and collision rate", caption, wide=True)
    return {"rates": figure, "groups": _group_table(summary)}


def _strata(
    store: ResultStore, results: Sequence[EpisodeResult], summary: Mapping[str, Any], conditions: Conditions
) -> dict[str, object]:
    """Return the values of a page without episodes: rates and counts of causes by stratum."""
    causes = read_causes(store.directory, results)
    by_group, reasons = cause_tables(results, causes)
    failed = sum(not result.success or result.collided for result in results)
    return {
        **_rates(results, summary),
        "explained": f"{len(causes)} of {failed} failed episodes",
        "causes": by_group if causes else None,
        "reasons": reasons,
        **dict.fromkeys(_OF_EPISODES),
        "facts": _fact_table(store.config, conditions),
    }


def _failures(directory: Path, results: Sequence[EpisodeResult]) -> dict[str, object]:
    """Return the values of the part of the page about failures; empty without kept flight logs."""
    found = failures(directory, results)
    failed = sum(not result.success or result.collided for result in results)
    return {
        "explained": f"{len(found)} of {failed} failed episodes",
        "causes": cause_table(found) if found else None,
        "reasons": None,
        "failure_sheet": failure_sheet(found),
        "failure_cards": [failure.card for failure in found],
    }


def _hits(result: EpisodeResult) -> str:
    """Return the first few labels of what the robot hit."""
    more = len(result.collisions) - SHOWN_HITS
    return ", ".join([*result.collisions[:SHOWN_HITS], *([f"{more} more"] if more > 0 else [])])


def _log(directory: Path, episode_id: str) -> dict[str, Any] | None:
    try:
        return read_log(directory / EPISODES / f"{episode_id}.json")
    except (OSError, ValueError):
        return None  # results do not depend on it; the map's caption gives the number of paths


def _headline(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    tiles = []
    for name, (label, unit) in _HEADLINE.items():
        value, interval = summary[name], summary[f"{name}_ci95"]
        shown = "none" if value is None else f"{value:.1f} {unit}"
        span = "" if interval is None else f", 95 %: {interval[0]:.1f} to {interval[1]:.1f}"
        tiles.append((shown, label + span))
    return [*tiles, (str(summary["episodes"]), "episodes")]


def _group_table(summary: Mapping[str, Any]) -> Table:
    rows = [
        (
            f"{group.removeprefix('by_')}: {key}",
            str(means["episodes"]),
            *(_with_interval(means, name) for name in METRICS),
        )
        for group in summary
        if group.startswith("by_")
        for key, means in summary[group].items()
    ]
    head = ("group", "episodes", "SR %", "SPL %", "NE m", "CR %")
    return Table(head, rows, numeric=frozenset({1, 2, 3, 4, 5}))


def _with_interval(means: Mapping[str, Any], name: str) -> str:
    interval = means[f"{name}_ci95"]
    span = "" if interval is None else f" [{interval[0]:.1f}, {interval[1]:.1f}]"
    return f"{means[name]:.1f}{span}"


def _maps(results: Sequence[EpisodeResult], logs: Mapping[str, dict[str, Any] | None]) -> list[Figure | str]:
    """Return the map of each scene, or the name of a scene that is not on this machine."""
    parts: list[Figure | str] = []
    for name, members in grouped_by(results, "scene"):
        shown = [(result, log) for result in members if (log := logs[result.id]) is not None]
        try:
            scene = open_scene(name)
        except SceneError:
            parts.append(name)
            continue
        ended, logged = [result for result, _ in shown], [log for _, log in shown]
        goals = [log["goal_xy"] for log in logged]
        picture = scene_map(scene, ended, [_path(log) for log in logged], goals)
        caption = (
            f"{name}: {len(shown)} of {len(members)} episodes. Blue: start; green ring: goal. Paths: green reached "
            "without a collision, orange reached with one, red not reached."
        )
        parts.append(Figure(picture, f"Map of {name} with the paths", caption, wide=True))
    return parts


def _path(log: Mapping[str, Any]) -> NDArray[np.float64]:
    columns = log["columns"]
    return np.column_stack([np.array(columns["x_m"], float), np.array(columns["y_m"], float)])


def _endings(directory: Path, results: Sequence[EpisodeResult]) -> list[dict[str, object]]:
    """Return the last frames of some videos; failed episodes come first, then those with collisions."""
    endings: list[dict[str, object]] = []
    for result in sorted(results, key=lambda result: (result.success, not result.collided)):
        path = directory / VIDEOS / f"{result.id}.mp4"
        picture = last_picture(path, _CARD_PX) if len(endings) < SHOWN_ENDINGS and path.is_file() else None
        if picture is None:
            continue
        hit = f", collided with {_hits(result)}" if result.collided else ""
        text = f"{result.end} after {result.time_s:.0f} s, {result.ne_m:.1f} m from the goal{hit}"
        endings.append({"id": result.id, "jpeg": picture, "video": f"{VIDEOS}/{path.name}", "text": text})
    return endings


def _texts(results: Sequence[EpisodeResult], logs: Mapping[str, dict[str, Any] | None]) -> list[tuple[str, str]]:
    """Return facts and text of the middle generation of some episodes."""
    texts = []
    for result in results:
        log = logs[result.id]
        if log is None or not log["generations"]:
            continue
        generation = log["generations"][len(log["generations"]) // 2]
        meta = (
            f"{result.id} · generation {generation['generation']} · anchor {generation['anchor_s']:.1f} s · "
            f"Δt {generation['released_s'] - generation['anchor_s']:.1f} s at release"
        )
        texts.append((meta, str(generation.get("text", ""))))
    return texts[:: max(1, len(texts) // SHOWN_TEXTS)][:SHOWN_TEXTS]


def _episode_table(directory: Path, results: Sequence[EpisodeResult]) -> Table:
    rows = []
    for r in results:
        video = f"{VIDEOS}/{r.id}.mp4"
        name = Cell(r.id, link=video) if (directory / video).is_file() else r.id
        delay = "" if r.delay_s is None else f"{r.delay_s['mean']:.1f}"
        numbers = (f"{r.ne_m:.1f}", f"{r.spl:.0f}", f"{r.path_m:.1f}", f"{r.shortest_m:.1f}", f"{r.time_s:.0f}", delay)
        end = mark(r.success, "reached" if r.success else r.end)
        rows.append((name, r.scene, r.robot, str(r.people), end, _hits(r), *numbers))
    head = (
        "episode", "scene", "robot", "people", "end", "collided with", "NE m", "SPL %", "path m", "shortest m",
        "time s", "mean Δt s",
    )  # fmt: skip
    return Table(head, rows, numeric=frozenset({3, *range(6, 12)}))


def _fact_table(config: Mapping[str, Any], conditions: Conditions) -> Table:
    return Table(("what", "value"), [(key, str(value)) for key, value in _facts(config, conditions)])


def _facts(config: Mapping[str, Any], conditions: Conditions) -> list[tuple[str, object]]:
    latency = conditions.latency
    facts: list[tuple[str, object]] = [("conditions", conditions.describe())]
    if latency is not None:
        count = len(latency.generation_s)
        facts.append(("latency", f"{latency.name}, mean {latency.mean_s:.2f} s of {count} ({latency.source})"))
    facts += [(f"version of {name}", value) for name, value in config["versions"].items()]
    return [*facts, ("suite, SHA-256 of its episodes", config["suite_sha256"])]


def rates(results: Sequence[EpisodeResult]) -> bytes:
    """Plot success and collision rate with 95 % intervals, by scene, crowd, robot and stratum."""
    groups = [(name, grouped_by(results, name)) for name in group_names(results)]
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
