"""`report.html` of a soak: one self-contained page built from the soak's files, with animations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from edge.core.cli import write_whole
from edge.core.stats import percentiles
from reporting import page
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
    parts = [
        "<h1>Soak</h1>",
        _verdict(result),
        "" if result["options"]["trained"] else UNTRAINED,
        page.tiles(_headline(result)),
        "<h2>Budget</h2>",
        _budget(result["budget"]),
    ]
    if any(leg["lives"] for leg in soak.legs):
        delays = [v for leg in soak.legs for life in leg["lives"] for v in life["delay_s"] if v is not None]
        parts += [
            "<h2>Time</h2>",
            page.figure(
                figures.timing(soak.legs),
                "Ticks, delay, generations and jitter over time",
                "Median and maximum of each window (measured). Orange: a fault was active; red lines: the runner "
                "stopped permanently; dotted: a new leg.",
                wide=True,
            ),
            '<div class="pair">',
            page.figure(figures.histograms(soak.legs), "Histograms of ticks and jitter", "All ticks and commands."),
            page.figure(delay_histogram(np.array(delays, float)), "Histogram of the delay", "Δt of all ticks."),
            "</div>",
        ]
    if any(samples):
        parts += [
            "<h2>Processes</h2>",
            page.figure(
                figures.processes(soak.legs, samples),
                "Memory, descriptors and CPU",
                "Sampled once a second; each line is one process from start to end.",
                wide=True,
            ),
        ]
    if any(leg["lives"] for leg in soak.legs):
        parts.append(
            page.figure(
                figures.drift_and_battery(soak.legs),
                "Drift and battery",
                "Drift: the runner's estimate against ground truth, without segments disturbed by injected faults. "
                "The battery is the simulated robot's.",
            )
        )
    parts += [
        _faults(soak.legs),
        _moments(soak),
        *_maps(soak.legs),
        _stops(soak.legs),
        _legs(result),
        _measures(result),
    ]
    write_whole(path, page.document("Soak", "\n".join(part for part in parts if part)))
    return path


UNTRAINED: Final = (
    '<p class="notice"><b>The weights are untrained</b>: the robot moves but does not navigate. Success and '
    "collisions below are meaningless; timing, memory, faults and stops are valid.</p>"
)


def _verdict(result: Mapping[str, Any]) -> str:
    kind = "good" if result["verdict"] == PASS else "bad"
    lines = result["budget"]
    undecided = sum(line["verdict"] not in (PASS, FAIL) for line in lines)
    count = f"{undecided} of {len(lines)} budget lines are undecided"
    texts = {FAIL: "the budget is exceeded", PASS: "the budget is met", UNDECIDED: f"no verdict: {count}"}
    text = texts[result["verdict"]]
    more = f"; {count}" if undecided and result["verdict"] == FAIL else ""
    cut = "" if result["finished"] else f" It ended after {result['elapsed_s']:.0f} of {result['asked_s']:.0f} s."
    return (
        f'<p><span class="verdict {kind}">{result["verdict"]}</span> {text}{more}.{cut}</p>'
        '<p class="quiet">Positions, contacts and success are ground truth, not the robot\'s odometry. '
        "All numbers are measured on this machine unless tagged as modelled.</p>"
    )


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
        (shown("collision_percent", 0), "of tasks with a contact"),
        (shown("tick_ms.p999"), f"tick p99.9 of {measures['tick_ms.p999']['count']}"),
        (shown("missed_percent", 3), "ticks missed"),
        (shown("delay_s.p50", 2), "Δt, median"),
        (shown("bridge_jitter_ms.p999", 2), "bridge jitter p99.9"),
        (shown("memory_slope_mib_per_h.edge-run", 2), "runner's memory slope"),
        (f"{measures['faults_injected']['value']}", "faults injected"),
        (f"{measures['stops']['value']}", "permanent stops"),
    ]


def _budget(lines: Sequence[Mapping[str, Any]]) -> str:
    rows = []
    for line in lines:
        mark = {PASS: '<span class="pass">PASS</span>', FAIL: '<span class="fail">FAIL</span>'}
        limit = f"≤ {line['max']:g}" if "max" in line else f"≥ {line['min']:g}"
        why = page.text_html(line.get("why", ""))
        rows.append(
            (
                mark.get(line["verdict"], "undecided"),
                page.text_html(line["measure"]),
                _value(line["found"]),
                limit,
                str(line["found"]["count"]),
                page.text_html(line["source"]) + (f"<br>{why}" if why else ""),
            )
        )
    return page.table(("", "measure", "found", "limit", "n", "source"), rows, numeric=frozenset({2, 3, 4}))


def _value(found: Mapping[str, Any]) -> str:
    if found["value"] is None:
        return "–"
    span = f" [{found['low']:g}, {found['high']:g}]" if "low" in found and "high" in found else ""
    return f"{found['value']:g}{span} {page.text_html(found['unit'])}".strip()


def _faults(legs: Sequence[Mapping[str, Any]]) -> str:
    kinds: dict[str, list[Mapping[str, Any]]] = {}
    for leg in legs:
        for fault in leg["faults"]:
            kinds.setdefault(fault["name"], []).append(fault)
    if not kinds:
        return ""
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
                page.text_html(name),
                str(len(faults)),
                page.text_html(faults[0]["expect"]),
                page.text_html(watched or "–"),
                f"{len(times)} of {len(faults)}" if watched else "–",
                "–" if points["p50"] is None else f"{points['p50']:.0f}",
                "–" if points["max"] is None else f"{points['max']:.0f}",
            )
        )
    head = ("fault", "n", "expected action", "raises", "raised", "p50 ms", "max ms")
    return (
        "<h2>Faults</h2><p>Times are from the fault's effect on the robot's side to the runner's own record of it; "
        "<code>make faults</code> measures how soon the robot stands.</p>"
        + page.table(head, rows, numeric=frozenset({1, 4, 5, 6}))
    )


def _moments(soak: SoakFolder) -> str:
    found: dict[str, tuple[Moment, Path, int]] = {}
    for leg in soak.legs:
        number = leg["leg"]["number"]
        for moment in read_moments(soak.folder(number)):
            known = found.get(moment.kind)
            if moment.gif and (known is None or moment.rank > known[0].rank):
                found[moment.kind] = (moment, soak.folder(number) / moment.gif, number)
    cards = []
    for moment, path, number in found.values():
        try:
            uri = page.image_uri(path.read_bytes(), "gif")
        except OSError:
            continue  # the file was deleted
        cards.append(
            f'<figure><img src="{uri}" alt="{page.text_html(moment.kind)}"><div class="meta"><b>'
            f"{page.text_html(moment.kind)}</b>, leg {number}: {page.text_html(moment.what, limit=200)}</div></figure>"
        )
    if not cards:
        return ""
    return (
        f'<h2>Worst moments</h2><p>The robot\'s camera in the 5 s before.</p><div class="sheet">{"".join(cards)}</div>'
    )


def _maps(legs: Sequence[Mapping[str, Any]]) -> list[str]:
    parts = ["<h2>Paths</h2>"] if legs else []
    step = max(1, len(legs) // SHOWN_MAPS)
    for leg in legs[::step][:SHOWN_MAPS]:
        name, number = leg["leg"]["stack"]["scene"], leg["leg"]["number"]
        try:
            picture = figures.leg_map(load_scene(name), leg)
        except SceneError:
            parts.append(f"<p>Scene {page.text_html(name)} is not on this machine: no map.</p>")
            continue
        caption = (
            f"Leg {number}, {name}, {leg['elapsed_s']:.0f} s, ended by: {leg['why']}. Blue: true path from its disc; "
            "green ring: goal reached; grey ring: goal not reached; orange: a fault; red: a permanent stop."
        )
        parts.append(page.figure(picture, f"Map of leg {number}", caption, wide=True))
    return parts


def _stops(legs: Sequence[Mapping[str, Any]]) -> str:
    rows = []
    for leg in legs:
        for end in leg["life_ends"]:
            if end["cause"] == "leg":
                continue
            at_s = (end["t_ns"] - leg["begin_ns"]) / 1e9
            why = end["cause"] or f"ended with code {end['code']}"
            cause = page.text_html(end["explained"]) or '<span class="fail">unexplained</span>'
            rows.append((str(leg["leg"]["number"]), f"{at_s:.0f}", cause, page.text_html(why, limit=300)))
    if not rows:
        return ""
    head = ("leg", "s", "attributed to", "the runner's message")
    more = f"<p>The first {SHOWN_STOPS} of {len(rows)}.</p>" if len(rows) > SHOWN_STOPS else ""
    return "<h2>Permanent stops</h2>" + more + page.table(head, rows[:SHOWN_STOPS], numeric=frozenset({0, 1}))


def _legs(result: Mapping[str, Any]) -> str:
    head = ("leg", "scene", "s", "tasks", "reached", "collided", "stops", "faults", "ended by")
    keys = ("number", "scene", "elapsed_s", "tasks", "reached", "collided", "stops", "faults", "why")
    rows = [[page.text_html(str(leg[key]), limit=200) for key in keys] for leg in result["legs"]]
    return "<h2>Legs</h2>" + page.table(head, rows, numeric=frozenset({0, 2, 3, 4, 5, 6, 7}))


def _measures(result: Mapping[str, Any]) -> str:
    rows = [
        (page.text_html(name), _value(found), str(found["count"]), page.text_html(found["tagged"]))
        for name, found in result["measures"].items()
    ]
    return "<h2>All measures</h2>" + page.table(("measure", "found", "n", ""), rows, numeric=frozenset({1, 2}))
