"""Writes the graphs of an artifact directory by name."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import onnx
from onnx import TensorProto
from torch import nn

from export.graphs.action import write_action, write_context
from export.graphs.language import ROLES, write_language
from export.graphs.vision import write_vision
from export.graphs.writer import Ranges
from export.model.config import TicVlaConfig
from export.model.network import TicVla
from export.quantize.precision import Precision, bits
from export.targets.file import OTHER_GRAPHS
from export.targets.sections import FORMS

WEIGHT_TYPES = frozenset(
    {TensorProto.FLOAT, TensorProto.FLOAT16, TensorProto.INT8, TensorProto.UINT8, TensorProto.INT4, TensorProto.UINT4}
)
SINGLE_FILE_BYTES = 64_000_000
"""Bytes of weights above which a graph stores them in a separate data file, which is mapped instead of read."""


def write_graph(
    model: TicVla,
    name: str,
    precision: Precision,
    form: str,
    directory: Path,
    *,
    half: bool = False,
    ranges: Ranges | None = None,
) -> list[str]:
    """Write one graph and return the names of its files; same weights and precision → same bytes.

    `half`: activations and KV buffers in fp16 (GPU targets). `ranges`: input ranges of the encoder's layers, for its
    plain int8 form. Raises ValueError for an unknown name or form.
    """
    if form not in FORMS:
        raise ValueError(f"form {form!r} is not known; expected one of {FORMS}")
    if name == "vision_encoder":
        external = _weight_bytes(model.vision, precision) > SINGLE_FILE_BYTES
        return write_vision(
            model.vision, directory, precision=precision, form=form, half=half, external=external, ranges=ranges
        )
    if name in ROLES:
        vision = model.config.vision
        return write_language(
            model.language,
            directory,
            name,
            tokens=vision.tokens,
            token_dim=vision.token_dim,
            precision=precision,
            half=half,
            external=_weight_bytes(model.language, precision) > SINGLE_FILE_BYTES,
        )
    if name == "semantic_context":
        return write_context(model.action, directory, precision=precision, form=form, half=half)
    if name == "action_expert":
        return write_action(model.action, directory, precision=precision, form=form, half=half)
    raise ValueError(f"graph {name!r} is not known; expected one of {(*OTHER_GRAPHS, *ROLES)}")


def _weight_bytes(module: nn.Module, precision: Precision) -> int:
    return sum(parameter.numel() for parameter in module.parameters()) * bits(precision.default) // 8


def graph_contract(path: Path) -> dict[str, list[dict[str, Any]]]:
    """Read inputs and outputs from a graph file: name, dtype, shape (free axes by name)."""
    proto = onnx.load(str(path), load_external_data=False)

    def describe(value: onnx.ValueInfoProto) -> dict[str, Any]:
        tensor = value.type.tensor_type
        shape = [d.dim_value if d.HasField("dim_value") else d.dim_param for d in tensor.shape.dim]
        return {"name": value.name, "dtype": onnx.TensorProto.DataType.Name(tensor.elem_type).lower(), "shape": shape}

    return {
        "inputs": [describe(v) for v in proto.graph.input],
        "outputs": [describe(v) for v in proto.graph.output],
    }


def graph_parameters(path: Path) -> int:
    """Count the network's weights in a graph file: packed ones individually, without scales, tables and constants."""
    proto = onnx.load(str(path), load_external_data=False)
    packed = {}
    for node in proto.graph.node:
        if node.op_type == "MatMulNBits":
            sizes = {attribute.name: attribute.i for attribute in node.attribute}
            packed[node.input[1]] = sizes["K"] * sizes["N"]
    return sum(
        packed.get(tensor.name, math.prod(tensor.dims))
        for tensor in proto.graph.initializer
        if tensor.data_type in WEIGHT_TYPES and not tensor.name.endswith((".scale", "_cache"))
    )


def linear_layers(config: TicVlaConfig, name: str) -> tuple[str, ...]:
    """Return the names of a graph's layers whose precision can be set."""
    if name == "vision_encoder":
        blocks = [f"blocks.{i}.{part}" for i in range(config.vision.layers) for part in ("qkv", "proj", "fc1", "fc2")]
        stem = () if config.vision.stem_channels else ("embed",)
        return (*stem, *blocks, "projector.1", "projector.3")
    if name in ROLES:
        role, parts = ROLES[name], ("q", "k", "v", "o", "gate", "up", "down")
        layers = [f"layers.{i}.{part}" for i in range(config.language.layers) for part in parts]
        merge = ("merge.1",) if role.images and config.language.token_merge > 1 else ()
        return ("embed", *merge, *layers, *(("lm_head",) if role.token else ()))
    pairs = [f"key_values.{i}.{part}" for i in range(config.action.layers) for part in "kv"]
    if name == "semantic_context":
        return ("semantic_projection.0", "semantic_projection.2", *pairs)
    if name == "action_expert":
        mlps = [f"{m}_projection.{i}" for m in ("visual", "state", "latency") for i in (0, 2)]
        layers = [f"layers.{i}.{part}" for i in range(config.action.layers) for part in ("q", "o", "fc1", "fc2")]
        if config.action.head == "diffusion":
            return (*mlps, *pairs, *layers, "head.0", "head.2", "out", "diffusion.action_in")
        # Layer 0 has no query product: its queries are constants.
        trunk = (*mlps, *pairs, *(name for name in layers if name != "layers.0.q"), "head.0", "head.2")
        return (*trunk, *flow_layers(config)) if config.action.head == "flow" else (*trunk, "out")
    raise ValueError(f"graph {name!r} is not known")


def flow_layers(config: TicVlaConfig) -> tuple[str, ...]:
    """Return the names of a flow's layers."""
    parts = ("action_in", "key_value.k", "key_value.v", "layer.q", "layer.o", "layer.fc1", "layer.fc2", "out")
    return tuple(f"flow.couplings.{i}.{part}" for i in range(config.action.couplings) for part in parts)
