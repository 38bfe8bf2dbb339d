"""Counts operations and bytes of every graph from the model's configuration: products, weights, caches."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from edge.artifacts.manifest import LANGUAGE_PAIR, MOST_ROWS
from export.model.config import TicVlaConfig
from export.quantize.precision import Precision, weight_bytes

FLOPS_PER_PRODUCT = 2
PREFILL, DECODE = LANGUAGE_PAIR


@dataclass(frozen=True)
class Linear:
    """Weight matrix [rows, columns] and the number of tokens it multiplies in one call, over all passes."""

    name: str
    rows: int
    columns: int
    tokens: int
    table: bool = False
    """Lookup table: a call reads `tokens` of its rows and multiplies nothing."""
    passes: int = 1
    """Number of reads per call: an unrolled loop reads it in every pass, with a share of the tokens."""

    @property
    def flops(self) -> int:
        """Return the floating-point operations of one call."""
        return 0 if self.table else FLOPS_PER_PRODUCT * self.rows * self.columns * self.tokens

    def bytes_in(self, precision: Precision, scale_bytes: int) -> int:
        """Return its bytes in memory; a scale or activation has `scale_bytes` bytes."""
        name = precision.of(self.name)
        if name == "fp16" and not self.table and scale_bytes == 4:
            name = "fp32"  # widened when the graph is opened, because kernels multiply equal types
        if self.table and name not in ("fp32", "fp16"):
            name = "int8"  # tables have 8 bits or more and one scale per row
        return weight_bytes(name, self.rows, self.columns, scale_bytes=scale_bytes)


@dataclass(frozen=True)
class Call:
    """Call of a graph."""

    linears: tuple[Linear, ...]
    attention_flops: int
    activations: int
    """Number of values written and read between operators."""
    cache: int
    """Number of values of KV buffers or semantic context read and written."""
    workspace: int
    """Largest number of values in memory at once."""

    def flops(self) -> int:
        """Return the floating-point operations."""
        return sum(linear.flops for linear in self.linears) + self.attention_flops

    def linear_flops(self, precision: Precision) -> Mapping[str, int]:
        """Return the operations of the weight products by precision."""
        flops: dict[str, int] = {}
        for linear in self.linears:
            if linear.flops:
                name = precision.of(linear.name)
                flops[name] = flops.get(name, 0) + linear.flops
        return flops

    def weights(self, precision: Precision, scale_bytes: int) -> int:
        """Return the bytes of all weights in memory."""
        return sum(linear.bytes_in(precision, scale_bytes) for linear in self.linears)

    def traffic(self, precision: Precision, *, activation_bytes: int, cache_bytes: int) -> int:
        """Return the bytes moved by one call: weights per pass (of a table only the used rows), activations, caches."""
        read = 0
        for linear in self.linears:
            stored = linear.passes * linear.bytes_in(precision, activation_bytes)
            read += stored * min(linear.tokens, linear.rows) // linear.rows if linear.table else stored
        return read + self.activations * activation_bytes + self.cache * cache_bytes


def vision_call(config: TicVlaConfig) -> Call:
    """Count a call of the encoder on one frame."""
    c = config.vision
    patches, tokens = c.grid**2, c.grid**2 + 1
    embed: list[Linear] = []
    channels, side = 3, c.image_px
    for i, width in enumerate(c.stem_channels):
        side //= 2
        embed.append(Linear(f"embed.{2 * i}", width, 9 * channels, side**2))
        channels = width
    kernel = 1 if c.stem_channels else c.patch_px**2
    embed.append(Linear("embed", c.hidden, kernel * channels, patches))
    blocks = [
        linear
        for i in range(c.layers)
        for linear in (
            Linear(f"blocks.{i}.qkv", 3 * c.hidden, c.hidden, tokens),
            Linear(f"blocks.{i}.proj", c.hidden, c.hidden, tokens),
            Linear(f"blocks.{i}.fc1", c.mlp, c.hidden, tokens),
            Linear(f"blocks.{i}.fc2", c.hidden, c.mlp, tokens),
        )
    ]
    projector = [
        Linear("projector.1", c.token_dim, c.hidden * c.pixel_shuffle**2, c.tokens),
        Linear("projector.3", c.token_dim, c.token_dim, c.tokens),
    ]
    width = 8 * c.hidden + 2 * c.mlp
    return Call(
        linears=(*embed, *blocks, *projector),
        attention_flops=2 * FLOPS_PER_PRODUCT * tokens**2 * c.hidden * c.layers,
        activations=2 * tokens * width * c.layers,
        cache=0,
        workspace=2 * tokens * width,
    )


def language_call(config: TicVlaConfig, graph: str, *, tokens: int, past: int) -> Call:
    """Count a call of a language graph on `tokens` new tokens after `past` in the buffers."""
    c = config.language
    attended = c.heads * c.head_dim
    kv = c.kv_heads * c.head_dim
    scored = 0 if graph == PREFILL else min(tokens, MOST_ROWS)
    linears = [Linear("embed", c.vocab, c.hidden, tokens, table=True)]
    if graph != DECODE and c.token_merge > 1:
        linears.append(Linear("merge.1", c.hidden, config.vision.token_dim * c.token_merge**2, tokens))
    for i in range(c.layers):
        linears += [
            Linear(f"layers.{i}.q", attended, c.hidden, tokens),
            Linear(f"layers.{i}.k", kv, c.hidden, tokens),
            Linear(f"layers.{i}.v", kv, c.hidden, tokens),
            Linear(f"layers.{i}.o", c.hidden, attended, tokens),
            Linear(f"layers.{i}.gate", c.mlp, c.hidden, tokens),
            Linear(f"layers.{i}.up", c.mlp, c.hidden, tokens),
            Linear(f"layers.{i}.down", c.hidden, c.mlp, tokens),
        ]
    if scored:
        # Only a call's last positions are projected onto the vocabulary.
        linears.append(Linear("lm_head", c.vocab, c.hidden, scored))
    width = 6 * c.hidden + 3 * c.mlp
    return Call(
        linears=tuple(linears),
        attention_flops=2 * FLOPS_PER_PRODUCT * tokens * (past + tokens) * attended * c.layers,
        activations=2 * tokens * width * c.layers,
        cache=2 * kv * (past + 2 * tokens) * c.layers,
        workspace=2 * tokens * width + scored * c.vocab,
    )


def context_call(config: TicVlaConfig, *, tokens: int) -> Call:
    """Count the semantic context of `tokens` tokens: one call per generation, with waypoints one per tick."""
    c = config.action
    width = config.guidance_width
    linears = [
        Linear("semantic_projection.0", c.hidden, width, tokens),
        Linear("semantic_projection.2", c.hidden, c.hidden, tokens),
    ]
    for i in range(c.layers):
        linears += [Linear(f"key_values.{i}.{part}", c.hidden, c.hidden, tokens) for part in "kv"]
    return Call(
        linears=tuple(linears),
        attention_flops=0,
        activations=2 * tokens * (width + 2 * c.hidden),
        cache=context_numbers(config, tokens),
        workspace=tokens * (width + 2 * c.hidden),
    )


def context_numbers(config: TicVlaConfig, tokens: int) -> int:
    """Return the number of values of a semantic context: keys and values of every layer."""
    return 2 * config.action.layers * tokens * config.action.hidden


def action_call(config: TicVlaConfig, *, context: int) -> Call:
    """Count one step of the action expert over `context` semantic tokens, including all passes of its head."""
    c, visual = config.action, config.vision.tokens
    now = visual + 2
    denoises = c.head == "diffusion"
    passes = c.ddim_steps if denoises else 1
    chunk = passes * c.steps
    # A diffusion's tokens also attend to one another, so the layers compute their keys and values too.
    among = c.steps if denoises else 0
    linears = [
        Linear("visual_projection.0", c.hidden, config.vision.token_dim, visual),
        Linear("visual_projection.2", c.hidden, c.hidden, visual),
        Linear("state_projection.0", c.hidden, 3, 1),
        Linear("state_projection.2", c.hidden, c.hidden, 1),
        Linear("latency_projection.0", c.hidden, 4, 1),
        Linear("latency_projection.2", c.hidden, c.hidden, 1),
    ]
    for i in range(c.layers):
        seen, times = (now + chunk, 1 + passes) if denoises else (now, 1)
        linears += [Linear(f"key_values.{i}.{part}", c.hidden, c.hidden, seen, passes=times) for part in "kv"]
        linears += [
            # Layer 0's queries are constants, unless they are noisy actions.
            *([Linear(f"layers.{i}.q", c.hidden, c.hidden, chunk, passes=passes)] if i or denoises else []),
            Linear(f"layers.{i}.o", c.hidden, c.hidden, chunk, passes=passes),
            Linear(f"layers.{i}.fc1", c.ffn, c.hidden, chunk, passes=passes),
            Linear(f"layers.{i}.fc2", c.hidden, c.ffn, chunk, passes=passes),
        ]
    linears += [Linear(f"head.{i}", c.hidden, c.hidden, chunk, passes=passes) for i in (0, 2)]
    if denoises:
        linears.append(Linear("diffusion.action_in", c.hidden, 3, chunk, passes=passes))
    if c.head == "flow":
        linears += _coupling_linears(config)
    else:
        linears.append(Linear("out", 3, c.hidden, chunk, passes=passes))
    couplings = c.couplings if c.head == "flow" else 0
    own = 6 * c.hidden + 2 * c.ffn + (2 * c.hidden if denoises else 0)
    return Call(
        linears=tuple(linears),
        attention_flops=2 * FLOPS_PER_PRODUCT * chunk * (now + context + among) * c.hidden * c.layers
        + 2 * FLOPS_PER_PRODUCT * (c.steps // 2) * ((c.steps + 1) // 2) * c.hidden * couplings,
        activations=2 * now * c.hidden * (3 + 2 * c.layers)
        + 2 * chunk * own * c.layers
        + c.steps * 8 * c.hidden * couplings,
        cache=passes * context_numbers(config, context),
        workspace=2 * now * 2 * c.hidden,
    )


def _coupling_linears(config: TicVlaConfig) -> list[Linear]:
    """Return the layers of a flow; each coupling maps half of the steps conditioned on the other half."""
    c = config.action
    linears = []
    for i in range(c.couplings):
        moved = c.steps // 2 if i % 2 else (c.steps + 1) // 2
        name, given = f"flow.couplings.{i}", c.steps - moved
        linears += [Linear(f"{name}.action_in", c.hidden, 3, given)]
        linears += [Linear(f"{name}.key_value.{part}", c.hidden, c.hidden, given) for part in "kv"]
        linears += [Linear(f"{name}.layer.{part}", c.hidden, c.hidden, moved) for part in ("q", "o", "fc1", "fc2")]
        linears += [Linear(f"{name}.out", 6, c.hidden, moved)]
    return linears
