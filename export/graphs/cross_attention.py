"""Cross-attention layers as graph nodes, over several sets of keys and values that are read where they lie.

Nothing is concatenated along the tokens: scores against each set are joined before the softmax and parted again after
it. That is the same sum in another order, hence exact up to rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import numpy as np
from torch import nn

from export.graphs.vision import array, layer_norm, merge_heads, split_heads
from export.graphs.writer import Array, GraphWriter
from export.model.attention import CrossAttentionLayer, KeyValue


def weights(module: nn.Linear) -> tuple[Array, Array]:
    """Weight [out, in] and bias [out]."""
    return array(module.weight), array(module.bias)


def mlp(g: GraphWriter, x: str, name: str, module: nn.Sequential) -> str:
    """A `projection`."""
    first, _, second = module
    assert isinstance(first, nn.Linear) and isinstance(second, nn.Linear)
    x = g.op("Gelu", [g.linear(x, f"{name}.0", *weights(first))])
    return g.linear(x, f"{name}.2", *weights(second))


def key_values(g: GraphWriter, tokens: str, name: str, pair: KeyValue) -> tuple[str, str]:
    """Keys [1, heads, d, T], as their product reads them, and values [1, heads, T, d] of tokens [1, T, hidden]."""
    k = g.linear(tokens, f"{name}.k", *weights(pair.k))
    v = g.linear(tokens, f"{name}.v", *weights(pair.v))
    return split_heads(g, k, pair.heads, keys=True), split_heads(g, v, pair.heads)


def query_weights(layer: CrossAttentionLayer) -> tuple[Array, Array]:
    """Weight and bias of the queries, the softmax's scale included."""
    scale = np.float32((layer.q.out_features // layer.heads) ** -0.5)
    weight, bias = weights(layer.q)
    return weight * scale, bias * scale


def query(g: GraphWriter, normed: str, name: str, layer: CrossAttentionLayer) -> str:
    """Queries [1, heads, S, d] of normed tokens [1, S, hidden]."""
    return split_heads(g, g.linear(normed, f"{name}.q", *query_weights(layer)), layer.heads)


def attend(
    g: GraphWriter,
    x: str,
    name: str,
    layer: CrossAttentionLayer,
    q: str,
    keys: Sequence[str],
    values: Sequence[str],
    split: str | None = None,
) -> str:
    """Tokens [1, S, hidden] after a layer with queries `q` over sets of keys and values; `split`: the sets' lengths."""
    scores = [g.op("MatMul", [q, k]) for k in keys]
    if split is None:
        shares = [g.op("Softmax", scores, axis=-1)]
    else:
        softmax = g.op("Softmax", [g.op("Concat", scores, axis=3)], axis=-1)
        shares = g.ops("Split", [softmax, split], [g.unique("share") for _ in keys], axis=3)
    parts = [g.op("MatMul", [share, v]) for share, v in zip(shares, values, strict=True)]
    attended = merge_heads(g, reduce(lambda a, b: g.op("Add", [a, b]), parts))
    x = g.op("Add", [x, g.linear(attended, f"{name}.o", *weights(layer.o))])
    h = g.linear(layer_norm(g, x, layer.norm2, f"{name}.norm2"), f"{name}.fc1", *weights(layer.fc1))
    return g.op("Add", [x, g.linear(g.op("Gelu", [h]), f"{name}.fc2", *weights(layer.fc2))])
