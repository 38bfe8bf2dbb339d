"""The graphs: the same mathematics as the network, in forms that are fast to run."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch

from edge.artifacts.manifest import LANGUAGE_PAIR
from export.evaluation.parity import Arrays, compare, references
from export.graphs.build import linear_layers, write_graph
from export.model.config import PRESETS, TicVlaConfig
from export.model.network import TicVla, build
from export.quantize.precision import Precision
from export.quantize.rounding import activation_ranges
from export.targets.file import graph_names
from tests.support.export.byte_products import skip_where_bytes_saturate

NANO = PRESETS["nano"]
EXACT = Precision("fp32")
GRAPHS = graph_names(pair=False)
ALL = (*GRAPHS, *LANGUAGE_PAIR)
# A paper-shaped encoder in small: one convolution as patch embedding, pixel shuffle, no merging of language tokens.
SMALL = TicVlaConfig(
    name="small",
    vision=dataclasses.replace(
        PRESETS["1b"].vision, image_px=56, hidden=32, layers=2, heads=2, mlp=64, token_dim=64, patch_px=14
    ),
    language=dataclasses.replace(NANO.language, hidden=64, heads=2, kv_heads=1, mlp=96, token_merge=1, layers=2),
    action=dataclasses.replace(NANO.action, hidden=64, heads=2, ffn=96, layers=3),
)


@pytest.fixture(scope="module")
def nano() -> TicVla:
    return build(NANO, 0)


@pytest.fixture(scope="module")
def small() -> TicVla:
    return build(SMALL, 1)


def run(directory: Path, name: str) -> ort.InferenceSession:
    return ort.InferenceSession(str(directory / f"{name}.onnx"), providers=["CPUExecutionProvider"])


def check(model: TicVla, directory: Path, name: str, precision: Precision, form: str, **options: Any) -> float:
    """Worst difference from PyTorch over four inputs."""
    write_graph(model, name, precision, form, directory, **options)
    session = run(directory, name)
    names = [o.name for o in session.get_outputs()]
    types = {i.name: np.float16 if i.type == "tensor(float16)" else None for i in session.get_inputs()}

    def outputs(feeds: Arrays) -> Arrays:
        cast = {k: v if types[k] is None else v.astype(types[k]) for k, v in feeds.items()}
        return {k: np.asarray(v) for k, v in zip(names, session.run(None, cast), strict=True)}

    return compare(name, references(model, name, 4), outputs).max_abs


@pytest.mark.slow
@pytest.mark.parametrize("name", ALL)
def test_every_fused_graph_is_the_network(nano: TicVla, tmp_path: Path, name: str) -> None:
    assert check(nano, tmp_path, name, EXACT, "fused") < 5e-5


@pytest.mark.slow
@pytest.mark.parametrize("name", ["vision_encoder", "semantic_context", "action_expert"])
def test_every_plain_graph_is_the_network(nano: TicVla, tmp_path: Path, name: str) -> None:
    assert check(nano, tmp_path, name, EXACT, "plain") < 5e-5


@pytest.mark.parametrize("form", ["fused", "plain"])
def test_the_papers_patch_embedding_and_pixel_shuffle_fold_exactly(tmp_path: Path, form: str) -> None:
    assert check(build(SMALL, 1), tmp_path, "vision_encoder", EXACT, form) < 5e-5


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        {"semantic_interface": "values-only"},
        {"semantic_interface": "waypoints"},
        {"parameterisation": "offsets"},
        {"latency_aware": False},
        {"motion_offset": False},
        {"layers": 12},
        {"steps": 10},
        {"steps": 50},
    ],
    ids=str,
)
@pytest.mark.parametrize("name", ["semantic_context", "action_expert"])
def test_every_variant_of_the_action_expert_exports(tmp_path: Path, change: dict, name: str) -> None:
    config = dataclasses.replace(SMALL, action=dataclasses.replace(SMALL.action, **change))
    assert check(build(config, 2), tmp_path, name, EXACT, "fused") < 5e-5


BOUNDS = {"fp32": 0.05, "fp16": 0.05, "int8-b32": 0.3, "int8": 0.5, "int4-b32": 2.0}
STORED = {
    "fp32": onnx.TensorProto.FLOAT,
    "fp16": onnx.TensorProto.FLOAT16,
    "int8-b32": onnx.TensorProto.UINT8,
    "int8": onnx.TensorProto.INT8,
    "int4-b32": onnx.TensorProto.UINT8,
}


@pytest.mark.slow
@pytest.mark.parametrize("half", [False, True], ids=["float", "half"])
@pytest.mark.parametrize("precision", BOUNDS)
@pytest.mark.parametrize(
    ("name", "form"),
    [
        (name, form)
        for form in ("fused", "plain")
        for name in graph_names(pair=False)
        if form == "fused" or "_m" not in name
    ],
)
def test_every_combination_runs_as_the_network_and_stores_its_precision_or_is_refused(
    small: TicVla, tmp_path: Path, name: str, form: str, precision: str, half: bool
) -> None:
    asked = Precision(precision, (("embed", "fp16"),) if "language" in name else ())
    if form == "plain" and "-b" in precision:
        with pytest.raises(ValueError, match="blocks are an operator of the fused form only"):
            write_graph(small, name, asked, form, tmp_path, half=half)
        assert not list(tmp_path.iterdir())
        return
    skip_where_bytes_saturate(precision, form)
    assert check(small, tmp_path, name, asked, form, half=half) < BOUNDS[precision]
    stored = {t.name: t.data_type for t in onnx.load(str(tmp_path / f"{name}.onnx")).graph.initializer}
    layers = {n for n in stored if n.endswith(".weight") and "norm" not in n and not n.startswith("embed")}
    assert layers
    assert {stored[n] for n in layers if n.split(".")[0] in ("blocks", "layers", "key_values")} == {STORED[precision]}


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["fp32", "fp16"])
def test_a_convolutional_stem_is_as_exact_as_the_graphs_default(nano: TicVla, tmp_path: Path, precision: str) -> None:
    assert check(nano, tmp_path, "vision_encoder", Precision(precision), "plain", half=True) < 0.05
    stored = {t.name: t.data_type for t in onnx.load(str(tmp_path / "vision_encoder.onnx")).graph.initializer}
    assert stored["embed.0.weight"] == STORED[precision]


def test_a_layer_raised_to_32_bits_in_a_half_graph_is_computed_in_them(nano: TicVla, tmp_path: Path) -> None:
    write_graph(nano, "action_expert", Precision("fp16", (("out", "fp32"),)), "plain", tmp_path, half=True)
    nodes = onnx.load(str(tmp_path / "action_expert.onnx")).graph.node
    product = next(node for node in nodes if "out.weight" in node.input)
    widened = {out for node in nodes if node.op_type == "Cast" for out in node.output}
    assert product.input[0] in widened


@pytest.mark.slow
@pytest.mark.parametrize("name", ALL)
def test_two_writings_are_the_same_bytes(nano: TicVla, tmp_path: Path, name: str) -> None:
    contents = []
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        write_graph(nano, name, Precision("int4-b128", (("embed", "int8"),)), "fused", tmp_path / folder)
        contents.append({path.name: path.read_bytes() for path in (tmp_path / folder).iterdir()})
    assert contents[0] == contents[1]


@pytest.mark.slow
def test_a_failed_writing_leaves_nothing(nano: TicVla, tmp_path: Path) -> None:
    broken = build(NANO, 0)
    broken.vision.projector[1] = torch.nn.Identity()  # type: ignore[assignment]
    with pytest.raises(AssertionError):
        write_graph(broken, "vision_encoder", EXACT, "fused", tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ALL)
def test_every_layer_that_can_be_named_is_in_its_graph(nano: TicVla, tmp_path: Path, name: str) -> None:
    write_graph(nano, name, EXACT, "fused", tmp_path)
    stored = {t.name for t in onnx.load(str(tmp_path / f"{name}.onnx")).graph.initializer}
    stored |= {n.replace(f".{p}.", ".qkv.") for n in stored for p in "qkv" if name == "vision_encoder"}
    fused = {
        layer: layer[:-1] + "qkv"
        if layer[-2:] in (".q", ".k", ".v") and name in ("language_model", *LANGUAGE_PAIR)
        else layer
        for layer in linear_layers(NANO, name)
    }
    assert all(f"{layer}.weight" in stored for layer in fused.values())


@pytest.mark.slow
def test_the_graphs_of_a_large_pair_share_one_token_table(
    nano: TicVla, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("export.graphs.build.SINGLE_FILE_BYTES", 0)
    files = [write_graph(nano, name, EXACT, "fused", tmp_path) for name in LANGUAGE_PAIR]
    assert set(files[0]) & set(files[1]) == {"language_model.embed.fp32.onnx.data"}
    table = nano.language.embed.weight.detach().numpy()
    assert (tmp_path / "language_model.embed.fp32.onnx.data").read_bytes() == table.tobytes()
    for name in LANGUAGE_PAIR:
        session = run(tmp_path, name)
        names = [o.name for o in session.get_outputs()]
        result = compare(
            name,
            references(nano, name, 2),
            lambda feeds, session=session, names=names: dict(zip(names, session.run(None, feeds), strict=True)),
        )
        assert result.max_abs < 5e-5


@pytest.mark.slow
def test_the_plain_int8_encoder_rounds_the_inputs_of_products_and_nothing_else(tmp_path: Path) -> None:
    model = build(SMALL, 1)
    frames = [references(model, "vision_encoder", 4)[i].feeds["frame"] for i in range(4)]
    ranges = activation_ranges(model.vision, frames)
    assert set(ranges) == set(linear_layers(SMALL, "vision_encoder")) - {"embed"}
    found = check(model, tmp_path, "vision_encoder", Precision("int8", (("embed", "fp32"),)), "plain", ranges=ranges)
    assert 0 < found < 0.2
    nodes = onnx.load(str(tmp_path / "vision_encoder.onnx")).graph.node
    rounded = {out for node in nodes if node.op_type == "DequantizeLinear" for out in node.output}
    products = [n for n in nodes if n.op_type == "MatMul" and n.input[1] in rounded]
    assert len(products) == 6 * SMALL.vision.layers + 2
    assert all(n.input[0] in rounded for n in products)
    # Queries, keys and values read one rounding of their common input.
    assert sum(n.op_type == "QuantizeLinear" for n in nodes) == 4 * SMALL.vision.layers + 2
