"""The action expert's two graphs: what depends on the semantic state alone, and what changes every tick.

Nothing is concatenated along the tokens: scores against the present and against the semantic context are joined before
the softmax and parted again after it, so that the large keys and values are read where they lie. That is the same
sum in another order, hence exact up to rounding.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from onnx import TensorProto
from torch import nn
from torch.nn import functional as F  # noqa: N812 - torch's own idiom

from export.graphs.vision import array, layer_norm, merge_heads, split_heads
from export.graphs.writer import Array, GraphWriter
from export.model.action import ActionExpert, CrossAttentionLayer, KeyValue
from export.model.config import TicVlaConfig
from export.precision import Precision

TOKENS = "T"


def _mlp(g: GraphWriter, x: str, name: str, module: nn.Sequential) -> str:
    first, _, second = module
    assert isinstance(first, nn.Linear) and isinstance(second, nn.Linear)
    x = g.op("Gelu", [g.linear(x, f"{name}.0", array(first.weight), array(first.bias))])
    return g.linear(x, f"{name}.2", array(second.weight), array(second.bias))


def context_shapes(config: TicVlaConfig) -> dict[str, tuple[int | str, ...]]:
    """Tensors of the semantic context: a layer's keys lie as its product reads them, [1, H, d, T]."""
    c = config.action
    head_dim = c.hidden // c.heads
    tokens = guidance_input(config)[1][1]
    shapes: dict[str, tuple[int | str, ...]] = {}
    for i in range(c.layers):
        shapes[f"context.{i}.key"] = (1, c.heads, head_dim, tokens)
        shapes[f"context.{i}.value"] = (1, c.heads, tokens, head_dim)
    return shapes


def guidance_input(config: TicVlaConfig) -> tuple[str, tuple[int | str, ...]]:
    """Name and shape of what the semantic context is made from: `last_layer_kv` or `waypoints`."""
    if config.action.semantic_interface == "waypoints":
        return "waypoints", (1, config.guidance_tokens, config.guidance_width)
    return "last_layer_kv", (1, TOKENS, config.kv_dim)


def write_context(action: ActionExpert, directory: Path, *, precision: Precision, form: str, half: bool) -> list[str]:
    """Write semantic_context.onnx: `guidance_input` → the tensors of `context_shapes`."""
    c = action.config.action
    with GraphWriter(directory, "semantic_context", precision=precision, form=form, half=half, external=False) as g:
        kv_dim = action.config.kv_dim
        name, shape = guidance_input(action.config)
        x = g.input(name, TensorProto.FLOAT, shape)
        length = g.op("Shape", [x], start=1, end=2)
        if c.semantic_interface == "values-only":
            x = g.op("Slice", [x, g.constant([kv_dim // 2]), g.constant([kv_dim]), g.constant([2])])
        if g.half:
            x = g.cast(x, g.float_type)
        x = _mlp(g, x, "semantic_projection", action.semantic_projection)
        table = g.weight(array(action.semantic_position).astype(g.float), "semantic_position")
        x = g.op("Add", [x, g.op("Slice", [table, g.constant([0]), length, g.constant([1])])])
        for i, pair in enumerate(action.key_values):
            assert isinstance(pair, KeyValue)
            k = g.linear(x, f"key_values.{i}.k", array(pair.k.weight), array(pair.k.bias))
            v = g.linear(x, f"key_values.{i}.v", array(pair.v.weight), array(pair.v.bias))
            split_heads(g, k, c.heads, keys=True, out=f"context.{i}.key")
            split_heads(g, v, c.heads, out=f"context.{i}.value")
        for name, shape in context_shapes(action.config).items():
            g.output(name, g.float_type, shape)
        return g.finish()


def write_action(action: ActionExpert, directory: Path, *, precision: Precision, form: str, half: bool) -> list[str]:
    """Write action_expert.onnx: visual tokens, state, latency and semantic context → trajectory [1, steps, 3]."""
    c, vision = action.config.action, action.config.vision
    with GraphWriter(directory, "action_expert", precision=precision, form=form, half=half, external=False) as g:
        visual = g.input("visual_tokens", TensorProto.FLOAT, (1, vision.tokens, vision.token_dim))
        state = g.input("state", TensorProto.FLOAT, (1, 3))
        latency = g.input("latency", TensorProto.FLOAT, (1, 4))
        for name, shape in context_shapes(action.config).items():
            g.input(name, g.float_type, shape)
        now = _now_tokens(g, action, visual, state, latency)
        split = g.op(
            "Concat", [g.constant([vision.tokens + 2]), g.op("Shape", ["context.0.key"], start=3, end=4)], axis=0
        )
        x: str | None = None
        for i, (pair, layer) in enumerate(zip(action.key_values, action.layers, strict=True)):
            assert isinstance(pair, KeyValue) and isinstance(layer, CrossAttentionLayer)
            k = g.linear(now, f"key_values.{i}.k", array(pair.k.weight), array(pair.k.bias))
            v = g.linear(now, f"key_values.{i}.v", array(pair.v.weight), array(pair.v.bias))
            keys = (split_heads(g, k, c.heads, keys=True), f"context.{i}.key")
            values = (split_heads(g, v, c.heads), f"context.{i}.value")
            x = _cross_attention(g, action, layer, i, x, keys, values, split)
        assert x is not None
        x = layer_norm(g, x, action.norm, "norm")
        x = _mlp(g, x, "head", action.head)
        x = g.linear(x, "out", array(action.out.weight), array(action.out.bias))
        if g.half:
            x = g.cast(x, TensorProto.FLOAT)
        _trajectory(g, x, c.parameterisation)
        g.output("trajectory", TensorProto.FLOAT, (1, c.steps, 3))
        return g.finish()


def _now_tokens(g: GraphWriter, action: ActionExpert, visual: str, state: str, latency: str) -> str:
    """Tokens of the present [1, N + 2, hidden]."""
    c = action.config.action
    if not c.latency_aware:
        latency = g.op("Mul", [latency, g.constant(np.zeros(4, np.float32))])
    elif not c.motion_offset:
        latency = g.op("Mul", [latency, g.constant(np.array([1, 0, 0, 0], np.float32))])
    if g.half:
        visual, state, latency = (g.cast(t, g.float_type) for t in (visual, state, latency))
    x = _mlp(g, visual, "visual_projection", action.visual_projection)
    x = g.op("Add", [x, g.weight(array(action.visual_position).astype(g.float), "visual_position")])
    metadata = [
        _mlp(g, state, "state_projection", action.state_projection),
        _mlp(g, latency, "latency_projection", action.latency_projection),
    ]
    rows = g.op("Unsqueeze", [g.op("Concat", metadata, axis=0), g.constant([0])])
    rows = g.op("Add", [rows, g.floats(array(action.metadata_position), "metadata_position")])
    return g.op("Concat", [x, rows], axis=1)


def _first_query(action: ActionExpert, layer: CrossAttentionLayer, weight: Array, bias: Array) -> Array:
    """The first layer's queries do not depend on any input: [1, heads, steps, d], computed here once for all."""
    c = action.config.action
    queries = action.queries.detach().float()
    normed = F.layer_norm(queries, (c.hidden,), layer.norm1.weight.detach(), layer.norm1.bias.detach(), layer.norm1.eps)
    q: Array = (array(normed).astype(np.float64) @ weight.T.astype(np.float64) + bias).astype(np.float32)
    return q.reshape(1, c.steps, c.heads, -1).transpose(0, 2, 1, 3)


def _cross_attention(
    g: GraphWriter,
    action: ActionExpert,
    layer: CrossAttentionLayer,
    index: int,
    x: str | None,
    keys: tuple[str, str],
    values: tuple[str, str],
    split: str,
) -> str:
    c, name = action.config.action, f"layers.{index}"
    scale = np.float32((c.hidden // c.heads) ** -0.5)
    weight, bias = array(layer.q.weight) * scale, array(layer.q.bias) * scale
    if x is None:
        x = g.floats(array(action.queries), "queries")
        q = g.floats(_first_query(action, layer, weight, bias), f"{name}.q")
    else:
        q = split_heads(g, g.linear(layer_norm(g, x, layer.norm1, f"{name}.norm1"), f"{name}.q", weight, bias), c.heads)
    scores = g.op("Concat", [g.op("MatMul", [q, k]) for k in keys], axis=3)
    shares = g.ops("Split", [g.op("Softmax", [scores], axis=-1), split], [g.unique("share"), g.unique("share")], axis=3)
    parts = [g.op("MatMul", [share, v]) for share, v in zip(shares, values, strict=True)]
    attended = merge_heads(g, g.op("Add", parts))
    x = g.op("Add", [x, g.linear(attended, f"{name}.o", array(layer.o.weight), array(layer.o.bias))])
    h = g.linear(layer_norm(g, x, layer.norm2, f"{name}.norm2"), f"{name}.fc1", *_weights(layer.fc1))
    return g.op("Add", [x, g.linear(g.op("Gelu", [h]), f"{name}.fc2", *_weights(layer.fc2))])


def _weights(module: nn.Linear) -> tuple[Array, Array]:
    return array(module.weight), array(module.bias)


def _trajectory(g: GraphWriter, steps: str, parameterisation: str) -> None:
    """Increments are summed into poses; offsets are positions already and only their headings are summed."""
    axis = g.constant(1)
    if parameterisation == "increments":
        g.op("CumSum", [steps, axis], out="trajectory")
        return
    position = g.op("Slice", [steps, g.constant([0]), g.constant([2]), g.constant([2])])
    heading = g.op("CumSum", [g.op("Slice", [steps, g.constant([2]), g.constant([3]), g.constant([2])]), axis])
    g.op("Concat", [position, heading], axis=2, out="trajectory")
