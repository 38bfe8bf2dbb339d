"""The language model's graphs: fused attention over the caller's KV buffers, which every call extends in place.

`language_model` computes prefill and decode in one precision. The pair `language_model.prefill` (fills the buffers,
without vocabulary projection) and `language_model.decode` (reads text only) uses two precisions over the same buffers;
decode reads the prompt's last token and returns the first new one. A graph that chooses tokens does so after each of a
call's last `MOST_ROWS` positions, so that one call can verify guesses (`edge.inference.speculation`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from onnx import TensorProto
from torch import nn

from edge.artifacts.manifest import MOST_ROWS
from export.graphs.vision import array, fold_tokens, layer_norm
from export.graphs.writer import Array, GraphWriter
from export.model.language import DecoderLayer, LanguageModel
from export.quantize.precision import PRECISIONS, Precision


@dataclass(frozen=True)
class Role:
    """Purpose of a language graph."""

    images: bool
    """Whether it reads visual tokens."""
    token: bool
    """Whether it chooses the next token."""


ROLES = {
    "language_model": Role(images=True, token=True),
    "language_model.prefill": Role(images=True, token=False),
    "language_model.decode": Role(images=False, token=True),
}
EMBEDDING_FILE = "language_model.embed.{}.onnx.data"
"""File of a large token table, which both graphs of a pair share."""
SCORED = "L"
"""Free axis of the scored positions: the last `MOST_ROWS` of a call, or all of a shorter one."""
CAPACITY = "C"
"""Free axis of the KV buffers: their capacity, not the number of stored tokens."""


def cache_names(layers: int, prefix: str) -> list[str]:
    """Return the KV buffers' names, such as `past_key_values.0.key` (convention of ONNX Runtime's generative tools)."""
    return [f"{prefix}.{i}.{part}" for i in range(layers) for part in ("key", "value")]


def write_language(
    language: LanguageModel,
    directory: Path,
    name: str,
    *,
    tokens: int,
    token_dim: int,
    precision: Precision,
    half: bool,
    external: bool,
) -> list[str]:
    """Write one language graph; visual tokens are [F, tokens, token_dim]."""
    c, role = language.config, ROLES[name]
    with GraphWriter(directory, name, precision=precision, form="fused", half=half, external=external) as g:
        ids = g.input("input_ids", TensorProto.INT64, (1, "S"))
        x = _embedding(g, language, ids)
        if role.images:
            x = _insert_images(g, language, ids, x, tokens, token_dim)
        position = _Position(g, ids, rope_tables(c.rope_theta, c.head_dim, c.max_context))
        shape = (1, c.kv_heads, CAPACITY, c.head_dim)
        past = [g.input(n, g.float_type, shape) for n in cache_names(c.layers, "past_key_values")]
        delta: str | None = None
        for i, layer in enumerate(language.layers):
            x, delta = _layer(g, layer, i, x, delta, past[2 * i], past[2 * i + 1], position)
        _last_layer_kv(g, c.layers - 1, position, c.kv_heads * c.head_dim)
        g.output("last_layer_kv", TensorProto.FLOAT, (1, "S", 2 * c.kv_heads * c.head_dim))
        if role.token:
            assert delta is not None
            _next_token(g, language, x, delta)
            g.output("next_token", TensorProto.INT64, (1, SCORED))
            g.output("logits", TensorProto.FLOAT, (SCORED, c.vocab))
        for n in cache_names(c.layers, "present"):
            g.output(n, g.float_type, shape)
        return g.finish()


def rope_tables(theta: float, head_dim: int, positions: int) -> tuple[Array, Array]:
    """Compute cosines and sines [positions, head_dim/2] of the rotary embedding in float32, as the network does."""
    inverse = np.float32(theta) ** (-np.arange(0, head_dim, 2, dtype=np.float32) / np.float32(head_dim))
    angle = np.arange(positions, dtype=np.float32)[:, None] * inverse[None]
    return np.cos(angle).astype(np.float32), np.sin(angle).astype(np.float32)


class _Position:
    """Positions of a call's tokens, shared by all layers."""

    def __init__(self, g: GraphWriter, ids: str, tables: tuple[Array, Array]) -> None:
        self.seqlens = g.input("seqlens_k", TensorProto.INT32, (1,))
        self.total = g.input("total_sequence_length", TensorProto.INT32, ())
        self.cos = g.weight(tables[0].astype(g.float), "cos_cache")
        self.sin = g.weight(tables[1].astype(g.float), "sin_cache")
        self.end = g.op("Reshape", [g.cast(self.total, TensorProto.INT64), g.constant([1])])
        self.begin = g.op("Sub", [self.end, g.op("Shape", [ids], start=1, end=2)])


def _embedding(g: GraphWriter, language: LanguageModel, ids: str) -> str:
    """Write the lookup of token embeddings [1, S, hidden]; stored in 16 or 8 bits, computed in the graph's type."""
    table, precision = array(language.embed.weight), g.precision.of("embed")
    if precision in ("fp32", "fp16"):
        stored = table.astype(np.float16 if precision == "fp16" else np.float32)
        rows = g.op("Gather", [g.shared_weight(stored, "embed.weight", EMBEDDING_FILE.format(precision)), ids])
        return rows if stored.dtype == g.float else g.cast(rows, g.float_type)
    largest = np.abs(table).max(axis=1, keepdims=True)
    scales = np.where(largest > 0, largest / 127, 1).astype(np.float32)
    codes = np.empty(table.shape, dtype=np.int8)
    for start in range(0, len(table), 8192):
        rows_ = slice(start, start + 8192)
        codes[rows_] = np.rint(table[rows_] / scales[rows_])
    rows = g.cast(
        g.op("Gather", [g.shared_weight(codes, "embed.weight", EMBEDDING_FILE.format("int8")), ids]), g.float_type
    )
    scale = g.op("Gather", [g.weight(scales.astype(g.float), "embed.scale"), ids])
    return g.op("Mul", [rows, scale])


def _insert_images(g: GraphWriter, language: LanguageModel, ids: str, text: str, tokens: int, token_dim: int) -> str:
    """Replace `<IMG_CONTEXT>` by visual tokens in order, from `image_offset` on (the number used by earlier calls)."""
    c = language.config
    visual = g.input("visual_tokens", TensorProto.FLOAT, ("F", tokens, token_dim))
    offset = g.input("image_offset", TensorProto.INT64, (1,))
    images = g.cast(visual, g.float_type) if g.half else visual
    images = fold_tokens(g, images, round(tokens**0.5), c.token_merge, token_dim)
    if c.token_merge > 1:
        assert isinstance(language.merge, nn.Sequential)
        norm, linear = language.merge
        assert isinstance(norm, nn.LayerNorm) and isinstance(linear, nn.Linear)
        images = layer_norm(g, images, norm, "merge.0")
        images = g.linear(images, "merge.1", array(linear.weight), array(linear.bias))
    images = g.op("Reshape", [images, g.constant([-1, c.hidden])])
    is_image = g.op("Equal", [ids, g.constant([[c.img_context_id]])])
    count = g.op("CumSum", [g.cast(is_image, TensorProto.INT64), g.constant(1)])
    place = g.op("Add", [g.op("Sub", [count, g.constant([1])]), offset])
    # The index at a text position is unused. The prompt builder never makes more image positions than image tokens.
    last = g.op("Sub", [g.op("Shape", [images], start=0, end=1), g.constant([1])])
    place = g.op("Min", [g.op("Max", [place, g.constant([0])]), last])
    rows = g.op("Gather", [images, place])
    return g.op("Where", [g.op("Unsqueeze", [is_image, g.constant([2])]), rows, text])


def _norm(g: GraphWriter, x: str, delta: str | None, weight: str, eps: float) -> tuple[str, str]:
    """Write the RMS norm of x + delta; returns it and the sum."""
    if delta is None:
        return g.op("SimplifiedLayerNormalization", [x, weight], axis=-1, epsilon=eps, stash_type=1), x
    outputs = [g.unique("normed"), "", "", g.unique("residual")]
    inputs = [x, delta, weight]
    h, _, _, total = g.ops("SkipSimplifiedLayerNormalization", inputs, outputs, contrib=True, epsilon=eps)
    return h, total


def _layer(
    g: GraphWriter,
    layer: DecoderLayer,
    index: int,
    x: str,
    delta: str | None,
    past_key: str,
    past_value: str,
    position: _Position,
) -> tuple[str, str]:
    """Write one decoder layer; returns the residual and the summand that the next norm adds to it."""
    c, name = layer.config, f"layers.{index}"
    gain = g.floats(array(layer.input_norm.weight), f"{name}.input_norm")
    h, x = _norm(g, x, delta, gain, c.rms_eps)
    weight = np.concatenate([array(m.weight) for m in (layer.q, layer.k, layer.v)])
    bias = np.concatenate([array(m.bias) for m in (layer.q, layer.k, layer.v)])
    # One product for queries, keys and values, in the most exact precision of the three.
    exact = min((g.precision.of(f"{name}.{part}") for part in "qkv"), key=PRECISIONS.index)
    qkv = g.linear(h, f"{name}.qkv", weight, bias, precision=exact)
    attended, _, _ = g.ops(
        "GroupQueryAttention",
        [qkv, "", "", past_key, past_value, position.seqlens, position.total, position.cos, position.sin],
        [g.unique("attended"), f"present.{index}.key", f"present.{index}.value"],
        contrib=True,
        num_heads=c.heads,
        kv_num_heads=c.kv_heads,
        do_rotary=1,
        rotary_interleaved=0,
        scale=c.head_dim**-0.5,
    )
    delta = g.linear(attended, f"{name}.o", array(layer.o.weight), None)
    gain = g.floats(array(layer.mlp_norm.weight), f"{name}.mlp_norm")
    h, x = _norm(g, x, delta, gain, c.rms_eps)
    gate = g.linear(h, f"{name}.gate", array(layer.gate.weight), None)
    up = g.linear(h, f"{name}.up", array(layer.up.weight), None)
    # QuickGelu with alpha 1 is x·sigmoid(x), which is SiLU.
    h = g.op("Mul", [g.op("QuickGelu", [gate], contrib=True, alpha=1.0), up])
    return x, g.linear(h, f"{name}.down", array(layer.down.weight), None)


def _last_layer_kv(g: GraphWriter, last: int, position: _Position, width: int) -> None:
    """Slice the new tokens' keys and values [1, S, kv_dim] from the last layer's buffers."""
    parts = []
    for part in ("key", "value"):
        new = g.op("Slice", [f"present.{last}.{part}", position.begin, position.end, g.constant([2])])
        parts.append(g.op("Reshape", [g.op("Transpose", [new], perm=[0, 2, 1, 3]), g.constant([1, -1, width])]))
    g.to_float32(g.op("Concat", parts, axis=2), "last_layer_kv")


def _next_token(g: GraphWriter, language: LanguageModel, x: str, delta: str) -> None:
    """Write the greedy choice after each of the last positions; only these are projected onto the vocabulary."""
    c = language.config
    last = [
        g.op("Slice", [t, g.constant([-MOST_ROWS]), g.constant([np.iinfo(np.int64).max]), g.constant([1])])
        for t in (x, delta)
    ]
    h, _ = _norm(g, last[0], last[1], g.floats(array(language.norm.weight), "norm"), c.rms_eps)
    h = g.op("Reshape", [h, g.constant([-1, c.hidden])])
    logits = g.to_float32(g.linear(h, "lm_head", array(language.lm_head.weight), None), "logits")
    chosen = g.op("ArgMax", [logits], axis=-1, keepdims=0)
    g.op("Unsqueeze", [chosen, g.constant([0])], out="next_token")
