"""Writes one ONNX graph node by node, its large weights straight to an external-data file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper, numpy_helper

from export.quantize.precision import Precision, block_size
from export.quantize.rounding import quantise_blocks, quantise_channels

Array = npt.NDArray[Any]
Constant = Array | np.generic | Sequence[int] | Sequence[Sequence[int]] | int
Ranges = Mapping[str, float]
"""Largest magnitude that calibration met at a layer's input, by layer name."""

OPSET = 20
IR_VERSION = 10
CONTRIB = "com.microsoft"
PRODUCER = "tic-vla-edge"
EXTERNAL_BYTES = 4096
"""Weights of at least this size go to the data file, if the graph has one."""
ALIGNMENT = 4096
"""Offsets in the data file are multiples of a page, so that ONNX Runtime can map weights instead of reading them."""
INT8_COMPUTE = 4
"""`accuracy_level` of MatMulNBits with which the CPU kernels multiply in 8-bit integers."""


class GraphWriter:
    """A graph under construction; as a context manager it leaves NAME.onnx (and NAME.onnx.data) or nothing."""

    def __init__(
        self,
        directory: Path,
        name: str,
        *,
        precision: Precision,
        form: str,
        half: bool,
        external: bool,
        ranges: Ranges | None = None,
    ) -> None:
        self.name = name
        self.precision = precision
        self.fused = form == "fused"
        self.half = half
        self._ranges = ranges or {}
        self._rounded: dict[tuple[str, float], str] = {}
        self.float = np.dtype(np.float16 if half else np.float32)
        self.float_type = TensorProto.FLOAT16 if half else TensorProto.FLOAT
        self._path = directory / f"{name}.onnx"
        self._data_path = directory / f"{name}.onnx.data" if external else None
        self._data = None if self._data_path is None else self._data_path.open("wb")
        self._shared_path: Path | None = None
        self._nodes: list[onnx.NodeProto] = []
        self._initializers: list[TensorProto] = []
        self._names: set[str] = set()
        self._weights: dict[str, TensorProto] = {}
        self._inputs: list[onnx.ValueInfoProto] = []
        self._outputs: list[onnx.ValueInfoProto] = []
        self._shared: dict[tuple[str, tuple[int, ...], bytes], str] = {}

    def __enter__(self) -> GraphWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._data is not None:
            self._data.close()
        if kind is not None:
            for path in (self._path, self._data_path, self._shared_path):
                if path is not None:
                    path.unlink(missing_ok=True)

    def input(self, name: str, dtype: int, shape: Sequence[int | str]) -> str:
        """Declare a graph input."""
        self._inputs.append(helper.make_tensor_value_info(name, dtype, list(shape)))
        self._names.add(name)
        return name

    def output(self, name: str, dtype: int, shape: Sequence[int | str]) -> None:
        """Declare a value that was computed under that name as a graph output."""
        self._outputs.append(helper.make_tensor_value_info(name, dtype, list(shape)))

    def op(
        self, kind: str, inputs: Sequence[str], *, out: str | None = None, contrib: bool = False, **attr: Any
    ) -> str:
        """Append a node with one output and return the output's name (`out`, or one derived from the node)."""
        return self.ops(kind, inputs, [out or self.unique(kind)], contrib=contrib, **attr)[0]

    def ops(
        self, kind: str, inputs: Sequence[str], outputs: Sequence[str], *, contrib: bool = False, **attr: Any
    ) -> list[str]:
        """Append a node with the named outputs ("" for one that is not wanted)."""
        self._names.update(outputs)
        self._nodes.append(
            helper.make_node(
                kind,
                list(inputs),
                list(outputs),
                name=f"n{len(self._nodes)}_{kind}",
                domain=CONTRIB if contrib else "",
                **attr,
            )
        )
        return list(outputs)

    def unique(self, stem: str) -> str:
        """A value name that is not taken."""
        name, n = stem, 1
        while name in self._names:
            name, n = f"{stem}_{n}", n + 1
        self._names.add(name)
        return name

    def constant(self, value: Constant, stem: str = "c") -> str:
        """A small constant (int64 for Python integers); equal ones are stored once."""
        array = np.asarray(value)
        if array.dtype.kind == "i" and not isinstance(value, np.ndarray):
            array = array.astype(np.int64)
        key = (array.dtype.str, array.shape, array.tobytes())
        if key not in self._shared:
            self._shared[key] = self._store(array, self.unique(stem))
        return self._shared[key]

    def floats(self, value: Array | np.generic, stem: str = "f") -> str:
        """A small constant in the graph's float type."""
        return self.constant(np.asarray(value).astype(self.float), stem)

    def weight(self, value: Array, name: str) -> str:
        """A weight under its own name, in its own type; it goes to the data file when it is large.

        A layer that is gone through again, as in an unrolled loop, gives the same weight again: it is stored once.
        """
        stored = self._weights.get(name)
        if stored is not None:
            if stored.raw_data != np.ascontiguousarray(value).tobytes():
                raise ValueError(f"{self.name}: two weights have the name {name}")
            return name
        self._names.add(name)
        self._store(value, name)
        self._weights[name] = self._initializers[-1]
        return name

    def shared_weight(self, value: Array, name: str, file: str) -> str:
        """A weight in a data file of its own, which several graphs name and each of them writes alike."""
        if self._data_path is None:
            return self.weight(value, name)
        self._names.add(name)
        value = np.ascontiguousarray(value)
        self._shared_path = self._data_path.with_name(file)
        self._shared_path.write_bytes(value.data)
        return self._refer(value, name, file, 0)

    def _store(self, value: Array, name: str) -> str:
        value = np.ascontiguousarray(value)
        if self._data is None or value.nbytes < EXTERNAL_BYTES:
            self._initializers.append(numpy_helper.from_array(value, name))
            return name
        assert self._data_path is not None
        self._data.write(b"\0" * (-self._data.tell() % ALIGNMENT))
        offset = self._data.tell()
        self._data.write(value.data)
        return self._refer(value, name, self._data_path.name, offset)

    def _refer(self, value: Array, name: str, file: str, offset: int) -> str:
        tensor = TensorProto(name=name, data_type=helper.np_dtype_to_tensor_dtype(value.dtype), dims=value.shape)
        tensor.data_location = TensorProto.EXTERNAL
        for key, entry in (("location", file), ("offset", str(offset)), ("length", str(value.nbytes))):
            tensor.external_data.add(key=key, value=entry)
        self._initializers.append(tensor)
        return name

    def linear(
        self,
        x: str,
        layer: str,
        weight: Array,
        bias: Array | None,
        *,
        of: str | None = None,
        precision: str | None = None,
    ) -> str:
        """x [..., in] · weight [out, in]ᵀ + bias in the precision that the graph gives this layer.

        `of`: the network's layer that this is a part of, by whose name precision and range are looked up.
        """
        precision = precision or self.precision.of(of or layer)
        if block_size(precision) is not None:
            if not self.fused:
                raise ValueError(f"{self.name}: {layer} in {precision}: blocks are an operator of the fused form only")
            return self._blocks(x, layer, weight, bias, precision)
        if precision == "int8" and not self.fused:
            return self._static_int8(x, layer, weight, bias, self._ranges.get(of or layer))
        if precision == "int8":
            q = quantise_channels(weight)
            inputs = [self.in_float32(x), self.weight(q.values.T, f"{layer}.weight")]
            inputs += [self.weight(q.scales, f"{layer}.scale")]
            if bias is not None:
                inputs += ["", self.weight(bias.astype(np.float32), f"{layer}.bias")]
            return self.from_float32(self.op("DynamicQuantizeMatMul", inputs, contrib=True))
        if precision == "fp32":
            y = self.op("MatMul", [self.in_float32(x), self.stored(weight.T, f"{layer}.weight", precision)])
            if bias is not None:
                y = self.op("Add", [y, self.constant(np.asarray(bias, np.float32), f"{layer}.bias")])
            return self.from_float32(y)
        y = self.op("MatMul", [x, self.stored(weight.T, f"{layer}.weight", precision)])
        return y if bias is None else self.op("Add", [y, self.floats(bias, f"{layer}.bias")])

    def in_float32(self, x: str) -> str:
        """x, which is in the graph's float type, in fp32."""
        return self.cast(x, TensorProto.FLOAT) if self.half else x

    def from_float32(self, x: str) -> str:
        """Convert the fp32 tensor `x` to the graph's float type."""
        return self.cast(x, self.float_type) if self.half else x

    def stored(self, value: Array, name: str, precision: str) -> str:
        """A weight stored in 16 or 32 bits, as its product reads it.

        16 bits are widened where activations have 32: by a runtime once when it opens the graph, to the same numbers.
        """
        if precision == "fp32":
            return self.weight(value.astype(np.float32), name)
        half = self.weight(value.astype(np.float16), name)
        return half if self.half else self.cast(half, TensorProto.FLOAT)

    def _static_int8(self, x: str, layer: str, weight: Array, bias: Array | None, largest: float | None) -> str:
        """Quantise-dequantise around a product, in the one form that compilers turn into 8-bit kernels.

        Input: one symmetric range a tensor, from calibration, rounded once for all layers that read it. Weights: 8 bits
        a channel. Nothing around attention or additions: quantising those too is what made it slower, not faster.
        Without a range only the weights are rounded.
        """
        q = quantise_channels(weight)
        stored = [self.weight(q.values.T, f"{layer}.weight"), self.floats(q.scales, f"{layer}.scale")]
        product = self.op("MatMul", [self._round(x, layer, largest), self.op("DequantizeLinear", stored, axis=1)])
        return product if bias is None else self.op("Add", [product, self.floats(bias, f"{layer}.bias")])

    def _round(self, x: str, layer: str, largest: float | None) -> str:
        if not largest:
            return x
        if (x, largest) not in self._rounded:
            scale = self.floats(np.float32(largest / 127), f"{layer}.input_scale")
            zero = self.constant(np.zeros((), np.int8), "zero")
            codes = self.op("QuantizeLinear", [x, scale, zero])
            self._rounded[x, largest] = self.op("DequantizeLinear", [codes, scale, zero])
        return self._rounded[x, largest]

    def _blocks(self, x: str, layer: str, weight: Array, bias: Array | None, precision: str) -> str:
        q = quantise_blocks(weight, precision)
        scales = q.scales.astype(self.float)
        inputs = [x, self.weight(q.packed, f"{layer}.weight"), self.weight(scales, f"{layer}.scale")]
        if bias is not None and not self.half:
            # The CUDA kernel for one row has no fused bias; there it stays an addition of its own.
            inputs += ["", "", self.weight(bias.astype(np.float32), f"{layer}.bias")]
        y = self.op(
            "MatMulNBits",
            inputs,
            contrib=True,
            K=weight.shape[1],
            N=weight.shape[0],
            bits=q.bits,
            block_size=block_size(precision),
            accuracy_level=INT8_COMPUTE,
        )
        return self.op("Add", [y, self.floats(bias, f"{layer}.bias")]) if bias is not None and self.half else y

    def cast(self, x: str, dtype: int, *, out: str | None = None) -> str:
        """x in another element type."""
        return self.op("Cast", [x], out=out, to=dtype)

    def to_float32(self, x: str, out: str) -> str:
        """x under the name of a float32 output of the graph."""
        return self.cast(x, TensorProto.FLOAT, out=out) if self.half else self.op("Identity", [x], out=out)

    def finish(self) -> list[str]:
        """Write the graph file and return the names of the files written."""
        opsets = [helper.make_opsetid("", OPSET)]
        if any(node.domain == CONTRIB for node in self._nodes):
            opsets.append(helper.make_opsetid(CONTRIB, 1))
        graph = helper.make_graph(self._nodes, self.name, self._inputs, self._outputs, self._initializers)
        proto = helper.make_model(graph, opset_imports=opsets, producer_name=PRODUCER)
        proto.ir_version = IR_VERSION
        if self._data is not None:
            self._data.flush()
        self._path.write_bytes(proto.SerializeToString(deterministic=True))
        return [path.name for path in (self._path, self._data_path, self._shared_path) if path is not None]
