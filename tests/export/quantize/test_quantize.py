"""Rounded weights: what the kernels multiply with, and how far that is from the weights."""

from __future__ import annotations

import numpy as np
import onnxruntime as ort
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from onnx import TensorProto, helper, numpy_helper

from export.quantize.precision import PRECISIONS, Precision, PrecisionError, bits, block_size, weight_bytes
from export.quantize.rounding import quantise_blocks, quantise_channels

BLOCKED = [p for p in PRECISIONS if block_size(p)]
weights = arrays(
    np.float32,
    st.tuples(st.integers(1, 5), st.integers(1, 300)),
    elements=st.floats(-8, 8, width=32, allow_subnormal=False),
)


def normal(rows: int, columns: int) -> np.ndarray:
    return np.random.default_rng(3).standard_normal((rows, columns)).astype(np.float32)


@pytest.mark.slow
@given(weights)
def test_per_channel_rounding_is_within_half_a_step(weight: np.ndarray) -> None:
    q = quantise_channels(weight)
    assert (np.abs(q.dequantised() - weight) <= q.scales[:, None] * 0.5001 + 1e-30).all()


@pytest.mark.slow
@pytest.mark.parametrize("precision", BLOCKED)
@given(weight=weights)
def test_block_rounding_never_leaves_a_block_worse_than_plain_rounding(precision: str, weight: np.ndarray) -> None:
    block = block_size(precision)
    assert block is not None
    half = 2 ** (bits(precision) - 1)
    error = quantise_blocks(weight, precision).dequantised() - weight
    for start in range(0, weight.shape[1], block):
        part = slice(start, start + block)
        # Plain: steps of extreme/half, and at most one step off for the weight opposite to the extreme.
        step = np.abs(weight[:, part]).max(axis=1) / half
        bound = np.sqrt(((step[:, None] * np.ones((1, error[:, part].shape[1]))) ** 2).sum(axis=1))
        assert (np.linalg.norm(error[:, part], axis=1) <= bound * 1.001 + 1e-6).all()


def test_a_more_exact_precision_is_closer_to_the_weights() -> None:
    weight = normal(64, 512)
    errors = {p: float(np.linalg.norm(quantise_blocks(weight, p).dequantised() - weight)) for p in BLOCKED}
    assert errors["int8-b32"] < errors["int8-b128"] < errors["int4-b32"] < errors["int4-b128"]


@pytest.mark.parametrize("precision", BLOCKED)
def test_the_runtimes_kernel_multiplies_with_the_weights_that_rounding_names(precision: str) -> None:
    weight, x = normal(24, 200), normal(3, 200)
    q = quantise_blocks(weight, precision)
    node = helper.make_node(
        "MatMulNBits",
        ["x", "w", "s"],
        ["y"],
        domain="com.microsoft",
        K=200,
        N=24,
        bits=q.bits,
        block_size=block_size(precision),
    )
    graph = helper.make_graph(
        [node],
        "one",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [3, 200])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, [3, 24])],
        [numpy_helper.from_array(q.packed, "w"), numpy_helper.from_array(q.scales, "s")],
    )
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", 20), helper.make_opsetid("com.microsoft", 1)]
    )
    model.ir_version = 10
    found = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"]).run(None, {"x": x})[0]
    np.testing.assert_allclose(found, x @ q.dequantised().T, atol=2e-4)


def test_the_first_override_that_matches_a_layer_wins() -> None:
    precision = Precision("int4-b128", (("layers.3.*", "fp32"), ("layers.*", "int8-b128")))
    assert [precision.of(n) for n in ("layers.3.down", "layers.2.down", "lm_head")] == [
        "fp32",
        "int8-b128",
        "int4-b128",
    ]


@pytest.mark.parametrize("name", ["int3", "", "INT8", "int4"])
def test_an_unknown_precision_is_refused_with_the_names_there_are(name: str) -> None:
    with pytest.raises(PrecisionError, match="int4-b128"):
        Precision(name)


@pytest.mark.parametrize("precision", BLOCKED)
def test_bytes_are_those_of_the_arrays(precision: str) -> None:
    q = quantise_blocks(normal(16, 300), precision)
    assert weight_bytes(precision, 16, 300) == q.packed.nbytes + q.scales.nbytes
