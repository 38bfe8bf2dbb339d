"""Contenders with their tasks, and verdicts: medians over rounds, paired ratios, required ratios (bars)."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase

OURS = "ours"
OWN_STACK = frozenset({OURS, "genai", "onnxruntime"})
"""Stacks on ONNX Runtime, like this project's: they are measured, but the bars compare with the best of the others."""

TASKS = ("encoder", "action", "tick", "language")


@dataclass(frozen=True)
class Contender:
    """One process: a runtime (`stack`) with its form, parts and options."""

    name: str
    stack: str
    parts: tuple[str, ...]
    options: Mapping[str, str] = field(default_factory=dict)
    assets: tuple[str, ...] = ()
    """Models that `tools.bench.peers.models.prepare` must build."""
    memory_only: bool = False
    """Whether only the memory of all parts together is measured."""

    @property
    def tasks(self) -> tuple[str, ...]:
        """Timed tasks."""
        if self.memory_only:
            return ()
        has = set(self.parts)
        return tuple(t for t in TASKS if t in has or (t == "tick" and {"encoder", "action"} <= has))


def _openvino(parts: Sequence[str], forms: Mapping[str, tuple[str, str]], name: str, **more: bool) -> Contender:
    options: dict[str, str] = {}
    for part in parts:
        form, hint = forms[part]
        options |= {f"{part}.form": form, f"{part}.INFERENCE_PRECISION_HINT": hint}
    assets = tuple(f"openvino/{part}-{forms[part][0]}" for part in parts)
    return Contender(name, "openvino", tuple(parts), options, assets, **more)


def _language(name: str, stack: str, form: str, **options: str) -> Contender:
    given = {"language.form": form} | {f"language.{k}": v for k, v in options.items()}
    folder = stack.partition("_")[0]
    assets = ("reference",) if stack == "torch" else (f"{folder}/language-{form}",)
    return Contender(name, stack, ("language",), given, assets)


def _torch(form: str, parts: tuple[str, ...], name: str, **more: bool) -> Contender:
    return Contender(name, "torch", parts, {f"{p}.form": form for p in parts}, ("reference",), **more)


CONTROL = ("encoder", "action")
EVERYTHING = ("encoder", "action", "language")

CONTENDERS = (
    Contender("ours control", OURS, CONTROL),
    Contender("ours language", OURS, ("language",)),
    Contender("ours everything", OURS, EVERYTHING, memory_only=True),
    _openvino(CONTROL, {"encoder": ("fp32", "bf16"), "action": ("fp32", "bf16")}, "openvino control bf16"),
    _openvino(CONTROL, {"encoder": ("int8", "bf16"), "action": ("int8", "bf16")}, "openvino control int8/bf16"),
    _openvino(CONTROL, {"encoder": ("int8", "f32"), "action": ("int8", "f32")}, "openvino control int8/f32"),
    _openvino(("language",), {"language": ("int8", "bf16")}, "openvino language int8/bf16"),
    _openvino(("language",), {"language": ("int8", "f32")}, "openvino language int8/f32"),
    _openvino(("language",), {"language": ("int4", "bf16")}, "openvino language int4/bf16"),
    _openvino(("language",), {"language": ("int4", "f32")}, "openvino language int4/f32"),
    *(
        _language(f"openvino genai {form}", "openvino_genai", form, INFERENCE_PRECISION_HINT="f32")
        for form in ("int8", "int4")
    ),
    _torch("bf16", CONTROL, "torch control bf16"),
    _torch("int8", CONTROL, "torch control int8"),
    _torch("fp32", ("action",), "torch action fp32"),
    _language("torch language bf16", "torch", "bf16"),
    _language("torch language int8", "torch", "int8"),
    _language("llama.cpp q4_0", "llama", "q4_0"),
    # Repacked weights are a copy beside the mapped file: reading the file, or not repacking, may need less memory.
    _language("llama.cpp q4_0 read", "llama", "q4_0", weights="read"),
    _language("llama.cpp q4_0 lean", "llama", "q4_0", extra_buffers="false"),
    _language("llama.cpp q8_0", "llama", "q8_0"),
    _language("genai int4", "genai", "int4"),
    *(
        Contender(
            f"onnxruntime action {form}",
            "onnxruntime",
            ("action",),
            {"action.form": form},
            (f"onnxruntime/action-{form}",),
        )
        for form in ("fp32", "int8")
    ),
    _openvino(
        EVERYTHING,
        {"encoder": ("int8", "bf16"), "action": ("int8", "bf16"), "language": ("int4", "bf16")},
        "openvino everything int8+int4",
        memory_only=True,
    ),
    _torch("bf16", EVERYTHING, "torch everything bf16", memory_only=True),
)


def chosen(patterns: Sequence[str]) -> list[Contender]:
    """Return contenders that match a pattern (all without patterns). Raises ValueError if none matches."""
    found = [c for c in CONTENDERS if not patterns or any(fnmatchcase(c.name, p) for p in patterns)]
    if not found:
        names = ", ".join(c.name for c in CONTENDERS)
        raise ValueError(f"--only {' '.join(patterns)}: no contender of that name; there are: {names}")
    return found


Series = Mapping[str, Sequence[float]]
"""Contender → one value per round, in the same rounds for all."""


@dataclass(frozen=True)
class Metric:
    """Measured quantity, its direction, and the bar (required ratio to the best peer)."""

    key: str
    title: str
    unit: str
    higher_is_better: bool
    bar: float | None
    against_own_stack: bool = False
    """Whether plain ONNX Runtime counts as a peer: only if the bar is about splitting instead of the runtime."""


METRICS = (
    Metric("encoder_ms", "encoder, one frame", "ms", False, 1.0),
    Metric("prefill_ms", "prefill", "ms", False, 1.1),
    Metric("decode_tokens_per_s", "decode", "tok/s", True, 1.8),
    Metric("generation_ms", "generation: prefill and 80 tokens", "ms", False, 2.0),
    Metric("action_ms", "action expert, one step", "ms", False, 2.0, against_own_stack=True),
    Metric("tick_ms", "control tick (encoder + action)", "ms", False, None),
    Metric("language_rss_mb", "peak memory, language model (RSS)", "MB", False, 1.0),
    Metric("everything_rss_mb", "peak memory, all parts (RSS)", "MB", False, 1.0),
    Metric("language_anon_mb", "the same without mapped files, language model", "MB", False, None),
    Metric("everything_anon_mb", "the same without mapped files, all parts", "MB", False, None),
)


@dataclass(frozen=True)
class Row:
    """Result of one contender in one metric."""

    contender: str
    median: float
    low: float
    high: float
    n: int
    ours: bool
    own_stack: bool


@dataclass(frozen=True)
class Verdict:
    """Verdict on one metric: rows from best to worst, and the ratio to the best peer."""

    metric: Metric
    rows: tuple[Row, ...]
    best_peer: str | None
    ratio: float | None
    """Median of the paired ratios of the best peer and ours, above 1 if ours is better; None if one is missing."""
    reached: bool | None
    """Whether the bar is reached; None without a bar or a comparison."""


def paired_ratio(metric: Metric, ours: Sequence[float], peer: Sequence[float]) -> float:
    """Return the median ratio over rounds, above 1 if ours is better. Raises ValueError if the rounds do not match."""
    pairs = zip(ours, peer, strict=True)
    return statistics.median(o / p if metric.higher_is_better else p / o for o, p in pairs)


def judge(metric: Metric, series: Series, stacks: Mapping[str, str]) -> Verdict:
    """Rank the contenders of a metric and compare ours with the best peer."""
    rows = [
        Row(
            name,
            statistics.median(values),
            min(values),
            max(values),
            len(values),
            stacks[name] == OURS,
            stacks[name] in OWN_STACK,
        )
        for name, values in series.items()
        if values
    ]
    rows.sort(key=lambda row: -row.median if metric.higher_is_better else row.median)
    mine = next((row.contender for row in rows if row.ours), None)
    peers = (row for row in rows if not row.ours and (metric.against_own_stack or not row.own_stack))
    best = next((row.contender for row in peers), None)
    ratio = paired_ratio(metric, series[mine], series[best]) if mine and best else None
    reached = None if ratio is None or metric.bar is None else ratio >= metric.bar
    return Verdict(metric, tuple(rows), best, ratio, reached)


def judge_all(series: Mapping[str, Series], stacks: Mapping[str, str]) -> list[Verdict]:
    """Judge every measured metric."""
    return [judge(metric, series[metric.key], stacks) for metric in METRICS if series.get(metric.key)]


def verdict_text(verdict: Verdict) -> str:
    """Format a verdict, such as `1.31× (bar 1.1×: reached)`."""
    if verdict.ratio is None:
        return "not compared"
    text = f"{verdict.ratio:.2f}× against {verdict.best_peer}"
    if verdict.metric.bar is None:
        return text
    return f"{text} (bar {verdict.metric.bar:g}×: {'reached' if verdict.reached else 'NOT reached'})"


def markdown(verdicts: Sequence[Verdict], heading: str, notes: Sequence[str]) -> str:
    """Format the summary as Markdown."""
    lines = [f"# {heading}", "", *(f"- {note}" for note in notes), "", "| | ours against the best peer |", "|---|---|"]
    lines += [f"| {v.metric.title} | {verdict_text(v)} |" for v in verdicts]
    for v in verdicts:
        lines += ["", f"## {v.metric.title}, {v.metric.unit}", "", "| contender | median | min | max | n |"]
        lines += ["|---|---|---|---|---|"]
        for row in v.rows:
            name = f"**{row.contender}**" if row.ours else row.contender + (" (our own stack)" if row.own_stack else "")
            lines.append(f"| {name} | {row.median:.4g} | {row.low:.4g} | {row.high:.4g} | {row.n} |")
    return "\n".join(lines) + "\n"
