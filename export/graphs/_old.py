"""The four ONNX graphs of an artifact directory, traced from the PyTorch network (design §5)."""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import onnx
import torch
from torch import Tensor, nn
from torch.export import Dim

from export.model.config import TicVlaConfig
from export.model.network import TicVla

OPSET = 20
GRAPH_NAMES = ("vision_encoder", "language_model", "semantic_context", "action_expert")


@dataclass(frozen=True)
class GraphSpec:
    """One graph: the module that computes it, its named inputs and outputs and which axes are free."""

    name: str
    module: nn.Module
    inputs: dict[str, Tensor]
    outputs: tuple[str, ...]
    dynamic: Mapping[str, Mapping[int, Any]]


class _Language(nn.Module):
    """Positional-argument form of the language model, which is how caches become named graph inputs."""

    def __init__(self, model: TicVla) -> None:
        super().__init__()
        self.language = model.language

    def forward(self, input_ids: Tensor, visual_tokens: Tensor, past: list[Tensor]) -> tuple[Tensor, ...]:
        return self.language(input_ids, visual_tokens, past)


class _Context(nn.Module):
    def __init__(self, model: TicVla) -> None:
        super().__init__()
        self.action = model.action

    def forward(self, last_layer_kv: Tensor) -> tuple[Tensor, Tensor]:
        return self.action.context(last_layer_kv)


def past_names(config: TicVlaConfig, prefix: str) -> list[str]:
    """KV-cache names, `past_key_values.0.key` style (the convention of ONNX Runtime's generative tools)."""
    return [f"{prefix}.{i}.{part}" for i in range(config.language.layers) for part in ("key", "value")]


def graph_specs(model: TicVla) -> list[GraphSpec]:
    """Example inputs (their values do not matter, their free axes must not be 0 or 1) and axes of every graph."""
    c = model.config
    vision, language, action = c.vision, c.language, c.action
    head_dim = action.hidden // action.heads
    frame = torch.zeros(1, vision.image_px, vision.image_px, 3, dtype=torch.uint8)
    visual = torch.zeros(1, vision.tokens, vision.token_dim)
    past = torch.zeros(1, language.kv_heads, 7, language.head_dim)
    context = torch.zeros(action.layers, 1, action.heads, 11, head_dim)
    new, frames, old, tokens = Dim("S", min=1), Dim("F", min=1), Dim("P", min=0), Dim("T", min=1)
    return [
        GraphSpec("vision_encoder", model.vision, {"frame": frame}, ("visual_tokens",), {}),
        GraphSpec(
            "language_model",
            _Language(model),
            {
                "input_ids": torch.zeros(1, 5, dtype=torch.int64),
                "visual_tokens": visual.repeat(2, 1, 1),
                **dict.fromkeys(past_names(c, "past_key_values"), past),
            },
            ("next_token", "logits", "last_layer_kv", *past_names(c, "present")),
            {
                "input_ids": {1: new},
                "visual_tokens": {0: frames},
                **{name: {2: old} for name in past_names(c, "past_key_values")},
            },
        ),
        GraphSpec(
            "semantic_context",
            _Context(model),
            {"last_layer_kv": torch.zeros(1, 11, c.kv_dim)},
            ("context_keys", "context_values"),
            {"last_layer_kv": {1: tokens}},
        ),
        GraphSpec(
            "action_expert",
            model.action,
            {
                "visual_tokens": visual,
                "state": torch.zeros(1, 3),
                "latency": torch.zeros(1, 4),
                "context_keys": context,
                "context_values": context.clone(),
            },
            ("trajectory",),
            {"context_keys": {3: tokens}, "context_values": {3: tokens}},
        ),
    ]


def _arguments(spec: GraphSpec) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Arguments and dynamic shapes as the module takes them: the language model's caches are one list."""
    values: list[Any] = []
    shapes: list[Any] = []
    caches = [name for name in spec.inputs if name.startswith("past_key_values")]
    for name, value in spec.inputs.items():
        if name not in caches:
            values.append(value)
            shapes.append(dict(spec.dynamic.get(name, {})))
    if caches:
        values.append([spec.inputs[name].clone() for name in caches])
        shapes.append([dict(spec.dynamic[name]) for name in caches])
    return tuple(values), tuple(shapes)


@contextlib.contextmanager
def _quiet_exporter() -> Any:
    """Silence the exporter's progress chatter; its errors are exceptions and come through."""
    loggers = [logging.getLogger(name) for name in ("torch.onnx", "onnxscript", "torch.export")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def export_graph(spec: GraphSpec, path: Path) -> None:
    """Write one graph as a single ONNX file; same weights → same bytes (no paths, stack traces or dates inside)."""
    arguments, shapes = _arguments(spec)
    with _quiet_exporter(), torch.no_grad():
        program = torch.onnx.export(
            spec.module,
            arguments,
            dynamo=True,
            dynamic_shapes=shapes,
            input_names=list(spec.inputs),
            output_names=list(spec.outputs),
            opset_version=OPSET,
            verbose=False,
        )
    assert program is not None
    proto = program.model_proto
    _strip(proto)
    onnx.checker.check_model(proto)
    path.write_bytes(proto.SerializeToString(deterministic=True))


def _strip(proto: onnx.ModelProto) -> None:
    """Drop what names the exporting machine: stack traces, doc strings and per-node metadata."""
    proto.producer_name = "tic-vla-edge"
    proto.doc_string = ""
    del proto.metadata_props[:]
    graphs = [proto.graph, *proto.functions]
    for graph in graphs:
        graph.doc_string = ""
        del graph.metadata_props[:]
        for node in graph.node:
            node.doc_string = ""
            del node.metadata_props[:]
    for value in [*proto.graph.input, *proto.graph.output, *proto.graph.value_info, *proto.graph.initializer]:
        value.doc_string = ""
        del value.metadata_props[:]


def graph_contract(path: Path) -> dict[str, list[dict[str, Any]]]:
    """Inputs and outputs as the file declares them: name, dtype, shape (free axes by name)."""
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
    """Number of weights stored in a graph file."""
    proto = onnx.load(str(path), load_external_data=False)
    return sum(int(torch.tensor(list(t.dims)).prod()) if t.dims else 1 for t in proto.graph.initializer)
