"""Memory that a model takes on a target: weights, KV buffers and contexts, activations, the providers' own."""

from __future__ import annotations

from dataclasses import dataclass

from export.model.config import TicVlaConfig
from export.plan.cost import context_numbers
from export.plan.timing import Work, stage_calls, stage_graph
from export.quantize.precision import Precision
from export.targets.file import Target
from export.targets.sections import KV_DTYPES

GIB = 1 << 30
TICK_STAGES = ("vision_encoder", "action_expert")
GENERATION_STAGES = ("prefill", "decode", "semantic_context")


@dataclass(frozen=True)
class Memory:
    """Bytes on the device that the model takes, by what for, and what there is for it."""

    weights: int
    caches: int
    activations: int
    workspace: int
    available: int

    @property
    def needed(self) -> int:
        """Sum of what it takes."""
        return self.weights + self.caches + self.activations + self.workspace


def graph_weights(target: Target, config: TicVlaConfig, graph: str, precision: Precision, work: Work) -> int:
    """Bytes of a graph's weights."""
    stage = {"language_model": "prefill", "language_model.prefill": "prefill", "language_model.decode": "decode"}
    call = stage_calls(config, graph, stage.get(graph, graph), work)[0][0]
    return call.weights(precision, target.provider(graph).activation_bytes)


def memory_of(target: Target, config: TicVlaConfig, work: Work, weights: int) -> Memory:
    """What a model whose weights take `weights` bytes needs on the target's device."""
    language = config.language
    kv_bytes = KV_DTYPES[target.runtime.kv_dtype]
    caches = 2 * language.layers * language.kv_heads * language.head_dim * language.max_context
    # The context in use and the next one; the ring of encoded frames is kept in fp32.
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
