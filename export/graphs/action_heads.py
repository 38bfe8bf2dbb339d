"""The heads that denoise or flow a chunk of actions, unrolled: no loop and no chance is left in the graph.

A diffusion's passes share the keys and values of the present and of the semantic context, which are made once; only
the chunk's own tokens go through the layers again. Actions are kept in fp32 between the layers: they are few, and each
pass builds on the one before.
"""

from __future__ import annotations

import numpy as np
import torch

from export.graphs.cross_attention import attend, key_values, mlp, query, weights
from export.graphs.vision import array, layer_norm
from export.graphs.writer import GraphWriter
from export.model.action import ActionExpert
from export.model.attention import CrossAttentionLayer, KeyValue
from export.model.heads import MAX_LOG_SCALE, ActionScale, Coupling, Diffusion, Flow, ddim_steps, halved, weave


def denoised(g: GraphWriter, action: ActionExpert, diffusion: Diffusion, now: str, split: str) -> str:
    """Tokens of the present → normalised actions [1, steps, 3] in fp32; `split`: lengths of present, context, chunk."""
    c = action.config.action
    present = []
    for i, pair in enumerate(action.key_values):
        assert isinstance(pair, KeyValue)
        present.append(key_values(g, now, f"key_values.{i}", pair))
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
    """One pass of the denoiser."""
    with torch.no_grad():
        places = action.queries + diffusion.time_tokens(torch.tensor([time]))
    x = g.linear(g.from_float32(noisy), "diffusion.action_in", *weights(diffusion.action_in))
    x = g.op("Add", [x, g.floats(array(places), "places")])
    for i, (pair, layer) in enumerate(zip(action.key_values, action.layers, strict=True)):
        assert isinstance(pair, KeyValue) and isinstance(layer, CrossAttentionLayer)
        name = f"layers.{i}"
        normed = layer_norm(g, x, layer.norm1, f"{name}.norm1")
        own = key_values(g, normed, f"key_values.{i}", pair)
        keys, values = (present[i][0], f"context.{i}.key", own[0]), (present[i][1], f"context.{i}.value", own[1])
        x = attend(g, x, name, layer, query(g, normed, name, layer), keys, values, split)
    x = mlp(g, layer_norm(g, x, action.norm, "norm"), "head", action.head)
    return g.in_float32(g.linear(x, "out", *weights(action.out)))


def flowed(g: GraphWriter, flow: Flow, features: str) -> str:
    """Features [1, steps, hidden] → normalised actions [1, steps, 3] in fp32."""
    steps = flow.noise.shape[1]
    halves = [g.constant(array(half), "noise") for half in halved(flow.noise)]
    end, axis, stride = (g.constant([value]) for value in (steps, 1, 2))
    seen = [g.op("Slice", [features, g.constant([start]), end, axis, stride]) for start in (0, 1)]
    for i, coupling in enumerate(flow.couplings):
        assert isinstance(coupling, Coupling)
        moved, given = i % 2, 1 - i % 2
        name = f"flow.couplings.{i}"
        log_scale, shift = _affine(g, name, coupling, halves[given], seen[given], seen[moved])
        bounded = g.op("Tanh", [g.op("Mul", [log_scale, g.constant(np.float32(1 / MAX_LOG_SCALE), "bound")])])
        scale = g.op("Exp", [g.op("Mul", [bounded, g.constant(np.float32(MAX_LOG_SCALE), "bound")])])
        halves[moved] = g.op("Add", [g.op("Mul", [halves[moved], scale]), shift])
    order = g.constant(np.array(weave(steps), np.int64), "order")
    return g.op("Gather", [g.op("Concat", halves, axis=1), order], axis=1)


def _affine(
    g: GraphWriter, name: str, coupling: Coupling, given: str, given_features: str, features: str
) -> tuple[str, str]:
    """Logarithm of the scale before it is bounded, and shift, in fp32."""
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


def in_metres(g: GraphWriter, scale: ActionScale, normalised: str) -> str:
    """Normalised actions [1, steps, 3] in fp32 → actions in m and rad."""
    spread = g.op("Mul", [normalised, g.constant(array(scale.std), "std")])
    return g.op("Add", [spread, g.constant(array(scale.mean), "mean")])
