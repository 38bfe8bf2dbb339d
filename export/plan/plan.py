"""Plans tick, generation, tokens, duty, power and memory of a target from a model of the device.

All numbers of the model are a target's figures or measured points:

* A call takes the longer of its products at the device's compute peak and its bytes at the memory's bandwidth, each
  times the share of the peak that such kernels reach, plus the provider's overhead (`export/plan/timing.py`).
* Two threads. Where both use one accelerator they take turns by call and control goes first: a tick waits at most for
  the call in flight, and reasoning gets the time that ticks leave. On cores of their own they slow one another down.
* Average power is idle power plus the rise to full load times the share of time in which something runs: an upper
  bound, since a full load was metered with every unit busy. What the budget leaves after control is reasoning's duty.
* A semantic state is in use until the next one is ready: Δt is at most one generation plus one cycle of generations.

`tests/export/plan/test_plan.py` states the ratios to the paper's Table 3 (PyTorch, power mode and tokens not given).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from edge.artifacts.runtime import RANGES
from edge.state.switches import Speculation
from export.model.config import TicVlaConfig
from export.plan.guessing import GuessingTime, guessing_time
from export.plan.timing import (
    GIB,
    Estimate,
    Memory,
    StageTime,
    Work,
    graph_weights,
    memory_of,
    stage_graph,
    stage_time,
    total,
)
from export.quantize.precision import Precision
from export.targets.file import Target
from export.targets.sections import MEASURED, MODELLED, PowerMode

TEXT_TOKENS = {True: 166, False: 104}
"""Tokens of a prompt beside its frames (chat template, an instruction of 10 words, a way of 8 points, progress),
counted with Qwen's tokenizer (large vocabulary) and with the small model's."""
LARGE_VOCABULARY = 100_000


class PlanError(ValueError):
    """Impossible plan, or plan that does not fit; its text is the one line to show."""


@dataclass(frozen=True)
class Plan:
    """Schedule of both threads on a target, with a verdict."""

    target: str
    model: str
    mode: str
    period_ms: int
    stages: tuple[StageTime, ...]
    precisions: Mapping[str, Precision]
    tick_alone: Estimate
    tick: Estimate
    """Tick while reasoning runs."""
    generation_alone: Estimate
    generation: Estimate | None
    """Generation while control runs; None if control leaves no time."""
    guessing: GuessingTime | None
    """Decoding with guesses; None: switched off, or no new tokens. The other times do not count on it."""
    work: Work
    duty: float
    """Largest share of reasoning in the time that control leaves."""
    delay_s: float | None
    """Largest age of the semantic state in use, s."""
    max_delay_s: float
    average_w: float | None
    average_w_error: float | None
    budget_w: float | None
    rise_w: float | None
    """Largest power that a running stage adds to idle power, W."""
    memory: Memory
    weight_bytes: Mapping[str, int]
    reasons: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def fits(self) -> bool:
        """Whether no limit is exceeded."""
        return not self.reasons

    @property
    def tokens(self) -> int:
        """Largest number of new tokens of a generation."""
        return self.work.new_tokens

    @property
    def tagged(self) -> str:
        """`measured` if all stages were measured, else `modelled`."""
        return MEASURED if self.tick.tag == MEASURED and self.generation_alone.tag == MEASURED else MODELLED

    def require(self) -> None:
        """Raise PlanError with a one-line message unless the plan fits."""
        if self.reasons:
            raise PlanError(f"{self.model} does not fit {self.target} ({self.mode}): {'; '.join(self.reasons)}")

    def to_dict(self) -> dict[str, Any]:
        """Return the manifest's `plan`: plain JSON, rounded so that it is equal on every machine."""
        return {
            "fits": self.fits,
            "reasons": list(self.reasons),
            "warnings": list(self.warnings),
            "mode": self.mode,
            "period_ms": self.period_ms,
            "tick_ms": _rounded(self.tick.ms),
            "tick_error": _rounded(self.tick.error),
            "tick_alone_ms": _rounded(self.tick_alone.ms),
            "generation_ms": _rounded(self.generation.ms if self.generation else None),
            "generation_error": _rounded(self.generation.error if self.generation else None),
            "generation_alone_ms": _rounded(self.generation_alone.ms),
            "speculation": self.guessing.to_dict(self.delay_s) if self.guessing else None,
            "prompt_tokens": self.work.prompt_tokens,
            "tokens": self.tokens,
            "duty": _rounded(self.duty),
            "delay_s": _rounded(self.delay_s),
            "max_delay_s": self.max_delay_s,
            "average_w": _rounded(self.average_w),
            "average_w_error": _rounded(self.average_w_error),
            "budget_w": self.budget_w,
            "memory_bytes": self.memory.needed,
            "memory": dataclasses.asdict(self.memory),
            "per_graph": {stage.stage: self._stage(stage) for stage in self.stages},
            "tagged": self.tagged,
        }

    def _stage(self, stage: StageTime) -> dict[str, Any]:
        return {
            "graph": stage.graph,
            "precision": self.precisions[stage.graph].to_dict(),
            "calls": stage.calls,
            "ms": _rounded(stage.whole.ms),
            "call_ms": _rounded(stage.each.ms),
            "error": _rounded(stage.whole.error),
            "energy_j": self._energy_j(stage),
            "energy_tagged": MODELLED if stage.energy_j is None else stage.whole.tag,
            "gflop": _rounded(stage.flops / 1e9),
            "moved_bytes": stage.moved_bytes,
            "weight_bytes": self.weight_bytes[stage.graph],
            "bound": stage.bound,
            "tagged": stage.whole.tag,
            "source": stage.whole.source,
        }

    def _energy_j(self, stage: StageTime) -> float | None:
        """Return a stage's metered energy, else that of full load over its time, J; None for a target without power."""
        if stage.energy_j is not None:
            return round(stage.energy_j, 4)
        return None if self.rise_w is None else round(self.rise_w * stage.whole.ms / 1e3, 4)


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


def plan(
    target: Target,
    config: TicVlaConfig,
    precisions: Mapping[str, Precision] | None = None,
    *,
    tokens: int | None = None,
    text_tokens: int | None = None,
) -> Plan:
    """Plan both threads of a model for a target (already `for_model`). Pure: same arguments → same plan.

    `precisions` by graph replace the target's; `tokens` fixes the new tokens of a generation, by default the largest
    number that keeps Δt under the target's ceiling. Raises PlanError for impossible arguments.
    """
    wanted = dict(precisions or {})
    unknown = sorted(set(wanted) - set(target.graphs))
    if unknown:
        raise PlanError(f"plan: no graph {unknown[0]!r}; expected some of {', '.join(target.graph_names)}")
    chosen = {name: wanted.get(name, target.precision(name)) for name in target.graph_names}
    _check_profiles(target, config)
    if text_tokens is None:
        text_tokens = TEXT_TOKENS[config.language.vocab >= LARGE_VOCABULARY]
    prompt = len(target.runtime.frame_offsets_s) * config.frame_tokens + text_tokens
    room = config.language.max_context - prompt
    if text_tokens < 1 or (tokens is not None and not 0 <= tokens <= max(room, 0)):
        raise PlanError(
            f"plan: {tokens} new and {text_tokens} text tokens; after a prompt of {prompt} tokens the model has room "
            f"for {max(room, 0)} new ones"
        )
    if room < 0:
        raise PlanError(
            f"plan: the prompt of {prompt} tokens exceeds the context of {config.language.max_context}: give fewer "
            f"runtime.frame_offsets_s"
        )
    if tokens is not None:
        return _sized(target, config, chosen, prompt, tokens, advise=True)
    low, high = 0, min(target.runtime.max_new_tokens, room)
    while low < high:  # Δt grows with the tokens: bisect for the largest number under the ceiling
        middle = (low + high + 1) // 2
        delay_s = _sized(target, config, chosen, prompt, middle, advise=False).delay_s
        low, high = (
            (middle, high) if delay_s is not None and delay_s <= target.runtime.max_delay_s else (low, middle - 1)
        )
    return _sized(target, config, chosen, prompt, low, advise=True)


def _check_profiles(target: Target, config: TicVlaConfig) -> None:
    """Refuse profiles shorter than the model's context: a longer call would fail while the robot walks."""
    context = config.language.max_context
    needed = {"T": (config.frame_tokens, context), "S": (1, min(target.runtime.prefill_chunk_tokens, context))}
    needed["C"] = (context, context)
    for name in target.graph_names:
        profile = target.graphs[name].profile if target.provider(name).engine else {}
        for axis, (low, high) in needed.items():
            least, _, most = profile.get(axis, (low, low, high))
            if not least <= low <= high <= most:
                raise PlanError(
                    f"graphs.{name}.profile.{axis} covers {least} to {most}, {config.name} needs {low} to {high} "
                    f"(model.language.max_context={context}): set graphs.{name}.profile.{axis}={low},{high},{high} or "
                    f"wider"
                )


@dataclass(frozen=True)
class _Share:
    """Division of the device's time between control and reasoning."""

    control: float
    """Share of control."""
    left: float
    """Share available to reasoning."""
    reasoning: float
    """Share of reasoning under the power budget."""
    average_w: float | None
    error: float | None


def _share(target: Target, work: Work, tick_alone_ms: float) -> _Share:
    power, mode = target.power, target.power.selected
    control = tick_alone_ms / target.runtime.tick_period_ms
    one_device = target.roofline.sharing == "one-device"
    left = max(0.0, 1.0 - control) if one_device else 1.0
    # With separate cores, each thread loads its part of the processor.
    control_load, reasoning_load = (
        (1.0, 1.0) if one_device else (_load(target, work.tick_stages), _load(target, ("decode",)))
    )
    reasoning = left
    rise = _rise_w(target)
    if rise is None or power.idle_w is None or mode.busy_w is None:
        return _Share(control, left, reasoning, None, None)
    if power.budget_w is not None and rise > 0:
        allowed = (power.budget_w - power.idle_w.value) / rise - min(control, 1.0) * control_load
        reasoning = max(0.0, min(left, allowed / reasoning_load))
    busy = min(1.0, min(control, 1.0) * control_load + reasoning * reasoning_load)
    average = power.idle_w.value + rise * busy
    spread = (mode.busy_w.error or 0.0) * mode.busy_w.value * busy + (
        power.idle_w.error or 0.0
    ) * power.idle_w.value * (1 - busy)
    return _Share(control, left, reasoning, average, spread / average if spread else None)


def _rise_w(target: Target) -> float | None:
    idle, busy = target.power.idle_w, target.power.selected.busy_w
    return None if idle is None or busy is None else max(0.0, busy.value - idle.value)


def _load(target: Target, stages: tuple[str, ...]) -> float:
    threads = [target.graphs[stage_graph(target, stage)].threads or 1 for stage in stages]
    return min(1.0, max(threads) / target.device.cores)


def _sized(
    target: Target, config: TicVlaConfig, chosen: Mapping[str, Precision], prompt: int, tokens: int, *, advise: bool
) -> Plan:
    guidance = config.guidance_tokens if config.action.semantic_interface == "waypoints" else None
    work = Work(prompt, target.runtime.prefill_chunk_tokens, tokens, guidance)
    stages = tuple(
        stage_time(target, config, stage, chosen[stage_graph(target, stage)], work)
        for stage in (*work.tick_stages, *work.generation_stages)
    )
    by_name = {stage.stage: stage for stage in stages}
    tick_alone = total([by_name[name].whole for name in work.tick_stages])
    generation_alone = total([by_name[name].whole for name in work.generation_stages])
    roofline = target.roofline
    tick = tick_alone.times(1.0, roofline.tick_slowdown)
    if roofline.sharing == "one-device":
        longest = max((by_name[name] for name in work.generation_stages), key=lambda stage: stage.each.ms)
        tick = total([tick, longest.each])
    share = _share(target, work, tick_alone.ms)
    slowed = generation_alone.times(1.0, roofline.generation_slowdown)
    generation, delay_s, duty = None, None, 0.0
    if share.reasoning > 0:
        generation = slowed if share.left == 1.0 else dataclasses.replace(slowed.times(1 / share.left), tag=MODELLED)
        delay_s = (generation.ms + slowed.ms / share.reasoning) / 1e3
        duty = share.reasoning / share.left
    guessing = None
    if tokens > 0 and target.runtime.speculation == Speculation.ON.value:
        precision = chosen[stage_graph(target, "decode")]
        others = [by_name[name].whole for name in work.generation_stages if name != "decode"]
        guessing = guessing_time(target, config, precision, work, by_name["decode"], others)
    weights = {name: graph_weights(target, config, name, chosen[name], work) for name in target.graph_names}
    made = Plan(
        target=target.name,
        model=config.name,
        mode=target.power.mode,
        period_ms=target.runtime.tick_period_ms,
        stages=stages,
        precisions=chosen,
        tick_alone=tick_alone,
        tick=tick,
        generation_alone=generation_alone,
        generation=generation,
        guessing=guessing,
        work=work,
        duty=duty,
        delay_s=delay_s,
        max_delay_s=target.runtime.max_delay_s,
        average_w=share.average_w,
        average_w_error=share.error,
        budget_w=target.power.budget_w,
        rise_w=_rise_w(target),
        memory=memory_of(target, config, work, sum(weights.values())),
        weight_bytes=weights,
        reasons=(),
        warnings=(),
    )
    if not advise:
        return made
    reasons = _reasons(target, made, share)
    if reasons:
        better = _modes_that_fit(target, config, chosen, prompt, tokens)
        if better:
            reasons[-1] += f" (power.mode={' or '.join(better)} would fit)"
    return dataclasses.replace(made, reasons=tuple(reasons), warnings=tuple(_warnings(target, made, reasons)))


def _reasons(target: Target, made: Plan, share: _Share) -> list[str]:
    reasons: list[str] = []
    period = made.period_ms
    if made.tick.ms > period:
        heaviest = max((s for s in made.stages if s.stage in made.work.tick_stages), key=lambda s: s.whole.ms)
        rounded = -(-round(made.tick.ms) // 10) * 10
        slower = f" or set runtime.tick_period_ms={rounded}" if rounded <= RANGES["tick_period_ms"][1] else ""
        reasons.append(
            f"tick {made.tick.ms:.0f} ms exceeds the period of {period} ms by {made.tick.ms - period:.0f} ms, "
            f"{heaviest.graph} takes {heaviest.whole.ms:.0f}: give it a faster precision{slower}"
        )
    if made.budget_w is not None and made.average_w is not None and made.average_w > made.budget_w * 1.0001:
        reasons.append(
            f"control alone draws {made.average_w:.1f} W of a budget of {made.budget_w:g} W: set a slower "
            f"runtime.tick_period_ms or power.budget_w={made.average_w:.0f}"
        )
    elif made.generation is None and share.control < 1:
        reasons.append("the power budget leaves no time for reasoning after control: raise power.budget_w")
    if made.delay_s is not None and made.delay_s > made.max_delay_s:
        reasons.append(
            f"with {made.tokens} new tokens a semantic state becomes {made.delay_s:.1f} s old, the ceiling is "
            f"{made.max_delay_s:g} s: allow fewer tokens, frames or more power, or set runtime.max_delay_s"
        )
    memory = made.memory
    if memory.needed > memory.available:
        reasons.append(
            f"memory {memory.needed / GIB:.2f} GiB exceeds the {memory.available / GIB:.2f} GiB that are free by "
            f"{(memory.needed - memory.available) / GIB:.2f} GiB, weights are {memory.weights / GIB:.2f}: choose a "
            f"smaller precision"
        )
    return reasons


def _warnings(target: Target, made: Plan, reasons: Sequence[str]) -> list[str]:
    warnings: list[str] = []
    if made.tick.ms <= made.period_ms < made.tick.high_ms:
        warnings.append(
            f"tick may take up to {made.tick.high_ms:.0f} ms of {made.period_ms}: measure it on the device first"
        )
    if 0 < made.tokens < target.runtime.max_new_tokens and not reasons:
        warnings.append(f"{made.tokens} of runtime.max_new_tokens={target.runtime.max_new_tokens} keep Δt in bounds")
    if made.tokens == 0 and not reasons:
        warnings.append("no new tokens: the semantic state is that of the prompt, without reasoning")
    return warnings


def _modes_that_fit(
    target: Target, config: TicVlaConfig, chosen: Mapping[str, Precision], prompt: int, tokens: int
) -> list[str]:
    """Return the other power modes in which the plan would fit."""

    def fits(name: str) -> bool:
        other = dataclasses.replace(target, power=dataclasses.replace(target.power, mode=name))
        made = _sized(other, config, chosen, prompt, tokens, advise=False)
        return not _reasons(other, made, _share(other, made.work, made.tick_alone.ms))

    ranked: Mapping[str, PowerMode] = {k: v for k, v in target.power.modes.items() if k != target.power.mode}
    return [name for name in ranked if fits(name)]
