"""Prints a plan: a table of stages, sums, exceeded limits."""

from __future__ import annotations

from rich.box import SIMPLE_HEAD
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from export.plan.guessing import ACCEPTANCE
from export.plan.plan import Plan
from export.plan.timing import GIB, Estimate
from export.quantize.precision import Precision


def plan_table(plan: Plan) -> RenderableType:
    """Return a table of stages with sums and verdict, for a Console on standard error."""
    title = f"{plan.model} on {plan.target}, power mode {plan.mode}"
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, show_edge=False, pad_edge=False)
    # Fits 80 columns; calls, products and bytes moved are in the JSON and in the report.
    for name in ("stage", "precision", "weights", "time", "bound by", ""):
        left = name in ("stage", "precision", "bound by", "")
        table.add_column(name, justify="left" if left else "right", no_wrap=name != "precision")
    for stage in plan.stages:
        table.add_row(
            stage.stage,
            _precision(plan.precisions[stage.graph]),
            _size(plan.weight_bytes[stage.graph]),
            _time(stage.whole),
            stage.bound,
            stage.whole.tag,
        )
    return Group(table, *(Text(line) for line in plan_lines(plan)))


def plan_lines(plan: Plan) -> list[str]:
    """Return the sums of a plan, one per line, with the verdict last."""
    lines = [f"tick        {_time(plan.tick)} of {plan.period_ms} ms ({_time(plan.tick_alone)} without reasoning)"]
    if plan.generation is not None and plan.delay_s is not None:
        lines += [
            f"generation  {_time(plan.generation)} for {plan.work.prompt_tokens} + {plan.tokens} tokens, "
            f"{plan.generation_alone.ms:.0f} ms without control",
            f"Δt          at most {plan.delay_s:.1f} s of {plan.max_delay_s:g} s, reasoning may run "
            f"{100 * plan.duty:.0f} % of the time that control leaves",
        ]
    if (guessing := plan.guessing) is not None:
        lines.append(
            f"guessing    {_time(guessing.generation)} without control where it is exact: {guessing.rows} rows "
            f"a call, {guessing.tokens_per_call:g} tokens, acceptance {ACCEPTANCE} (recorded texts; modelled)"
        )
        if plan.delay_s is not None:
            lines.append(f"            Δt then at most {plan.delay_s * guessing.share:.1f} s")
    if plan.average_w is not None:
        error = f" ± {plan.average_w * plan.average_w_error:.1f}" if plan.average_w_error else ""
        budget = f" of {plan.budget_w:g} W" if plan.budget_w is not None else ""
        lines.append(f"power       {plan.average_w:.1f}{error} W{budget}, at most")
    memory = plan.memory
    lines.append(f"memory      {memory.needed / GIB:.2f} GiB of {memory.available / GIB:.2f} GiB that are free")
    lines += [f"note        {warning}" for warning in plan.warnings]
    lines += [f"exceeded    {reason}" for reason in plan.reasons]
    lines.append(f"verdict     {'fits' if plan.fits else 'does not fit'} ({plan.tagged})")
    return lines


def _time(estimate: Estimate) -> str:
    error = f" ± {_number(estimate.ms * estimate.error)}" if estimate.error else ""
    return f"{_number(estimate.ms)}{error} ms"


def _number(ms: float) -> str:
    return f"{ms:.0f}" if ms >= 100 else f"{ms:.3g}"


def _precision(precision: Precision) -> str:
    overrides = ", ".join(f"{layer} {name}" for layer, name in precision.overrides[:2])
    more = f" +{len(precision.overrides) - 2}" if len(precision.overrides) > 2 else ""
    return f"{precision.default}{f' ({overrides}{more})' if overrides else ''}"


def _size(count: int) -> str:
    return f"{count / 1e9:.2f} GB" if count >= 1e9 else f"{count / 1e6:.1f} MB"
