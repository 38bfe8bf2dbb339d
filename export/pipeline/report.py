"""Renders report.html (files, accuracy, cost) from report.json alone, so that it can be rendered again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from edge.artifacts.manifest import LANGUAGE_PAIR, LANGUAGE_WHOLE
from export.pipeline.report_plots import Dot, Line, dot_plot, line_plot
from reporting.page import Cell, Figure, Table, render

Report = Mapping[str, Any]

GRAPH_ORDER = ("vision_encoder", *LANGUAGE_WHOLE, *LANGUAGE_PAIR, "semantic_context", "action_expert")
LAYERS_SHOWN = 16
MARKS = {"PASS": "pass", "WARN": "warn", "FAIL": "fail"}


def report_html(report: Report) -> str:
    """Render the page; same report → same bytes."""
    graphs = {name: report["graphs"][name] for name in GRAPH_ORDER if name in report["graphs"]}
    report = {**report, "graphs": graphs}
    provenance, plan = report["provenance"], report["plan"]
    name = f"{report['model']['name']} for {report['target']}"
    warnings = [
        (graph_name, "; ".join(graph["parity"]["reasons"]))
        for graph_name, graph in graphs.items()
        if graph["parity"]["verdict"] == "WARN"
    ]
    unchecked = [key for key, graph in graphs.items() if not graph["parity"]["shipping_provider_checked"]]
    return render(
        "export",
        title=f"edge-export: {name}",
        name=name,
        verdict=f"{len(graphs)} graphs pass, {len(warnings)} with a warning"
        if warnings
        else f"all {len(graphs)} graphs pass",
        description=provenance["target"]["description"],
        provenance=provenance,
        trained=report["model"]["trained"],
        unchecked=", ".join(unchecked),
        providers=" and ".join(sorted({graphs[key]["session"]["provider"] for key in unchecked})),
        tiles=[
            (size_text(sum(graph["bytes"] for graph in graphs.values())), "all graphs"),
            (f"{sum(graph['params'] for graph in graphs.values()) / 1e6:,.0f} M", "parameters"),
            *_plan_headline(plan),
        ],
        graphs=_graph_table(report),
        gates=_gate_table(report),
        limits=_gate(report, "task"),
        warnings=warnings,
        precisions=[(_precision(key, graph), graph["precision_reason"]) for key, graph in graphs.items()],
        plots=[*_delay_plot(report), *_layer_plots(report)],
        plan=plan,
        schedule=_schedule(plan),
        stages=_stages(plan),
        calibration=provenance["calibration"],
        facts=Table(
            ("what", "value"),
            [
                ("weights", provenance["weights_origin"]),
                ("weights sha256", Cell(provenance["weights_sha256"], "code")),
                ("target", report["target"]),
                ("packages", ", ".join(f"{key} {version}" for key, version in provenance["packages"].items())),
            ],
        ),
    )


def size_text(count: float) -> str:
    """Format bytes: `1.2 GB`, `48 MB`, `3 kB`."""
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= scale:
            return f"{count / scale:.3g} {unit}"
    return f"{count:g} B"


def precision_text(precision: Mapping[str, Any]) -> str:
    """Format the default precision and the number of layer patterns with another one."""
    overrides = precision["overrides"]
    extra = f" + {len(overrides)} exception{'s' if len(overrides) > 1 else ''}" if overrides else ""
    return f"{precision['default']}{extra}"


def _precision(name: str, graph: Mapping[str, Any]) -> str:
    precision = graph["precision"]
    exceptions = ", ".join(f"{pattern} {kind}" for pattern, kind in precision["overrides"].items())
    return f"{name}: {precision['default']}{f', but {exceptions}' if exceptions else ''}"


def _graph_table(report: Report) -> Table:
    rows = []
    for name, graph in report["graphs"].items():
        session = graph["session"]
        threads = "" if session["threads"] is None else f", threads: {session['threads']}"
        rows.append(
            (
                name,
                size_text(graph["bytes"]),
                f"{graph['params'] / 1e6:,.1f} M",
                precision_text(graph["precision"]),
                session["provider"].removesuffix("ExecutionProvider") + threads,
                *_graph_time(report["plan"], name),
            )
        )
    head = ("graph", "size", "parameters", "precision", "runs on", "time", "tag")
    return Table(head, rows, numeric=frozenset({1, 2, 5}))


def _gate_table(report: Report) -> Table:
    rows = []
    for name, graph in report["graphs"].items():
        parity, gate = graph["parity"], _gate(report, name)
        task, top1 = parity["task"], parity["top1"]
        least_top1 = "" if gate.get("top1") is None else f"≥ {100 * gate['top1']:g} %"
        rows.append(
            (
                name,
                Cell(parity["verdict"], MARKS[parity["verdict"]]),
                Cell(f"{parity['cosine']:.6f}", note=f"≥ {gate['min_cosine']:g}"),
                Cell(f"{parity['max_abs']:.2g}", note=f"≤ {gate['max_abs']:g}"),
                Cell(f"{parity['min_difference']:.2g}", note=f"≥ {gate['min_difference']:g}"),
                "–" if top1 is None else Cell(f"{100 * top1:.1f} %", note=least_top1),
                "–" if task is None or task["token_agreement"] is None else f"{100 * task['token_agreement']:.0f} %",
                "–" if task is None else f"{_small(task['waypoint_cm'])} cm",
                "–" if task is None else f"{_small(task['heading_deg'])}°",
                parity["provider"].removesuffix("ExecutionProvider"),
            )
        )
    numbers = ("cosine", "max-abs", "between inputs", "same token", "same text", "waypoint", "heading")
    return Table(("graph", "", *numbers, "ran on"), rows, numeric=frozenset(range(2, 9)))


def _small(value: float) -> str:
    return "< 0.01" if value < 0.01 else f"{value:.2f}"


def _gate(report: Report, name: str) -> Mapping[str, Any]:
    """Return the thresholds of a graph; both graphs of a language model may share theirs."""
    gates = report["provenance"]["target"]["gates"]
    found: Mapping[str, Any] = gates.get(name) or gates[name.partition(".")[0]]
    return found


def _delay_plot(report: Report) -> list[Figure]:
    """Plot the task error over the age of the semantic state, for the graphs with a measured one."""
    lines = [
        Line(
            f"{name} ({precision_text(graph['precision'])})", tuple(map(tuple, graph["parity"]["task"]["by_delay_cm"]))
        )
        for name, graph in report["graphs"].items()
        if graph["parity"]["task"] is not None
    ]
    if not any(line.points for line in lines):
        return []
    x_label, y_label = "age of the semantic state, Δt in s", "worst waypoint error in cm"
    return [
        Figure(
            line_plot(lines, x_label, y_label, _gate(report, "task")["waypoint_cm"]),
            f"{y_label} over {x_label}",
            "Effect of rounding one graph on the planned path, all others exact: the worst moment's mean deviation "
            "over the chunk, by age of the semantic state. Measured on this directory's bytes.",
        )
    ]


def _layer_plots(report: Report) -> list[Figure]:
    """Plot the most sensitive groups of layers, each rounded alone, for every graph that was searched."""
    plots = []
    for name, decision in report["sensitivity"].items():
        rows = [row for row in decision["table"] if row["group"] != "*"]
        if not rows:
            continue
        raised = set(decision["precision"]["overrides"])
        dots = [Dot(row["group"], row["waypoint_cm"], row["group"] in raised) for row in rows[:LAYERS_SHOWN]]
        more = f" of {len(rows)}" if len(rows) > LAYERS_SHOWN else ""
        kept = ", filled: raised to a more exact precision" if raised else ""
        plots.append(
            Figure(
                dot_plot(dots, "worst waypoint error in cm", _gate(report, "task")["waypoint_cm"]),
                f"worst waypoint error in cm: {len(dots)} rows",
                f"{name}: the {len(dots)}{more} most sensitive groups of layers, each rounded alone to "
                f"{rows[0]['precision']}{kept}. Measured on the PyTorch model.",
            )
        )
    return plots


PLAN_ROWS = (
    ("tick_alone_ms", "tick without reasoning", "ms"),
    ("tick_ms", "tick with reasoning", "ms"),
    ("period_ms", "tick period", "ms"),
    ("generation_alone_ms", "generation without control", "ms"),
    ("generation_ms", "generation with control", "ms"),
    ("prompt_tokens", "prompt", "tokens"),
    ("tokens", "largest number of new tokens of a generation", "tokens"),
    ("delay_s", "largest age of the semantic state", "s"),
    ("max_delay_s", "ceiling on that age", "s"),
    ("duty", "largest share of reasoning in the time that control leaves", ""),
    ("average_w", "average power", "W"),
    ("budget_w", "power budget", "W"),
)
ERRORS = {"tick_ms": "tick_error", "generation_ms": "generation_error", "average_w": "average_w_error"}


def _plan_headline(plan: Mapping[str, Any]) -> list[tuple[str, str]]:
    tag = plan["tagged"]
    items = [(f"{plan['tick_ms']:,.0f} ms", f"tick of {plan['period_ms']} ms, {tag}")]
    if plan["generation_ms"] is not None:
        items.append((f"{plan['generation_ms'] / 1e3:,.1f} s", f"generation of {plan['tokens']} tokens, {tag}"))
    if plan["average_w"] is not None and plan["budget_w"] is not None:
        items.append((f"{plan['average_w']:.1f} W", f"average, budget {plan['budget_w']:g} W, modelled"))
    items.append((size_text(plan["memory_bytes"]), "memory needed, modelled"))
    return items


def _graph_time(plan: Mapping[str, Any], graph: str) -> tuple[str, str]:
    """Return the time of a graph's stages, ms, and its tag."""
    stages = [stage for stage in plan["per_graph"].values() if stage["graph"] == graph]
    tags = sorted({stage["tagged"] for stage in stages})
    return " + ".join(f"{stage['ms']:,.3g} ms" for stage in stages), ", ".join(tags)


def _schedule(plan: Mapping[str, Any]) -> Table:
    rows = [
        (what, f"{plan[key]:,.4g} {unit}".strip() + _error(plan.get(ERRORS.get(key, ""))))
        for key, what, unit in PLAN_ROWS
        if plan[key] is not None
    ]
    memory = plan["memory"]
    parts = " + ".join(
        f"{name} {size_text(memory[name])}" for name in ("weights", "caches", "activations", "workspace")
    )
    rows.append((f"memory: {parts}", f"{size_text(plan['memory_bytes'])} of {size_text(memory['available'])}"))
    return Table(("schedule", "value"), rows, numeric=frozenset({1}))


def _stages(plan: Mapping[str, Any]) -> Table:
    rows = [
        (
            name,
            f"{stage['calls']:,}",
            f"{stage['ms']:,.3g} ms" + _error(stage["error"]),
            f"{stage['gflop']:,.3g}",
            size_text(stage["moved_bytes"]),
            stage["bound"],
            stage["tagged"],
            stage["source"],
        )
        for name, stage in plan["per_graph"].items()
    ]
    head = ("stage", "calls", "time", "GFLOP", "bytes moved", "bound by", "tag", "source")
    return Table(head, rows, numeric=frozenset({1, 2, 3, 4}))


def _error(share: float | None) -> str:
    return f" ± {100 * share:.0f} %" if share else ""
