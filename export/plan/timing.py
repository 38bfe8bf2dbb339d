"""Time of every stage (measured, else the roofline of its products and bytes) and memory of all stages."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from edge.artifacts.manifest import LANGUAGE_WHOLE, Artifacts
from export.model.config import TicVlaConfig
from export.plan.cost import (
    DECODE,
    PREFILL,
    Call,
    action_call,
    context_call,
    context_numbers,
    language_call,
    vision_call,
)
from export.quantize.precision import Precision
from export.targets.file import Target
from export.targets.sections import KV_DTYPES, MEASURED, MODELLED, Figure, Measured

GIB = 1 << 30
TICK_STAGES = ("vision_encoder", "action_expert")
GENERATION_STAGES = ("prefill", "decode", "semantic_context")
"""Stages of a model that is guided by keys and values; those of any model are in `Work`."""
SAME_LENGTH = 0.05
"""Largest relative difference in length at which a measurement is used directly; beyond it, it scales the model."""


@dataclass(frozen=True)
class Estimate:
    """Time in ms with its error bar, if known, and whether it was measured."""

    ms: float
    error: float | None
    """Half width of the error bar as a fraction of `ms`."""
    tag: str
    source: str

    @property
    def high_ms(self) -> float:
        """Upper end of the error bar (the estimate itself without one)."""
        return self.ms * (1 + (self.error or 0.0))

    def times(self, factor: float, figure: Figure | None = None) -> Estimate:
        """Multiply the estimate by a factor, with its error; a factor other than 1 makes it modelled."""
        if figure is None:
            return replace(self, ms=self.ms * factor)
        value = figure.value
        tag = self.tag if value == 1.0 else MODELLED
        return replace(self, ms=self.ms * factor * value, error=_together(self.error, figure.error), tag=tag)


def total(parts: Sequence[Estimate]) -> Estimate:
    """Sum estimates; errors add up, because the model errs in the same direction on all parts."""
    ms = sum(part.ms for part in parts)
    known = [part for part in parts if part.error is not None]
    error = sum(part.ms * (part.error or 0.0) for part in parts) / ms if known and ms else None
    tag = MEASURED if all(part.tag == MEASURED for part in parts) else MODELLED
    return Estimate(ms, error, tag, "; ".join(dict.fromkeys(part.source for part in parts)))


@dataclass(frozen=True)
class StageTime:
    """Stage of a tick or a generation: calls of one graph."""

    stage: str
    graph: str
    calls: int
    each: Estimate
    """Longest call, ms."""
    whole: Estimate
    flops: int
    moved_bytes: int
    bound: str
    """Limit of its time: `compute`, `memory` or `measured`."""
    energy_j: float | None = None
    """Metered energy of all its calls above idle, J, at other lengths in proportion to time; None: not metered."""


@dataclass(frozen=True)
class Work:
    """Token counts of a plan."""

    prompt_tokens: int
    chunk_tokens: int
    new_tokens: int
    guidance_tokens: int | None = None
    """Tokens of a semantic context of waypoints, which every tick computes; None: it is computed from K and V of the
    prompt and the new tokens, once per generation."""

    @property
    def chunks(self) -> list[tuple[int, int]]:
        """(tokens, preceding tokens) of every prefill call."""
        starts = range(0, self.prompt_tokens, self.chunk_tokens)
        return [(min(self.chunk_tokens, self.prompt_tokens - start), start) for start in starts]

    @property
    def context_tokens(self) -> int:
        """Tokens of the semantic context."""
        return self.prompt_tokens + self.new_tokens if self.guidance_tokens is None else self.guidance_tokens

    @property
    def tick_stages(self) -> tuple[str, ...]:
        """Stages of every tick."""
        return TICK_STAGES if self.guidance_tokens is None else (*TICK_STAGES, "semantic_context")

    @property
    def generation_stages(self) -> tuple[str, ...]:
        """Stages of a generation."""
        return tuple(stage for stage in GENERATION_STAGES if stage not in self.tick_stages)


def stage_graph(target: Target, stage: str) -> str:
    """Return the graph of a stage."""
    pair = {"prefill": PREFILL, "decode": DECODE}
    if stage in pair and LANGUAGE_WHOLE[0] in target.graphs:
        return LANGUAGE_WHOLE[0]
    return pair.get(stage, stage)


def stage_calls(config: TicVlaConfig, graph: str, stage: str, work: Work) -> list[tuple[Call, int]]:
    """Return (call, count) of a stage; decoding is counted at its middle length."""
    if stage == "vision_encoder":
        return [(vision_call(config), 1)]
    if stage == "prefill":
        return [(language_call(config, graph, tokens=n, past=past), 1) for n, past in work.chunks]
    if stage == "decode":
        past = work.prompt_tokens + work.new_tokens // 2
        return [(language_call(config, graph, tokens=1, past=past), work.new_tokens)]
    if stage == "semantic_context":
        return [(context_call(config, tokens=work.context_tokens), 1)]
    return [(action_call(config, context=work.context_tokens), 1)]


def stage_time(target: Target, config: TicVlaConfig, stage: str, precision: Precision, work: Work) -> StageTime:
    """Estimate the time of a stage's calls while nothing else runs."""
    graph = stage_graph(target, stage)
    modelled = modelled_stage(target, config, stage, precision, work)
    point = _point(target, config.name, graph, stage, precision)
    if point is None:
        return modelled
    wanted, taken = _length(stage, work), point.tokens
    measured_ms = point.ms if point.ms is not None else 1000.0 / (point.tokens_per_s or math.nan)
    calls = max(modelled.calls, 1)
    per = calls if stage == "decode" else 1  # a decode point is per token, any other for the whole stage
    where = f"measured on {point.machine}, {point.date}"
    same_chunks = point.chunk_tokens is None or point.chunk_tokens == work.chunk_tokens
    # A point names a model; its action expert was measured with the query head.
    timed = replace(config, action=replace(config.action, head="query")) if stage == "action_expert" else config
    if (taken is None or abs(wanted - taken) <= SAME_LENGTH * taken) and same_chunks and timed == config:
        whole = Estimate(measured_ms * per, point.error, MEASURED, where)
        # Only the total was measured: the longest call is estimated from the model's share.
        share = modelled.each.ms / modelled.whole.ms if modelled.whole.ms else 1.0
        energy_j = None if point.energy_j is None else point.energy_j * per
        return replace(modelled, whole=whole, each=whole.times(share), bound=MEASURED, energy_j=energy_j)
    reference = modelled_stage(target, timed, stage, precision, _at(stage, work, point))
    reference_ms = reference.whole.ms / (reference.calls if stage == "decode" else 1)
    factor = measured_ms / reference_ms
    at = "" if taken is None else f" at {taken} tokens"
    source = f"roofline scaled by {factor:.2f}: {where}{at}{'' if timed == config else ', query head'}"
    scaled = [
        replace(e.times(factor), error=point.error, tag=MODELLED, source=source)
        for e in (modelled.whole, modelled.each)
    ]
    energy_j = None if point.energy_j is None else point.energy_j * scaled[0].ms / measured_ms
    return replace(modelled, whole=scaled[0], each=scaled[1], energy_j=energy_j)


def _length(stage: str, work: Work) -> int:
    if stage == "prefill":
        return work.prompt_tokens
    if stage == "decode":
        return work.prompt_tokens + work.new_tokens // 2
    return work.context_tokens


def _at(stage: str, work: Work, point: Measured) -> Work:
    """Return the token counts of a measurement."""
    tokens = point.tokens or _length(stage, work)
    if stage == "prefill":
        return Work(tokens, point.chunk_tokens or work.chunk_tokens, 0)
    return Work(tokens, work.chunk_tokens, 1 if stage == "decode" else 0)


def _point(target: Target, model: str, graph: str, stage: str, precision: Precision) -> Measured | None:
    """Find the newest measurement with these properties; of equal dates the last one listed."""
    policy = target.graphs[graph]
    threads = policy.threads or 1
    # The unit of a language model's point distinguishes prefill (ms) from decoding (tokens/s).
    per_token = {"prefill": False, "decode": True}.get(stage)
    found = [
        point
        for point in target.measured
        if (point.model, point.graph, point.precision) == (model, graph, precision.default)
        and tuple(point.overrides.items()) == precision.overrides
        and (point.form, point.provider) == (policy.form, policy.provider)
        and point.threads in (None, threads)
        and point.mode in (None, target.power.mode)
        and (graph != LANGUAGE_WHOLE[0] or per_token == (point.tokens_per_s is not None))
    ]
    return max(reversed(found), key=lambda point: point.date, default=None)


def modelled_stage(
    target: Target,
    config: TicVlaConfig,
    stage: str,
    precision: Precision,
    work: Work,
    decode_calls: tuple[int, int] | None = None,
) -> StageTime:
    """Model a stage; `decode_calls`: rows and number of its calls, for decoding with guesses."""
    graph = stage_graph(target, stage)
    calls = stage_calls(config, graph, stage, work)
    if decode_calls is not None:
        rows, count = decode_calls
        calls = [(language_call(config, graph, tokens=rows, past=work.prompt_tokens + work.new_tokens // 2), count)]
    timed = [(*_call_ms(target, graph, stage, call, precision), call, count) for call, count in calls]
    ms = sum(call_ms * count for call_ms, _, _, _, count in timed)
    error = sum(call_ms * count * (e or 0.0) for call_ms, e, _, _, count in timed) / ms if ms else None
    longest = max(timed, key=lambda item: item[0])
    source = f"roofline of {target.name}, mode {target.power.mode}"
    kv_bytes = KV_DTYPES[target.runtime.kv_dtype]
    activation = target.provider(graph).activation_bytes
    return StageTime(
        stage=stage,
        graph=graph,
        calls=sum(count for *_, count in timed),
        each=Estimate(longest[0], longest[1], MODELLED, source),
        whole=Estimate(ms, error, MODELLED, source),
        flops=sum(call.flops() * count for *_, call, count in timed),
        moved_bytes=sum(
            call.traffic(precision, activation_bytes=activation, cache_bytes=kv_bytes) * count
            for *_, call, count in timed
        ),
        bound=longest[2],
    )


def _call_ms(
    target: Target, graph: str, stage: str, call: Call, precision: Precision
) -> tuple[float, float | None, str]:
    """Estimate the time of one call: ms, relative error, and the bounding resource."""
    provider, roofline, mode = target.provider(graph), target.roofline, target.power.selected
    efficiency = roofline.compute_efficiency[stage]
    cores = 1.0  # share of the processor
    if provider.uses_cores:
        cores = min(target.graphs[graph].threads or 1, target.device.cores) / target.device.cores
    work = [(provider.compute.attention, call.attention_flops)]
    for name, flops in call.linear_flops(precision).items():
        roof = provider.compute.roof(name)
        # A precision without a kernel is expanded and computed in fp32.
        work.append((roof or provider.compute.fp32 or "fp32", flops))
    compute_ms = sum(
        flops / (roofline.peak(roof).value * 1e9 * mode.compute.value * efficiency.value * cores) * 1e3
        for roof, flops in work
    )
    moved = call.traffic(
        precision, activation_bytes=provider.activation_bytes, cache_bytes=KV_DTYPES[target.runtime.kv_dtype]
    )
    bandwidth = roofline.memory_gbps.value * 1e9 * mode.memory.value * roofline.memory_efficiency.value
    # One core does not saturate a processor's memory bus; two nearly do.
    memory_ms = moved / (bandwidth * cores) * 1e3
    overhead = provider.call_overhead_ms
    if compute_ms >= memory_ms:
        peak_error = max((roofline.peak(roof).error or 0.0 for roof, _ in work), default=0.0)
        bound, ms, error = "compute", compute_ms, _together(efficiency.error, peak_error or None, mode.compute.error)
    else:
        bound, ms = "memory", memory_ms
        error = _together(roofline.memory_efficiency.error, roofline.memory_gbps.error, mode.memory.error)
    whole = ms + overhead.value
    spread = ms * (error or 0.0) + overhead.value * (overhead.error or 0.0)
    return whole, spread / whole if spread else None, bound


def _together(*errors: float | None) -> float | None:
    """Combine independent relative errors of factors."""
    known = [error for error in errors if error is not None]
    return math.sqrt(sum(error**2 for error in known)) if known else None


@dataclass(frozen=True)
class Memory:
    """Device memory of the model by purpose, and available memory, bytes."""

    weights: int
    caches: int
    activations: int
    workspace: int
    available: int

    @property
    def needed(self) -> int:
        """Sum of the model's memory, bytes."""
        return self.weights + self.caches + self.activations + self.workspace


def graph_weights(target: Target, config: TicVlaConfig, graph: str, precision: Precision, work: Work) -> int:
    """Return the bytes of a graph's weights."""
    stage = {"language_model": "prefill", "language_model.prefill": "prefill", "language_model.decode": "decode"}
    call = stage_calls(config, graph, stage.get(graph, graph), work)[0][0]
    return call.weights(precision, target.provider(graph).activation_bytes)


def memory_of(target: Target, config: TicVlaConfig, work: Work, weights: int) -> Memory:
    """Estimate the device memory of a model with `weights` bytes of weights."""
    language = config.language
    kv_bytes = KV_DTYPES[target.runtime.kv_dtype]
    caches = 2 * language.layers * language.kv_heads * language.head_dim * language.max_context
    # The context in use and the next one; encoded frames are in fp32.
    contexts = 2 * context_numbers(config, work.context_tokens)
    frames = (len(target.runtime.frame_offsets_s) + 1) * config.vision.tokens * config.vision.token_dim * 4
    activations = max(
        call.workspace * target.provider(graph).activation_bytes
        for stage in (*TICK_STAGES, *GENERATION_STAGES)
        for graph in (stage_graph(target, stage),)
        for call, _ in stage_calls(config, graph, stage, work)
    )
    providers = {target.graphs[name].provider for name in target.graph_names}
    workspace = sum(target.providers[name].workspace_gib.value for name in providers)
    return Memory(
        weights=weights,
        caches=(caches + contexts) * kv_bytes + frames,
        activations=2 * activations,  # both threads run
        workspace=round(workspace * GIB),
        available=round((target.device.memory_gib - target.device.reserved_gib) * GIB),
    )


def measured_point(
    target: Target,
    manifest: Mapping[str, Any],
    artifacts: Artifacts,
    stage: str,
    samples: Mapping[str, Any],
    *,
    machine: str,
    date: str,
    energy_j: float | None = None,
) -> Measured:
    """Build the point of one stage from `samples`, its times in ms (decode: per token), at `prompt` and `new` tokens.

    `energy_j` is the energy above idle of one such time. Raises TargetError for an invalid time.
    """
    graph = stage_graph(target, stage)
    policy, times_ms = target.graphs[graph], samples[stage]
    precision = Precision.from_dict(manifest["graphs"][graph]["precision"])
    median_ms = statistics.median(times_ms)
    context = samples["prompt"] + samples["new"]
    tokens = {"prefill": samples["prompt"], "decode": samples["prompt"] + samples["new"] // 2}.get(stage, context)
    threads = artifacts.graphs[graph].session.threads or 1
    return Measured(
        model=artifacts.model_name,
        graph=graph,
        precision=precision.default,
        overrides=dict(precision.overrides),
        form=policy.form,
        provider=policy.provider,
        machine=machine,
        date=date,
        ms=None if stage == "decode" else round(median_ms, 3),
        tokens_per_s=round(1000 / median_ms, 2) if stage == "decode" else None,
        tokens=None if stage == "vision_encoder" else tokens,
        chunk_tokens=artifacts.runtime.prefill_chunk_tokens if stage == "prefill" else None,
        threads=threads if target.providers[policy.provider].uses_cores else None,
        mode=target.power.mode,
        # Half the spread of the samples: the error of a repetition on this machine, not of another machine.
        error=round(min(0.99, (max(times_ms) - min(times_ms)) / 2 / median_ms), 3),
        energy_j=None if energy_j is None else round(energy_j, 6),
    )
