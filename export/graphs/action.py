"""The action expert's two graphs: what depends on the semantic state alone, and what changes every tick."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from onnx import TensorProto
from torch.nn import functional as F  # noqa: N812 - torch's own idiom

from export.graphs.action_heads import denoised, flowed, in_metres
from export.graphs.cross_attention import attend, key_values, mlp, query, query_weights, weights
from export.graphs.vision import array, layer_norm, split_heads
from export.graphs.writer import Array, GraphWriter
from export.model.action import ActionExpert
from export.model.attention import CrossAttentionLayer, KeyValue
from export.model.config import TicVlaConfig
from export.quantize.precision import Precision

TOKENS = "T"


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
        x = mlp(g, x, "semantic_projection", action.semantic_projection)
        table = g.weight(array(action.semantic_position).astype(g.float), "semantic_position")
        last = [table, g.op("Neg", [length]), g.constant([np.iinfo(np.int64).max]), g.constant([1])]
        x = g.op("Add", [x, g.op("Slice", last)])
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
        lengths = [g.constant([vision.tokens + 2]), g.op("Shape", ["context.0.key"], start=3, end=4)]
        if action.diffusion is not None:
            lengths.append(g.constant([c.steps]))
        split = g.op("Concat", lengths, axis=0)
        if action.diffusion is not None:
            x = denoised(g, action, action.diffusion, now, split)
        elif action.flow is not None:
            x = flowed(g, action.flow, _features(g, action, now, split))
        else:
            x = g.linear(_features(g, action, now, split), "out", *weights(action.out))
            x = g.in_float32(x)
        if action.scale is not None:
            x = in_metres(g, action.scale, x)
        _trajectory(g, x, c.parameterisation)
        g.output("trajectory", TensorProto.FLOAT, (1, c.steps, 3))
        return g.finish()


def _features(g: GraphWriter, action: ActionExpert, now: str, split: str) -> str:
    """What each step's query finds in the present and the semantic context, whose lengths `split` gives."""
    x: str | None = None
    for i, (pair, layer) in enumerate(zip(action.key_values, action.layers, strict=True)):
        assert isinstance(pair, KeyValue) and isinstance(layer, CrossAttentionLayer)
        name = f"layers.{i}"
        key, value = key_values(g, now, f"key_values.{i}", pair)
        if x is None:
            x = g.floats(array(action.queries), "queries")
            q = g.floats(_first_query(action, layer), f"{name}.q")
        else:
            q = query(g, layer_norm(g, x, layer.norm1, f"{name}.norm1"), name, layer)
        x = attend(g, x, name, layer, q, (key, f"context.{i}.key"), (value, f"context.{i}.value"), split)
    assert x is not None
    return mlp(g, layer_norm(g, x, action.norm, "norm"), "head", action.head)


def _now_tokens(g: GraphWriter, action: ActionExpert, visual: str, state: str, latency: str) -> str:
    """Tokens of the present [1, N + 2, hidden]."""
    c = action.config.action
    if not c.latency_aware:
        latency = g.op("Mul", [latency, g.constant(np.zeros(4, np.float32))])
    elif not c.motion_offset:
        latency = g.op("Mul", [latency, g.constant(np.array([1, 0, 0, 0], np.float32))])
    if g.half:
        visual, state, latency = (g.cast(t, g.float_type) for t in (visual, state, latency))
    x = mlp(g, visual, "visual_projection", action.visual_projection)
    x = g.op("Add", [x, g.weight(array(action.visual_position).astype(g.float), "visual_position")])
    metadata = [
        mlp(g, state, "state_projection", action.state_projection),
        mlp(g, latency, "latency_projection", action.latency_projection),
    ]
    rows = g.op("Unsqueeze", [g.op("Concat", metadata, axis=0), g.constant([0])])
    rows = g.op("Add", [rows, g.floats(array(action.metadata_position), "metadata_position")])
    return g.op("Concat", [x, rows], axis=1)


def _first_query(action: ActionExpert, layer: CrossAttentionLayer) -> Array:
    """The first layer's queries do not depend on any input: [1, heads, steps, d], computed here once for all."""
    c = action.config.action
    weight, bias = query_weights(layer)
    queries = action.queries.detach().float()
    normed = F.layer_norm(queries, (c.hidden,), layer.norm1.weight.detach(), layer.norm1.bias.detach(), layer.norm1.eps)
    q: Array = (array(normed).astype(np.float64) @ weight.T.astype(np.float64) + bias).astype(np.float32)
    return q.reshape(1, c.steps, c.heads, -1).transpose(0, 2, 1, 3)


def _trajectory(g: GraphWriter, steps: str, parameterisation: str) -> None:
    """Increments are summed into poses; offsets are positions already and only their headings are summed."""
    axis = g.constant(1)
    if parameterisation == "increments":
        g.op("CumSum", [steps, axis], out="trajectory")
        return
    position = g.op("Slice", [steps, g.constant([0]), g.constant([2]), g.constant([2])])
    heading = g.op("CumSum", [g.op("Slice", [steps, g.constant([2]), g.constant([3]), g.constant([2])]), axis])
    g.op("Concat", [position, heading], axis=2, out="trajectory")
