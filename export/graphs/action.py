"""The action expert's two graphs: one depends on the semantic state alone, the other runs in every tick.

A head's loop is unrolled and its noise is stored, so the graphs have no loop and no randomness.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from pathlib import Path

import numpy as np
import torch
from onnx import TensorProto
from torch import nn
from torch.nn import functional as F  # noqa: N812 - torch's own idiom

from export.graphs.vision import array, layer_norm, merge_heads, split_heads
from export.graphs.writer import Array, GraphWriter
from export.model.action import ActionExpert
from export.model.attention import CrossAttentionLayer, KeyValue
from export.model.config import TicVlaConfig
from export.model.heads import MAX_LOG_SCALE, Coupling, Diffusion, Flow, ddim_steps, halved, weave
from export.quantize.precision import Precision

TOKENS = "T"


def context_shapes(config: TicVlaConfig) -> dict[str, tuple[int | str, ...]]:
    """Return name → shape of the semantic context's tensors; keys are [1, H, d, T], as the product reads them."""
    c = config.action
    head_dim = c.hidden // c.heads
    tokens = guidance_input(config)[1][1]
    shapes: dict[str, tuple[int | str, ...]] = {}
    for i in range(c.layers):
        shapes[f"context.{i}.key"] = (1, c.heads, head_dim, tokens)
        shapes[f"context.{i}.value"] = (1, c.heads, tokens, head_dim)
    return shapes


def guidance_input(config: TicVlaConfig) -> tuple[str, tuple[int | str, ...]]:
    """Return name and shape of the semantic context's input: `last_layer_kv` or `waypoints`."""
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
            x = g.op("Mul", [x, g.constant(array(action.scale.std), "std")])
            x = g.op("Add", [x, g.constant(array(action.scale.mean), "mean")])
        _trajectory(g, x, c.parameterisation)
        g.output("trajectory", TensorProto.FLOAT, (1, c.steps, 3))
        return g.finish()


def _features(g: GraphWriter, action: ActionExpert, now: str, split: str) -> str:
    """Attend with each step's query to the present and the semantic context, of lengths `split`."""
    x: str | None = None
    for i, (pair, layer) in enumerate(zip(action.key_values, action.layers, strict=True)):
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
    """Write the tokens of the present [1, N + 2, hidden]."""
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
    """Compute the first layer's queries [1, heads, steps, d], which depend on no input, as a constant."""
    c = action.config.action
    weight, bias = query_weights(layer)
    queries = action.queries.detach().float()
    normed = F.layer_norm(queries, (c.hidden,), layer.norm1.weight.detach(), layer.norm1.bias.detach(), layer.norm1.eps)
    q: Array = (array(normed).astype(np.float64) @ weight.T.astype(np.float64) + bias).astype(np.float32)
    return q.reshape(1, c.steps, c.heads, -1).transpose(0, 2, 1, 3)


def _trajectory(g: GraphWriter, steps: str, parameterisation: str) -> None:
    """Sum increments into poses; of offsets, which are positions, sum only the headings."""
    axis = g.constant(1)
    if parameterisation == "increments":
        g.op("CumSum", [steps, axis], out="trajectory")
        return
    position = g.op("Slice", [steps, g.constant([0]), g.constant([2]), g.constant([2])])
    heading = g.op("CumSum", [g.op("Slice", [steps, g.constant([2]), g.constant([3]), g.constant([2])]), axis])
    g.op("Concat", [position, heading], axis=2, out="trajectory")


def denoised(g: GraphWriter, action: ActionExpert, diffusion: Diffusion, now: str, split: str) -> str:
    """Write the denoising passes: tokens of the present → normalised actions [1, steps, 3] in fp32.

    `split`: lengths of present, context and chunk. All passes share the keys and values of present and context. Actions
    stay in fp32 between the layers, because errors would add up over the passes.
    """
    c = action.config.action
    present = [key_values(g, now, f"key_values.{i}", pair) for i, pair in enumerate(action.key_values)]
    x = g.constant(array(diffusion.noise), "noise")
    for time, a, b in ddim_steps(c.diffusion_steps, c.ddim_steps):
        clean = _clean(g, action, diffusion, x, time, present, split)
        if a == 0 and b == 1:
            x = clean
            continue
        kept = g.op("Mul", [x, g.constant(np.float32(a), "ddim")])
        x = g.op("Add", [kept, g.op("Mul", [clean, g.constant(np.float32(b), "ddim")])])
    return x


def _clean(
    g: GraphWriter,
    action: ActionExpert,
    diffusion: Diffusion,
    noisy: str,
    time: int,
    present: list[tuple[str, str]],
    split: str,
) -> str:
    """Write one pass of the denoiser."""
    with torch.no_grad():
        places = action.queries + diffusion.time_tokens(torch.tensor([time]))
    x = g.linear(g.from_float32(noisy), "diffusion.action_in", *weights(diffusion.action_in))
    x = g.op("Add", [x, g.floats(array(places), "places")])
    for i, (pair, layer) in enumerate(zip(action.key_values, action.layers, strict=True)):
        name = f"layers.{i}"
        normed = layer_norm(g, x, layer.norm1, f"{name}.norm1")
        own = key_values(g, normed, f"key_values.{i}", pair)
        keys, values = (present[i][0], f"context.{i}.key", own[0]), (present[i][1], f"context.{i}.value", own[1])
        x = attend(g, x, name, layer, query(g, normed, name, layer), keys, values, split)
    x = mlp(g, layer_norm(g, x, action.norm, "norm"), "head", action.head)
    return g.in_float32(g.linear(x, "out", *weights(action.out)))


def flowed(g: GraphWriter, flow: Flow, features: str) -> str:
    """Write the flow: features [1, steps, hidden] → normalised actions [1, steps, 3] in fp32."""
    steps = flow.noise.shape[1]
    halves = [g.constant(array(half), "noise") for half in halved(flow.noise)]
    end, axis, stride = (g.constant([value]) for value in (steps, 1, 2))
    step_features = [g.op("Slice", [features, g.constant([start]), end, axis, stride]) for start in (0, 1)]
    for i, coupling in enumerate(flow.couplings):
        moved, given = i % 2, 1 - i % 2
        name = f"flow.couplings.{i}"
        log_scale, shift = _affine(g, name, coupling, halves[given], step_features[given], step_features[moved])
        bounded = g.op("Tanh", [g.op("Mul", [log_scale, g.constant(np.float32(1 / MAX_LOG_SCALE), "bound")])])
        scale = g.op("Exp", [g.op("Mul", [bounded, g.constant(np.float32(MAX_LOG_SCALE), "bound")])])
        halves[moved] = g.op("Add", [g.op("Mul", [halves[moved], scale]), shift])
    order = g.constant(np.array(weave(steps), np.int64), "order")
    return g.op("Gather", [g.op("Concat", halves, axis=1), order], axis=1)


def _affine(
    g: GraphWriter, name: str, coupling: Coupling, given: str, given_features: str, features: str
) -> tuple[str, str]:
    """Write the unbounded logarithm of the scale, and the shift, in fp32."""
    layer = coupling.layer
    own = g.linear(g.from_float32(given), f"{name}.action_in", *weights(coupling.action_in))
    keys, values = key_values(g, g.op("Add", [given_features, own]), f"{name}.key_value", coupling.key_value)
    normed = layer_norm(g, features, layer.norm1, f"{name}.layer.norm1")
    q = query(g, normed, f"{name}.layer", layer)
    x = attend(g, features, f"{name}.layer", layer, q, [keys], [values])
    out = g.linear(layer_norm(g, x, coupling.norm, f"{name}.norm"), f"{name}.out", *weights(coupling.out))
    parts = [g.unique("log_scale"), g.unique("shift")]
    log_scale, shift = g.ops("Split", [g.in_float32(out), g.constant([3, 3])], parts, axis=2)
    return log_scale, shift


def weights(module: nn.Linear) -> tuple[Array, Array]:
    """Return weight [out, in] and bias [out] of a layer."""
    return array(module.weight), array(module.bias)


def mlp(g: GraphWriter, x: str, name: str, module: nn.Sequential) -> str:
    """Write a `projection`."""
    first, _, second = module
    assert isinstance(first, nn.Linear) and isinstance(second, nn.Linear)
    x = g.op("Gelu", [g.linear(x, f"{name}.0", *weights(first))])
    return g.linear(x, f"{name}.2", *weights(second))


def key_values(g: GraphWriter, tokens: str, name: str, pair: KeyValue) -> tuple[str, str]:
    """Write keys [1, heads, d, T] and values [1, heads, T, d] of tokens [1, T, hidden]."""
    k = g.linear(tokens, f"{name}.k", *weights(pair.k))
    v = g.linear(tokens, f"{name}.v", *weights(pair.v))
    return split_heads(g, k, pair.heads, keys=True), split_heads(g, v, pair.heads)


def query_weights(layer: CrossAttentionLayer) -> tuple[Array, Array]:
    """Return weight and bias of the queries, multiplied by the softmax's scale."""
    scale = np.float32((layer.q.out_features // layer.heads) ** -0.5)
    weight, bias = weights(layer.q)
    return weight * scale, bias * scale


def query(g: GraphWriter, normed: str, name: str, layer: CrossAttentionLayer) -> str:
    """Write the queries [1, heads, S, d] of normed tokens [1, S, hidden]."""
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
    """Write a layer with queries `q` over sets of keys and values of lengths `split`; returns tokens [1, S, hidden].

    Keys and values are not concatenated: the scores of the sets are joined before the softmax and split after it. This
    is the same sum in another order, exact up to rounding.
    """
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
