"""`report.html` of a benchmark run: one self-contained page built from the run's files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge.core.cli import write_whole
from reporting.page import Cell, Figure, Table, mark, render
from reporting.plot_style import delay_histogram
from sim_hil.benchmark.conditions.conditions import Conditions
from sim_hil.benchmark.results import report_figures
from sim_hil.benchmark.results.episode_log import read_log
from sim_hil.benchmark.results.record import EpisodeResult
from sim_hil.benchmark.results.store import EPISODES, VIDEOS, ResultStore
from sim_hil.benchmark.results.summary import METRICS, grouped_by
from sim_hil.benchmark.results.video import last_picture
from sim_hil.scene.scene import SceneError, load_scene

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
        requested=len(store.config["episodes"]),
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
    logs = {result.id: _log(store.directory, result.id) for result in results}
    delays = np.array([d for log in logs.values() if log for d in log["columns"]["delay_s"] if d is not None], float)
    caption = "Age of the semantic state in every control period that had one."
    return {
        "rates": Figure(
            report_figures.rates(results), "Bars of success and collision rate",
            "The number of episodes is below each name.", wide=True,
        ),
        "groups": _group_table(summary),
        "error_and_time": Figure(
            report_figures.error_and_time(results, width_in=5.4 if len(delays) else 11.0),
            "Distance to the goal against time used", "One point per episode.", wide=not len(delays),
        ),
        "delays": Figure(delay_histogram(delays), "Histogram of the delay", caption) if len(delays) else None,
        "maps": _maps(results, logs),
        "endings": _endings(store.directory, results),
        "texts": _texts(results, logs),
        "episodes": _episode_table(store.directory, results),
        "facts": Table(("what", "value"), [(key, str(value)) for key, value in _facts(store.config, conditions)]),
    }  # fmt: skip


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
        for group in ("by_scene", "by_crowd", "by_robot")
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
            scene = load_scene(name)
        except SceneError:
            parts.append(name)
            continue
        ended, logged = [result for result, _ in shown], [log for _, log in shown]
        goals = [log["goal_xy"] for log in logged]
        picture = report_figures.scene_map(scene, ended, [_path(log) for log in logged], goals)
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


def _facts(config: Mapping[str, Any], conditions: Conditions) -> list[tuple[str, object]]:
    latency = conditions.latency
    facts: list[tuple[str, object]] = [("conditions", conditions.describe())]
    if latency is not None:
        count = len(latency.generation_s)
        facts.append(("latency", f"{latency.name}, mean {latency.mean_s:.2f} s of {count} ({latency.source})"))
    facts += [(f"version of {name}", value) for name, value in config["versions"].items()]
    return [*facts, ("suite, SHA-256 of its episodes", config["suite_sha256"])]
