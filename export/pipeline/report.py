"""report.html: what was built, how exact it is, what it costs; made from report.json alone, so it can be made again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from edge.artifacts.manifest import LANGUAGE_PAIR, LANGUAGE_WHOLE
from export.pipeline.report_plots import Dot, Line, dot_plot, line_plot
from reporting.page import document, table, text_html, tiles

Report = Mapping[str, Any]

GRAPH_ORDER = ("vision_encoder", *LANGUAGE_WHOLE, *LANGUAGE_PAIR, "semantic_context", "action_expert")
LAYERS_SHOWN = 16
MARKS = {"PASS": "pass", "WARN": "warn", "FAIL": "fail"}


def report_html(report: Report) -> str:
    """The whole page; same report → same bytes."""
    order = [name for name in GRAPH_ORDER if name in report["graphs"]]
    report = {**report, "graphs": {name: report["graphs"][name] for name in order}}
    target = report["provenance"]["target"]
    title = f"{report['model']['name']} for {report['target']}"
    parts = [
        f"<h1>{text_html(title)}</h1>",
        _headline_verdict(report),
        f'<p class="quiet">{text_html(target["description"])}. Weights: '
        f"{text_html(report['provenance']['weights_origin'])}.</p>",
        _untrained_notice(report),
        _unchecked_notice(report),
        tiles(_headline(report)),
        "<h2>Graphs</h2>",
        _graph_table(report),
        "<h2>Is it the same model?</h2>",
        '<p class="quiet">Every graph ran in ONNX Runtime from the very bytes in this directory and is compared with '
        "PyTorch in fp32. “Between inputs” is the control: the smallest difference between the outputs of two "
        "different inputs, so that a graph that ignores its input cannot pass.</p>",
        _gate_table(report),
        _warnings(report),
        "<h2>Why these precisions</h2>",
        _reasons(report),
        _sensitivity(report),
        "<h2>Plan</h2>",
        _plan(report["plan"]),
        "<h2>Calibration</h2>",
        _calibration(report["provenance"]["calibration"]),
        "<h2>Provenance</h2>",
        _provenance(report),
    ]
    return document(f"edge-export: {title}", "\n".join(part for part in parts if part))


def size_text(count: float) -> str:
    """Bytes in the unit that fits: `1.2 GB`, `48 MB`, `3 kB`."""
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= scale:
            return f"{count / scale:.3g} {unit}"
    return f"{count:g} B"


def precision_text(precision: Mapping[str, Any]) -> str:
    """Default precision and how many layer patterns differ from it."""
    overrides = precision["overrides"]
    extra = f" + {len(overrides)} exception{'s' if len(overrides) > 1 else ''}" if overrides else ""
    return f"{precision['default']}{extra}"


def _headline_verdict(report: Report) -> str:
    levels = [graph["parity"]["verdict"] for graph in report["graphs"].values()]
    warned = levels.count("WARN")
    words = f"all {len(levels)} graphs pass" if not warned else f"{len(levels)} graphs pass, {warned} with a warning"
    return f'<p><span class="verdict good">{words}</span></p>'


def _untrained_notice(report: Report) -> str:
    if report["model"]["trained"]:
        return ""
    return (
        '<p class="notice"><b>The weights are untrained</b> (initial weights): a robot with them moves, it does not '
        "navigate. Sizes and times are those of a trained model; what rounding does to one has to be measured anew.</p>"
    )


def _unchecked_notice(report: Report) -> str:
    unchecked = [name for name, graph in report["graphs"].items() if not graph["parity"]["shipping_provider_checked"]]
    if not unchecked:
        return ""
    providers = sorted({report["graphs"][name]["session"]["provider"] for name in unchecked})
    return (
        f'<p class="notice"><b>The device still has to repeat this check.</b> These graphs are made for '
        f"{text_html(' and '.join(providers))}, which this machine does not have; the exact bytes were run on "
        f"the CPU instead: {text_html(', '.join(unchecked))}. On the device: <code>edge-export verify DIR</code>.</p>"
    )


def _headline(report: Report) -> list[tuple[str, str]]:
    graphs, plan = report["graphs"].values(), report["plan"]
    return [
        (size_text(sum(graph["bytes"] for graph in graphs)), "all graphs"),
        (f"{sum(graph['params'] for graph in graphs) / 1e6:,.0f} M", "parameters"),
        *_plan_headline(plan),
    ]


def _graph_table(report: Report) -> str:
    rows = []
    for name, graph in report["graphs"].items():
        session = graph["session"]
        threads = "" if session["threads"] is None else f", threads: {session['threads']}"
        rows.append(
            (
                text_html(name),
                size_text(graph["bytes"]),
                f"{graph['params'] / 1e6:,.1f} M",
                text_html(precision_text(graph["precision"])),
                text_html(session["provider"].removesuffix("ExecutionProvider") + threads),
                *_graph_time(report["plan"], name),
            )
        )
    head = ("graph", "size", "parameters", "precision", "runs on", "time", "tag")
    return table(head, rows, numeric=frozenset({1, 2, 5}))


def _gate_table(report: Report) -> str:
    rows = []
    for name, graph in report["graphs"].items():
        parity, gate = graph["parity"], _gate(report, name)
        task = parity["task"]
        rows.append(
            (
                text_html(name),
                _mark(parity["verdict"]),
                _held(f"{parity['cosine']:.6f}", f"≥ {gate['min_cosine']:g}"),
                _held(f"{parity['max_abs']:.2g}", f"≤ {gate['max_abs']:g}"),
                _held(f"{parity['min_difference']:.2g}", f"≥ {gate['min_difference']:g}"),
                "–" if parity["top1"] is None else _held(f"{100 * parity['top1']:.1f} %", _share(gate["top1"])),
                "–" if task is None or task["token_agreement"] is None else f"{100 * task['token_agreement']:.0f} %",
                "–" if task is None else f"{_small(task['waypoint_cm'])} cm",
                "–" if task is None else f"{_small(task['heading_deg'])}°",
                text_html(parity["provider"].removesuffix("ExecutionProvider")),
            )
        )
    numbers = ("cosine", "max-abs", "between inputs", "same token", "same text", "waypoint", "heading")
    limits = _gate(report, "task")
    return table(("graph", "", *numbers, "ran on"), rows, numeric=frozenset(range(2, 9))) + (
        '<p class="quiet">Under a value: the threshold it is held to. Same text: mean share of the first greedy tokens '
        "after every calibration prompt before the first that differs; only trained weights are held to it. What "
        "rounding may do to the robot, worst case "
        f"over the delays of the semantic state: waypoints {limits['waypoint_cm']:g} cm, heading "
        f"{limits['heading_deg']:g}°, speed {limits['speed_mps']:g} m/s, turn rate {limits['turn_radps']:g} rad/s; on "
        f"average no more than {limits['relative']:g} of how much the model's own plans vary; "
        f"semantic state of cosine ≥ {limits['kv_cosine']:g}."
        "</p>"
    )


def _mark(verdict: str) -> str:
    return f'<span class="{MARKS[verdict]}">{verdict}</span>'


def _small(value: float) -> str:
    return "&lt; 0.01" if value < 0.01 else f"{value:.2f}"


def _held(value: str, limit: str) -> str:
    return f'{value}<br><span class="quiet">{text_html(limit)}</span>'


def _share(limit: float | None) -> str:
    return "" if limit is None else f"≥ {100 * limit:g} %"


def _warnings(report: Report) -> str:
    lines = [
        f"<b>{text_html(name)}</b>: {text_html('; '.join(graph['parity']['reasons']))}"
        for name, graph in report["graphs"].items()
        if graph["parity"]["verdict"] == "WARN"
    ]
    return "" if not lines else f'<p class="notice">Near a limit: {"<br>".join(lines)}</p>'


def _reasons(report: Report) -> str:
    lines = []
    for name, graph in report["graphs"].items():
        precision = graph["precision"]
        exceptions = ", ".join(f"{pattern} {kind}" for pattern, kind in precision["overrides"].items())
        but = f", but {exceptions}" if exceptions else ""
        chosen = text_html(f"{name}: {precision['default']}{but}")
        lines.append(f"<p><b>{chosen}</b><br>{text_html(graph['precision_reason'], limit=2000)}</p>")
    return "".join(lines)


def _gate(report: Report, name: str) -> Mapping[str, Any]:
    """Thresholds of a graph; the halves of a language model may share theirs."""
    gates = report["provenance"]["target"]["gates"]
    found: Mapping[str, Any] = gates.get(name) or gates[name.partition(".")[0]]
    return found


def _sensitivity(report: Report) -> str:
    """Task error over the age of the semantic state, and (where a search was made) over groups of layers."""
    lines = [
        Line(
            f"{name} ({precision_text(graph['precision'])})", tuple(map(tuple, graph["parity"]["task"]["by_delay_cm"]))
        )
        for name, graph in report["graphs"].items()
        if graph["parity"]["task"] is not None
    ]
    limit = _gate(report, "task")["waypoint_cm"]
    plots = [
        (
            line_plot(lines, "age of the semantic state, Δt in s", "worst waypoint error in cm", limit),
            "What rounding one graph does to the planned path, the others exact: the worst moment's mean deviation "
            "over the chunk, by how old the semantic state is. Measured on this directory's bytes.",
        ),
        *((plot, caption) for plot, caption in _layer_plots(report)),
    ]
    figures = "".join(f"<figure>{plot}<figcaption>{text_html(c)}</figcaption></figure>" for plot, c in plots if plot)
    return f'<div class="pair">{figures}</div>' if figures else ""


def _layer_plots(report: Report) -> list[tuple[str, str]]:
    """For every graph that was searched: its most sensitive groups of layers, each rounded alone."""
    plots = []
    for name, decision in report["sensitivity"].items():
        rows = [row for row in decision["table"] if row["group"] != "*"]
        if not rows:
            continue
        raised = set(decision["precision"]["overrides"])
        dots = [Dot(row["group"], row["waypoint_cm"], row["group"] in raised) for row in rows[:LAYERS_SHOWN]]
        more = f" of {len(rows)}" if len(rows) > LAYERS_SHOWN else ""
        kept = ", filled: kept more exact" if raised else ""
        plots.append(
            (
                dot_plot(dots, "worst waypoint error in cm", _gate(report, "task")["waypoint_cm"]),
                f"{name}: the {len(dots)}{more} most sensitive groups of layers, each rounded alone to "
                f"{rows[0]['precision']}{kept}. Measured on the PyTorch model.",
            )
        )
    return plots


PLAN_ROWS = (
    ("tick_alone_ms", "tick, nothing beside it", "ms"),
    ("tick_ms", "tick with reasoning beside it", "ms"),
    ("period_ms", "tick period", "ms"),
    ("generation_alone_ms", "generation, nothing beside it", "ms"),
    ("generation_ms", "generation with control beside it", "ms"),
    ("prompt_tokens", "prompt", "tokens"),
    ("tokens", "new tokens a generation may have", "tokens"),
    ("delay_s", "largest age of the semantic state", "s"),
    ("max_delay_s", "ceiling on that age", "s"),
    ("duty", "share of the time left by control in which reasoning may run", ""),
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
    """Milliseconds of the stages that a graph does, and their tag."""
    stages = [stage for stage in plan["per_graph"].values() if stage["graph"] == graph]
    tags = sorted({stage["tagged"] for stage in stages})
    return " + ".join(f"{stage['ms']:,.3g} ms" for stage in stages), ", ".join(tags)


def _plan(plan: Mapping[str, Any]) -> str:
    verdict = "" if plan["fits"] else f'<p class="notice"><b>Does not fit:</b> {_joined(plan["reasons"])}</p>'
    warned = f'<p class="notice">{_joined(plan["warnings"])}</p>' if plan["warnings"] else ""
    rows = [
        (text_html(what), _number(plan[key], unit) + _error(plan.get(ERRORS.get(key, ""))))
        for key, what, unit in PLAN_ROWS
        if plan[key] is not None
    ]
    memory = plan["memory"]
    parts = " + ".join(
        f"{name} {size_text(memory[name])}" for name in ("weights", "caches", "activations", "workspace")
    )
    rows.append((f"memory: {parts}", f"{size_text(plan['memory_bytes'])} of {size_text(memory['available'])}"))
    stages = [
        (
            text_html(name),
            f"{stage['calls']:,}",
            f"{stage['ms']:,.3g} ms" + _error(stage["error"]),
            f"{stage['gflop']:,.3g}",
            size_text(stage["moved_bytes"]),
            text_html(stage["bound"]),
            stage["tagged"],
            text_html(stage["source"]),
        )
        for name, stage in plan["per_graph"].items()
    ]
    head = ("stage", "calls", "time", "GFLOP", "bytes moved", "bound by", "tag", "source")
    return (
        f'{verdict}{warned}<p class="quiet">Power mode {text_html(plan["mode"])}. Sized from '
        f"{text_html(plan['tagged'])} times; ± is the error bar where the model states one.</p>"
        + table(("schedule", "value"), rows, numeric=frozenset({1}))
        + "<h2>Time by stage</h2>"
        + table(head, stages, numeric=frozenset({1, 2, 3, 4}))
    )


def _joined(lines: list[str]) -> str:
    return "<br>".join(text_html(line) for line in lines)


def _number(value: float, unit: str) -> str:
    return text_html(f"{value:,.4g} {unit}".strip())


def _error(share: float | None) -> str:
    return f" ± {100 * share:.0f} %" if share else ""


def _calibration(calibration: Mapping[str, object]) -> str:
    assumed = f"; assumed: {calibration['assumed']}" if calibration["assumed"] else ""
    return (
        f"<p>Set <b>{text_html(str(calibration['name']))}</b>: {calibration['clips']} clips, "
        f"{calibration['frames']} frames{text_html(assumed)}. The task error and the choice of precision are measured "
        f'on it.</p><p class="quiet">sha256 <code>{text_html(str(calibration["sha256"]))}</code></p>'
    )


def _provenance(report: Report) -> str:
    provenance = report["provenance"]
    packages = ", ".join(f"{name} {version}" for name, version in provenance["packages"].items())
    rows = [
        ("weights", text_html(provenance["weights_origin"])),
        ("weights sha256", f"<code>{text_html(provenance['weights_sha256'])}</code>"),
        ("target", text_html(report["target"])),
        ("packages", text_html(packages)),
    ]
    return table(("what", "value"), rows)
