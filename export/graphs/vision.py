"""The vision encoder's graph: uint8 frame in, visual tokens out, normalisation and LayerScale folded into weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from onnx import TensorProto
from torch import Tensor, nn

from export.graphs.writer import Array, GraphWriter, Ranges
from export.model.vision import VisionBlock, VisionEncoder
from export.quantize.precision import Precision


def array(tensor: Tensor) -> Array:
    """Return a weight as a float32 numpy array, without a copy if possible."""
    value: Array = tensor.detach().float().numpy()
    return value


def write_vision(
    vision: VisionEncoder,
    directory: Path,
    *,
    precision: Precision,
    form: str,
    half: bool,
    external: bool,
    ranges: Ranges | None = None,
) -> list[str]:
    """Write vision_encoder.onnx: frame [1, px, px, 3] → visual_tokens [1, N, D].

    `ranges` let the plain int8 form round activations too.
    """
    c, name = vision.config, "vision_encoder"
    with GraphWriter(directory, name, precision=precision, form=form, half=half, external=external, ranges=ranges) as g:
        frame = g.input("frame", TensorProto.UINT8, (1, c.image_px, c.image_px, 3))
        x = _stem(g, vision, frame) if c.stem_channels else _patches(g, vision, frame)
        position = array(vision.position)
        first = array(vision.cls) + position[:, :1]
        x = g.op("Add", [x, g.weight(position[:, 1:].astype(g.float), "position")])
        x = g.op("Concat", [g.floats(first, "cls"), x], axis=1)
        for i, block in enumerate(vision.blocks):
            x = _block(g, x, f"blocks.{i}", block)
        x = g.op("Slice", [x, g.constant([1]), g.constant([1 + c.grid**2]), g.constant([1])])
        _projector(g, vision, x)
        g.output("visual_tokens", TensorProto.FLOAT, (1, c.tokens, c.token_dim))
        return g.finish()


def _patches(g: GraphWriter, vision: VisionEncoder, frame: str) -> str:
    """Write the patch embedding as one product over whole patches, with mean and deviation folded into its weights."""
    c = vision.config
    assert isinstance(vision.embed, nn.Conv2d) and vision.embed.bias is not None
    weight, bias = array(vision.embed.weight), array(vision.embed.bias)
    mean, inv_std = array(vision.mean), array(vision.inv_std)
    bias = bias - np.einsum("ocij,c->o", weight.astype(np.float64), (mean * inv_std).astype(np.float64))
    weight = (weight * inv_std[:, None, None]).transpose(0, 2, 3, 1).reshape(c.hidden, -1)
    rows = g.op("Reshape", [frame, g.constant([c.grid, c.patch_px, c.grid, c.patch_px * 3])])
    patches = g.op("Transpose", [rows], perm=[0, 2, 1, 3])
    flat = g.op("Reshape", [patches, g.constant([1, c.grid**2, c.patch_px**2 * 3])])
    pixels = g.cast(flat, g.float_type)
    return g.linear(pixels, "embed", weight, bias.astype(np.float32))


def _stem(g: GraphWriter, vision: VisionEncoder, frame: str) -> str:
    """Write stride-2 convolutions; only the deviation folds into them, because their padding has the mean colour."""
    c = vision.config
    # Convolutions have the graph's default precision: no override names one.
    exact = g.precision.default == "fp32"
    kind = np.dtype(np.float32) if exact else g.float
    bits = "fp16" if g.precision.default == "fp16" or (g.half and not exact) else "fp32"
    pixels = g.cast(frame, TensorProto.FLOAT if exact else g.float_type)
    # Transposed first: ONNX Runtime subtracts from planes over 20 times as fast as from rows of three values.
    planes = g.op("Transpose", [pixels], perm=[0, 3, 1, 2])
    x = g.op("Sub", [planes, g.constant(array(vision.mean).astype(kind)[:, None, None], "mean")])
    scale = array(vision.inv_std)[None, :, None, None]
    assert isinstance(vision.embed, nn.Sequential)
    for i, module in enumerate(vision.embed):
        if isinstance(module, nn.Conv2d):
            assert module.bias is not None
            weight = array(module.weight) * (scale if i == 0 else np.float32(1))
            inputs = [x, g.stored(weight, f"embed.{i}.weight", bits)]
            inputs += [g.constant(array(module.bias).astype(kind), f"embed.{i}.bias")]
            pad = module.kernel_size[0] // 2
            x = g.op("Conv", inputs, kernel_shape=list(module.kernel_size), strides=list(module.stride), pads=[pad] * 4)
        else:
            x = g.op("Gelu", [x])
    x = g.op("Reshape", [x, g.constant([1, c.hidden, c.grid**2])])
    x = g.op("Transpose", [x], perm=[0, 2, 1])
    return g.from_float32(x) if exact else x


def layer_norm(g: GraphWriter, x: str, module: nn.LayerNorm, name: str) -> str:
    """Write a LayerNormalization over the last axis."""
    scale, shift = g.floats(array(module.weight), f"{name}.weight"), g.floats(array(module.bias), f"{name}.bias")
    return g.op("LayerNormalization", [x, scale, shift], axis=-1, epsilon=module.eps)


def split_heads(g: GraphWriter, x: str, heads: int, *, keys: bool = False, out: str | None = None) -> str:
    """Write [1, T, heads·d] → [1, heads, T, d], or [1, heads, d, T] for keys."""
    x = g.op("Reshape", [x, g.constant([0, 0, heads, -1])])
    return g.op("Transpose", [x], perm=[0, 2, 3, 1] if keys else [0, 2, 1, 3], out=out)


def merge_heads(g: GraphWriter, x: str) -> str:
    """Write [1, heads, T, d] → [1, T, heads·d]."""
    return g.op("Reshape", [g.op("Transpose", [x], perm=[0, 2, 1, 3]), g.constant([0, 0, -1])])


def _block(g: GraphWriter, x: str, name: str, block: VisionBlock) -> str:
    hidden, heads = block.norm1.normalized_shape[0], block.heads
    h = layer_norm(g, x, block.norm1, f"{name}.norm1")
    weight, bias = array(block.qkv.weight), array(block.qkv.bias)
    scale = np.float32((hidden // heads) ** -0.5)
    parts = []
    for part in range(3):
        rows = slice(part * hidden, (part + 1) * hidden)
        # The query's weights include the softmax's scale: exact for a power of two, and saves a pass.
        factor = scale if part == 0 else np.float32(1)
        part_name = f"{name}.{'qkv'[part]}"
        parts.append(g.linear(h, part_name, weight[rows] * factor, bias[rows] * factor, of=f"{name}.qkv"))
    if g.fused:
        attended = g.op("MultiHeadAttention", parts, contrib=True, num_heads=heads, scale=1.0)
    else:
        q, v = split_heads(g, parts[0], heads), split_heads(g, parts[2], heads)
        scores = g.op("MatMul", [q, split_heads(g, parts[1], heads, keys=True)])
        attended = merge_heads(g, g.op("MatMul", [g.op("Softmax", [scores], axis=-1), v]))
    ls1, ls2 = array(block.ls1), array(block.ls2)
    proj = g.linear(attended, f"{name}.proj", array(block.proj.weight) * ls1[:, None], array(block.proj.bias) * ls1)
    # On a CPU, ONNX Runtime's SkipLayerNormalization takes four times as long as these two.
    x = g.op("Add", [x, proj])
    h = layer_norm(g, x, block.norm2, f"{name}.norm2")
    h = g.op("Gelu", [g.linear(h, f"{name}.fc1", array(block.fc1.weight), array(block.fc1.bias))])
    fc2 = g.linear(h, f"{name}.fc2", array(block.fc2.weight) * ls2[:, None], array(block.fc2.bias) * ls2)
    return g.op("Add", [x, fc2])


def fold_tokens(g: GraphWriter, x: str, grid: int, side: int, width: int) -> str:
    """Write the pixel shuffle [n, grid², width] → [n, (grid/side)², side²·width] in InternVL's `v2` order."""
    if side == 1:
        return x
    small = grid // side
    x = g.op("Reshape", [x, g.constant([-1, grid, small, width * side])])
    x = g.op("Transpose", [x], perm=[0, 2, 1, 3])
    x = g.op("Reshape", [x, g.constant([-1, small, small, width * side * side])])
    x = g.op("Transpose", [x], perm=[0, 2, 1, 3])
    return g.op("Reshape", [x, g.constant([-1, small * small, width * side * side])])


def _projector(g: GraphWriter, vision: VisionEncoder, x: str) -> None:
    c = vision.config
    norm, first, _, second = vision.projector
    assert isinstance(norm, nn.LayerNorm) and isinstance(first, nn.Linear) and isinstance(second, nn.Linear)
    x = layer_norm(g, fold_tokens(g, x, c.grid, c.pixel_shuffle, c.hidden), norm, "projector.0")
    x = g.op("Gelu", [g.linear(x, "projector.1", array(first.weight), array(first.bias))])
    g.to_float32(g.linear(x, "projector.3", array(second.weight), array(second.bias)), "visual_tokens")
