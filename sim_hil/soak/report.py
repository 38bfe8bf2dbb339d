"""`report.html` of a soak: one self-contained page built from the soak's files, with animations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from edge.core.cli import write_whole
from edge.core.stats import percentiles
from reporting.page import Cell, Figure, Table, mark, render
from reporting.plot_style import delay_histogram
from sim_hil.scene.scene import SceneError, load_scene
from sim_hil.soak import figures
from sim_hil.soak.analysis import Moment, read_moments
from sim_hil.soak.run import SoakFolder
from sim_hil.soak.verdict import FAIL, PASS, UNDECIDED

REPORT: Final = "report.html"
SHOWN_MAPS: Final = 12
SHOWN_STOPS: Final = 40


def write_report(soak: SoakFolder, result: Mapping[str, Any]) -> Path:
    """Write the page into the soak's folder and return its path. Raises OSError."""
    path = soak.path / REPORT
    samples = soak.samples()
    stops = _stops(soak.legs)
    lived = any(leg["lives"] for leg in soak.legs)
    page = render(
        "soak",
        title="Soak",
        passed=result["verdict"] == PASS,
        verdict=result["verdict"],
        text=_verdict_text(result),
        finished=result["finished"],
        elapsed_s=result["elapsed_s"],
        asked_s=result["asked_s"],
        trained=result["options"]["trained"],
        tiles=_headline(result),
        budget=_budget(result["budget"]),
        **(_run_figures(soak.legs) if lived else dict.fromkeys(("timing", "histograms", "drift"))),
        processes=Figure(
            figures.processes(soak.legs, samples),
            "Memory, descriptors and CPU",
            "Sampled once a second; each line is one process from start to end.",
            wide=True,
        )
        if any(samples)
        else None,
        faults=_faults(soak.legs, result["coverage"]),
        moments=_moments(soak),
        maps=_maps(soak.legs),
        stops=Table(("leg", "s", "attributed to", "the runner's message"), stops[:SHOWN_STOPS], frozenset({0, 1})),
        stop_count=len(stops),
        legs=_legs(result),
        measures=Table(
            ("measure", "found", "n", ""),
            [(name, _value(found), str(found["count"]), found["tagged"]) for name, found in result["measures"].items()],
            numeric=frozenset({1, 2}),
        ),
    )
    write_whole(path, page)
    return path


def _run_figures(legs: Sequence[Mapping[str, Any]]) -> dict[str, object]:
    """Return the figures of the lives of the runner."""
    delays = [v for leg in legs for life in leg["lives"] for v in life["delay_s"] if v is not None]
    return {
        "timing": Figure(
            figures.timing(legs),
            "Ticks, delay, generations and jitter over time",
            "Median and maximum of each window (measured). Orange: a fault was active; red lines: the runner "
            "stopped permanently; dotted: a new leg.",
            wide=True,
        ),
        "histograms": [
            Figure(figures.histograms(legs), "Histograms of ticks and jitter", "All ticks and commands."),
            Figure(delay_histogram(np.array(delays, float)), "Histogram of the delay", "Δt of all ticks."),
        ],
        "drift": Figure(
            figures.drift_and_battery(legs),
            "Drift and battery",
            "Drift: the runner's estimate against ground truth, without segments disturbed by injected faults. "
            "The battery is the simulated robot's.",
        ),
    }


def _verdict_text(result: Mapping[str, Any]) -> str:
    lines = result["budget"]
    undecided = sum(line["verdict"] not in (PASS, FAIL) for line in lines)
    count = f"{undecided} of {len(lines)} budget lines are undecided"
    texts = {FAIL: "the budget is exceeded", PASS: "the budget is met", UNDECIDED: f"no verdict: {count}"}
    return texts[result["verdict"]] + (f"; {count}" if undecided and result["verdict"] == FAIL else "")


def _headline(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    measures = result["measures"]

    def shown(name: str, digits: int = 1) -> str:
        value = measures[name]["value"]
        return "–" if value is None else f"{value:.{digits}f} {measures[name]['unit']}".strip()

    legs = result["legs"]
    tasks, reached = sum(leg["tasks"] for leg in legs), sum(leg["reached"] for leg in legs)
    return [
        (f"{result['elapsed_s'] / 60:.1f} min", f"in {len(legs)} legs"),
        (f"{reached} of {tasks}", "tasks reached"),
        (shown("success_ahead_percent", 0), "reached of those whose route began ahead"),
        (shown("collision_percent", 0), "of tasks with a contact"),
        (shown("tick_ms.p999"), f"tick p99.9 of {measures['tick_ms.p999']['count']}"),
        (shown("missed_percent", 3), "ticks missed"),
        (shown("delay_s.p50", 2), "Δt, median"),
        (shown("bridge_jitter_ms.p999", 2), "bridge jitter p99.9"),
        (shown("memory_slope_mib_per_h.edge-run", 2), "runner's memory slope"),
        (f"{measures['faults_injected']['value']}", "faults injected"),
        (f"{measures['stops']['value']}", "permanent stops"),
    ]


def _budget(lines: Sequence[Mapping[str, Any]]) -> Table:
    rows = []
    for line in lines:
        verdict = line["verdict"]
        limit = f"≤ {line['max']:g}" if "max" in line else f"≥ {line['min']:g}"
        rows.append(
            (
                mark(verdict == PASS, verdict) if verdict in (PASS, FAIL) else "undecided",
                line["measure"],
                _value(line["found"]),
                limit,
                str(line["found"]["count"]),
                Cell(line["source"], note=line.get("why", "")),
            )
        )
    return Table(("", "measure", "found", "limit", "n", "source"), rows, numeric=frozenset({2, 3, 4}))


def _value(found: Mapping[str, Any]) -> str:
    if found["value"] is None:
        return "–"
    span = f" [{found['low']:g}, {found['high']:g}]" if "low" in found and "high" in found else ""
    return f"{found['value']:g}{span} {found['unit']}".strip()


def _faults(legs: Sequence[Mapping[str, Any]], coverage: Mapping[str, int]) -> Table:
    kinds: dict[str, list[Mapping[str, Any]]] = {}
    for leg in legs:
        for fault in leg["faults"]:
            kinds.setdefault(fault["name"], []).append(fault)
    rows = []
    for name, faults in sorted(kinds.items()):
        times = [
            (fault["raised_ns"] - (fault["effect_ns"] or fault["t_ns"])) / 1e6
            for fault in faults
            if fault["raised_ns"] is not None
        ]
        points = percentiles(times, "p50", "max")
        watched = faults[0]["fault"]
        rows.append(
            (
                name,
                str(len(faults)),
                faults[0]["expect"],
                watched or "–",
                f"{len(times)} of {len(faults)}" if watched else "–",
                "–" if points["p50"] is None else f"{points['p50']:.0f}",
                "–" if points["max"] is None else f"{points['max']:.0f}",
            )
        )
    rows += [(name, "0", "–", "–", "–", "–", "–") for name, count in coverage.items() if not count]
    head = ("fault", "n", "expected action", "raises", "raised", "p50 ms", "max ms")
    return Table(head, rows, numeric=frozenset({1, 4, 5, 6}))


def _moments(soak: SoakFolder) -> list[dict[str, object]]:
    """Return the worst moment of each kind that has an animation."""
    found: dict[str, tuple[Moment, Path, int]] = {}
    for leg in soak.legs:
        number = leg["leg"]["number"]
        for moment in read_moments(soak.folder(number)):
            known = found.get(moment.kind)
            if moment.gif and (known is None or moment.rank > known[0].rank):
                found[moment.kind] = (moment, soak.folder(number) / moment.gif, number)
    shown: list[dict[str, object]] = []
    for moment, path, number in found.values():
        try:
            gif = path.read_bytes()
        except OSError:
            continue  # the file was deleted
        shown.append({"kind": moment.kind, "gif": gif, "leg": number, "text": moment.what})
    return shown


def _maps(legs: Sequence[Mapping[str, Any]]) -> list[Figure | str]:
    """Return the maps of some legs, or the name of a scene that is not on this machine."""
    maps: list[Figure | str] = []
    step = max(1, len(legs) // SHOWN_MAPS)
    for leg in legs[::step][:SHOWN_MAPS]:
        name, number = leg["leg"]["stack"]["scene"], leg["leg"]["number"]
        try:
            picture = figures.leg_map(load_scene(name), leg)
        except SceneError:
            maps.append(name)
            continue
        caption = (
            f"Leg {number}, {name}, {leg['elapsed_s']:.0f} s, ended by: {leg['why']}. Blue: true path from its disc; "
            "green ring: goal reached; grey ring: goal not reached; orange: a fault; red: a permanent stop."
        )
        maps.append(Figure(picture, f"Map of leg {number}", caption, wide=True))
    return maps


def _stops(legs: Sequence[Mapping[str, Any]]) -> list[tuple[str | Cell, ...]]:
    rows: list[tuple[str | Cell, ...]] = []
    for leg in legs:
        for end in leg["life_ends"]:
            if end["cause"] == "leg":
                continue
            at_s = (end["t_ns"] - leg["begin_ns"]) / 1e9
            why = end["cause"] or f"ended with code {end['code']}"
            cause = end["explained"] or mark(False, "unexplained")
            rows.append((str(leg["leg"]["number"]), f"{at_s:.0f}", cause, why))
    return rows


def _legs(result: Mapping[str, Any]) -> Table:
    head = ("leg", "scene", "s", "tasks", "reached", "collided", "stops", "faults", "ended by", "machine")
    keys = ("number", "scene", "elapsed_s", "tasks", "reached", "collided", "stops", "faults", "why", "machine")
    rows = [[str(leg[key]) for key in keys] for leg in result["legs"]]
    return Table(head, rows, numeric=frozenset({0, 2, 3, 4, 5, 6, 7}))
