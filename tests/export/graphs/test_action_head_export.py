"""The three heads as graphs: the same contract, the same mathematics, and a cost that counts every pass."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from export.evaluation.parity import Arrays, compare, references, sample_inputs
from export.evaluation.task_error import TorchStages
from export.graphs.build import linear_layers, write_graph
from export.model.config import PRESETS, TicVlaConfig
from export.model.network import TicVla
from export.plan.cost import action_call
from export.plan.timing import Work, stage_time
from export.quantize.precision import Precision
from export.quantize.rounding import Rounder
from export.targets.file import load_target
from export.targets.sections import MEASURED, MODELLED, Measured
from tests.support.export.action_heads import HEADS, TINY, lively, with_head
from tests.support.export.byte_products import skip_where_bytes_saturate

NANO, BIG = PRESETS["nano"], PRESETS["1b"]
EXACT = Precision("fp32")
OTHERS = ("diffusion", "flow")


def check(model: TicVla, directory: Path, precision: Precision, form: str, **options: bool) -> float:
    """Worst difference of a plan from PyTorch's, in m or rad, over four inputs."""
    write_graph(model, "action_expert", precision, form, directory, **options)
    session = ort.InferenceSession(str(directory / "action_expert.onnx"), providers=["CPUExecutionProvider"])
    types = {i.name: np.float16 if i.type == "tensor(float16)" else np.float32 for i in session.get_inputs()}

    def outputs(feeds: Arrays) -> Arrays:
        return {"trajectory": session.run(None, {k: v.astype(types[k]) for k, v in feeds.items()})[0]}

    found = compare("action_expert", references(model, "action_expert", 4), outputs)
    assert found.min_difference > 1e-3
    return found.max_abs


def nodes(model: TicVla, directory: Path) -> list[onnx.NodeProto]:
    write_graph(model, "action_expert", EXACT, "fused", directory)
    return list(onnx.load(str(directory / "action_expert.onnx")).graph.node)


# The same mathematics


@pytest.mark.parametrize(
    "change",
    [
        {"semantic_interface": "waypoints"},
        {"semantic_interface": "values-only"},
        {"parameterisation": "offsets"},
        {"latency_aware": False},
        {"layers": 1},
        {"steps": 10},
        {"diffusion_steps": 20, "ddim_steps": 20},
        {"ddim_steps": 1},
        {"couplings": 1},
        {"couplings": 4},
    ],
    ids=str,
)
@pytest.mark.slow
@pytest.mark.parametrize("head", OTHERS)
def test_every_variant_of_a_head_plans_as_the_network_does(tmp_path: Path, head: str, change: dict) -> None:
    assert check(lively(with_head(TINY, head, **change), 2), tmp_path, EXACT, "fused") < 1e-4


BOUNDS = {"fp32": 0.02, "fp16": 0.02, "int8-b32": 0.1, "int8": 0.2, "int4-b32": 1.0}


# Blocks in fp16 are for CUDA: on the CPU, ONNX Runtime 1.31 loses such a product where it follows a Gelu in fp16.
COMBINATIONS = [(precision, half) for precision in BOUNDS for half in (False, True) if not (half and "-b" in precision)]


@pytest.mark.slow
@pytest.mark.parametrize(("precision", "half"), COMBINATIONS)
@pytest.mark.parametrize("head", OTHERS)
def test_every_precision_runs_and_is_near(tmp_path: Path, head: str, precision: str, half: bool) -> None:
    skip_where_bytes_saturate(precision, "fused")
    assert check(lively(with_head(TINY, head)), tmp_path, Precision(precision), "fused", half=half) < BOUNDS[precision]


@pytest.mark.parametrize("precision", ["fp32", *(pytest.param(p, marks=pytest.mark.slow) for p in ("fp16", "int8"))])
@pytest.mark.parametrize("head", OTHERS)
def test_the_plain_form_has_standard_operators_only(tmp_path: Path, head: str, precision: str) -> None:
    assert check(lively(with_head(TINY, head)), tmp_path, Precision(precision), "plain") < BOUNDS[precision]
    proto = onnx.load(str(tmp_path / "action_expert.onnx"))
    assert {node.domain for node in proto.graph.node} == {""}
    onnx.checker.check_model(proto, full_check=True)


@pytest.mark.slow
@pytest.mark.parametrize("head", OTHERS)
def test_rounding_in_pytorch_is_the_graphs_rounding(tmp_path: Path, head: str) -> None:
    """The search for a precision runs PyTorch with the layers it names rounded: weights alone must agree closely."""
    model, precision = lively(with_head(TINY, head)), Precision("fp16")
    write_graph(model, "action_expert", precision, "fused", tmp_path)
    session = ort.InferenceSession(str(tmp_path / "action_expert.onnx"), providers=["CPUExecutionProvider"])
    feeds = sample_inputs(model.config, "action_expert", 1)
    layers = range(model.config.action.layers)
    keys = np.stack([feeds[f"context.{i}.key"].transpose(0, 1, 3, 2) for i in layers])
    values = np.stack([feeds[f"context.{i}.value"] for i in layers])
    stages = TorchStages(model, {"action_expert": precision}, rounder=Rounder(), activations=False)
    found = stages.act(feeds["visual_tokens"], feeds["state"], feeds["latency"], keys, values)
    np.testing.assert_allclose(session.run(None, feeds)[0], found, atol=1e-4)


# The same contract


@pytest.mark.parametrize("head", OTHERS)
def test_a_graph_leaves_nothing_to_chance(tmp_path: Path, head: str) -> None:
    kinds = {node.op_type for node in nodes(lively(with_head(TINY, head)), tmp_path)}
    assert not kinds & {"RandomNormal", "RandomNormalLike", "RandomUniform", "Loop", "If", "Scan"}


# What is computed once, and what every pass costs


def uses(graph: list[onnx.NodeProto], name: str) -> int:
    return sum(name in node.input for node in graph)


def test_a_diffusion_sees_the_present_once_and_the_context_in_every_pass(tmp_path: Path) -> None:
    graph = nodes(lively(with_head(TINY, "diffusion")), tmp_path)
    assert uses(graph, "visual_projection.0.weight") == 1
    # Keys of the present once, and of the chunk's own tokens in each of five passes.
    assert uses(graph, "key_values.1.k.weight") == 1 + 5
    assert uses(graph, "context.1.key") == 5
    assert uses(graph, "layers.1.fc1.weight") == 5


@pytest.mark.parametrize("head", HEADS)
def test_every_layer_that_can_be_named_is_in_the_graph_the_network_and_the_cost(tmp_path: Path, head: str) -> None:
    config = with_head(TINY, head)
    model = lively(config)
    write_graph(model, "action_expert", EXACT, "fused", tmp_path)
    stored = [t.name for t in onnx.load(str(tmp_path / "action_expert.onnx")).graph.initializer]
    named = linear_layers(config, "action_expert")
    assert len(stored) == len(set(stored))
    assert {f"{layer}.weight" for layer in named} == {n for n in stored if n.endswith(".weight") and "norm" not in n}
    assert all(isinstance(model.action.get_submodule(layer), torch.nn.Linear) for layer in named)
    assert sorted(linear.name for linear in action_call(config, context=3).linears) == sorted(named)


def counted_flops(model: TicVla, context: int) -> int:
    """What PyTorch itself counts in one plan."""
    c, vision = model.config.action, model.config.vision
    context_shape = (c.layers, 1, c.heads, context, c.hidden // c.heads)
    inputs = [torch.zeros(1, vision.tokens, vision.token_dim), torch.zeros(1, 3), torch.zeros(1, 4)]
    model.action.requires_grad_(False)  # the counter looks for gradients of everything that has one
    with torch.no_grad(), sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        model.action(*inputs, torch.zeros(context_shape), torch.zeros(context_shape))
    return int(counter.get_total_flops())


@pytest.mark.slow
@pytest.mark.parametrize("head", HEADS)
def test_the_cost_counts_what_is_computed(head: str) -> None:
    """But for what the graph holds as constants: the first queries, and the noise levels of a diffusion."""
    config = with_head(NANO, head)
    assert action_call(config, context=300).flops() == pytest.approx(counted_flops(lively(config), 300), rel=0.02)


def timed(config: TicVlaConfig, ms: float) -> tuple[float, str, str]:
    """A plan's time, tag and source on a target where the query head was measured."""
    target = load_target("cpu", config.name)
    policy = target.graphs["action_expert"]
    point = Measured(
        model=config.name,
        graph="action_expert",
        precision="fp32",
        form=policy.form,
        provider=policy.provider,
        machine="the board",
        date="2026-11-22",
        ms=ms,
    )
    found = stage_time(
        dataclasses.replace(target, measured=(point,)), config, "action_expert", EXACT, Work(1100, 128, 32)
    )
    return found.whole.ms, found.whole.tag, found.whole.source


def test_a_measured_query_head_only_scales_the_model_of_another() -> None:
    assert timed(BIG, 20.0)[:2] == (20.0, MEASURED)
    ms, tag, source = timed(with_head(BIG, "diffusion"), 20.0)
    assert tag == MODELLED
    assert source.endswith("the board, 2026-11-22, query head")
    assert 2.5 * 20.0 < ms < 6 * 20.0
