"""Rounds weights in ONNX Runtime's layouts, and runs parts of the PyTorch model with rounded weights.

Hooks replace a layer's weight only while that layer computes: only one layer is copied at a time, and the model has its
original tensors otherwise.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from export.model.vision import VisionEncoder
from export.quantize.precision import Precision, bits, block_size

Floats = npt.NDArray[np.float32]

Linear = (nn.Linear, nn.Conv2d, nn.Embedding)
SLAB_ROWS = 8192
SHRINKS = (1.0, 0.95, 0.9, 0.85, 0.8)
"""Factors tried on a 4-bit block's scale: clipping its largest weight slightly is often better than coarse steps."""

QUANTISED_ROWS = 4096


@dataclass(frozen=True)
class Channels:
    """Symmetric 8-bit weights [out, in] with one scale per output channel [out]."""

    values: npt.NDArray[np.int8]
    scales: Floats

    def dequantised(self) -> Floats:
        """Return the dequantised weights, as the kernel uses them."""
        return self.values.astype(np.float32) * self.scales[:, None]


@dataclass(frozen=True)
class Blocks:
    """Symmetric 4- or 8-bit weights in blocks along the input: `MatMulNBits`' B [out, blocks, bytes] and scales."""

    packed: npt.NDArray[np.uint8]
    scales: Floats
    columns: int
    bits: int

    def dequantised(self) -> Floats:
        """Return the dequantised weights [out, in], as the kernel uses them."""
        rows = self.packed.shape[0]
        if self.bits == 4:
            codes = np.stack([self.packed & 15, self.packed >> 4], axis=-1).reshape(rows, self.packed.shape[1], -1)
        else:
            codes = self.packed
        values = (codes.astype(np.float32) - 2 ** (self.bits - 1)) * self.scales[:, :, None]
        return np.ascontiguousarray(values.reshape(rows, -1)[:, : self.columns])


def quantise_channels(weight: Floats) -> Channels:
    """Round [out, in] weights to 8 bits per output channel; a row of zeros gets scale 1."""
    largest = np.abs(weight).max(axis=1)
    scales = np.where(largest > 0, largest / 127.0, 1.0).astype(np.float32)
    values = np.clip(np.rint(weight / scales[:, None]), -127, 127).astype(np.int8)
    return Channels(values, scales)


def quantise_blocks(weight: Floats, precision: str) -> Blocks:
    """Round [out, in] weights in blocks along the input; a last block that is not full is padded with zeros."""
    block, width = block_size(precision), bits(precision)
    if block is None:
        raise ValueError(f"{precision!r} is not a block precision")
    # In slabs of rows, because the search below makes several copies.
    slabs = [
        _quantise_slab(weight[i : i + QUANTISED_ROWS], block, width) for i in range(0, len(weight), QUANTISED_ROWS)
    ]
    packed, scales = (np.concatenate(parts) for parts in zip(*slabs, strict=True))
    return Blocks(packed, scales, weight.shape[1], width)


def _quantise_slab(weight: Floats, block: int, width: int) -> tuple[npt.NDArray[np.uint8], Floats]:
    rows, columns = weight.shape
    count = -(-columns // block)
    padded = np.zeros((rows, count * block), dtype=np.float32)
    padded[:, :columns] = weight
    x = padded.reshape(rows, count, block)
    half = 2 ** (width - 1)
    # The code range is -half … half-1: dividing by the signed extreme puts that weight on -half exactly.
    extreme = np.take_along_axis(x, np.abs(x).argmax(axis=2)[:, :, None], axis=2)
    base = np.where(extreme != 0, -extreme / half, 1.0).astype(np.float32)
    best_codes = _codes(x, base, half)
    best_scale, best_error = base, _error(x, best_codes, base)
    for shrink in SHRINKS[1:] if width == 4 else ():
        scale = (base * np.float32(shrink)).astype(np.float32)
        codes = _codes(x, scale, half)
        error = _error(x, codes, scale)
        better = error < best_error
        best_codes = np.where(better, codes, best_codes)
        best_scale = np.where(better, scale, best_scale)
        best_error = np.where(better, error, best_error)
    unsigned = (best_codes + half).astype(np.uint8)
    if width == 4:
        pairs = unsigned.reshape(rows, count, block // 2, 2)
        unsigned = pairs[..., 0] | (pairs[..., 1] << 4)
    return unsigned, best_scale[:, :, 0]


def _codes(x: Floats, scale: Floats, half: int) -> Floats:
    codes: Floats = np.clip(np.rint(x / scale), -half, half - 1).astype(np.float32)
    return codes


def _error(x: Floats, codes: Floats, scale: Floats) -> Floats:
    residual = x - codes * scale
    total: Floats = np.einsum("rcb,rcb->rc", residual, residual)[:, :, None]
    return total


class Rounder:
    """Rounds weights and caches the packed results, at most `keep_bytes`; the oldest are dropped first."""

    def __init__(self, keep_bytes: int = 700_000_000) -> None:
        self._keep_bytes = keep_bytes
        self._kept: OrderedDict[tuple[int, str, int], Blocks | Channels] = OrderedDict()
        self._bytes = 0

    def weight(self, parameter: nn.Parameter, precision: str) -> Tensor:
        """Return a parameter [out, …] with the values of a precision's kernel."""
        return self._rows(parameter, precision, 0, parameter.shape[0])

    def _rows(self, parameter: nn.Parameter, precision: str, start: int, stop: int) -> Tensor:
        rows = parameter.data[start:stop]
        if precision == "fp32":
            return rows
        if precision == "fp16":
            return rows.half().float()
        # By identity: the search keeps the model alive, so an id always means the same parameter.
        key = (id(parameter), precision, start)
        packed = self._kept.get(key)
        if packed is None:
            matrix = rows.reshape(rows.shape[0], -1).numpy()
            packed = quantise_channels(matrix) if precision == "int8" else quantise_blocks(matrix, precision)
            self._keep(key, packed)
        return torch.from_numpy(packed.dequantised()).reshape(rows.shape)

    def choices(self, parameter: nn.Parameter, hidden: Tensor, precision: str) -> Tensor:
        """Return the most likely token [n] of hidden states [n, d]; see `logits`."""
        return self.logits(parameter, hidden, precision).argmax(dim=-1)

    def logits(self, parameter: nn.Parameter, hidden: Tensor, precision: str) -> Tensor:
        """Compute scores [n, vocab] of hidden states [n, d] with a vocabulary matrix that is rounded slab by slab."""
        x = round_u8(hidden) if precision == "int8" else hidden
        starts = range(0, parameter.shape[0], SLAB_ROWS)
        return torch.cat(
            [
                x @ self._rows(parameter, precision, start, min(start + SLAB_ROWS, parameter.shape[0])).T
                for start in starts
            ],
            dim=-1,
        )

    def _keep(self, key: tuple[int, str, int], packed: Blocks | Channels) -> None:
        size = _bytes(packed)
        while self._kept and self._bytes + size > self._keep_bytes:
            self._bytes -= _bytes(self._kept.popitem(last=False)[1])
        if size <= self._keep_bytes:
            self._kept[key] = packed
            self._bytes += size

    @contextmanager
    def applied(
        self, part: nn.Module, precision: Precision, layers: Collection[str], *, activations: bool = True
    ) -> Iterator[None]:
        """Make every linear layer of `part` that `layers` names compute in its precision within this context.

        With `activations`, `int8` layers also get their input rounded to 8 bits with one range a call, as the dynamic
        kernels do, and `fp16` layers get theirs in 16 bits. The model is restored on exit, also after an error.
        """
        handles = []
        originals: list[tuple[nn.Parameter, Tensor]] = []
        for name in layers:
            module = part.get_submodule(name)
            assert isinstance(module, Linear) and isinstance(module.weight, nn.Parameter)
            if precision.of(name) != "fp32":
                originals.append((module.weight, module.weight.data))
                handles += self._hook(module, precision.of(name), activations)
        try:
            yield
        finally:
            for handle in handles:
                handle.remove()
            for parameter, data in originals:
                parameter.data = data

    def _hook(self, module: nn.Module, precision: str, activations: bool) -> list[Any]:
        parameter = module.weight
        assert isinstance(parameter, nn.Parameter)
        original = parameter.data
        if isinstance(module, nn.Embedding):
            # Round only the looked-up rows: the table is as large as the rest of the language model.
            return [module.register_forward_hook(lambda _module, _inputs, rows: _table_rows(rows, precision))]

        def before(_module: nn.Module, inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...] | None:
            rounded = self.weight(parameter, precision)
            parameter.data = rounded
            if not activations or isinstance(module, nn.Conv2d) or precision not in ("int8", "fp16"):
                return None
            x = inputs[0]
            return (x.half().float() if precision == "fp16" else round_u8(x), *inputs[1:])

        def after(_module: nn.Module, _inputs: object, _output: object) -> None:
            parameter.data = original

        return [module.register_forward_pre_hook(before), module.register_forward_hook(after)]


def round_u8(x: Tensor) -> Tensor:
    """Round x to 256 steps between its smallest and largest value, including zero (`DynamicQuantizeLinear`)."""
    low, high = float(x.min().clamp(max=0)), float(x.max().clamp(min=0))
    if high == low:
        return x
    scale = (high - low) / 255
    zero = round(-low / scale)
    return (torch.clamp(torch.round(x / scale) + zero, 0, 255) - zero) * scale


def _table_rows(rows: Tensor, precision: str) -> Tensor:
    """Return looked-up rows of an embedding table stored in 16 bits, or in 8 bits with one scale per row."""
    if precision == "fp16":
        return rows.half().float()
    flat = rows.reshape(-1, rows.shape[-1]).numpy()
    return torch.from_numpy(quantise_channels(flat).dequantised()).reshape(rows.shape)


def _bytes(packed: Blocks | Channels) -> int:
    values = packed.packed if isinstance(packed, Blocks) else packed.values
    return int(values.nbytes + packed.scales.nbytes)


def activation_ranges(vision: VisionEncoder, frames: Sequence[npt.NDArray[np.uint8]]) -> dict[str, float]:
    """Return layer name → largest magnitude at its input over frames [1, px, px, 3]."""
    largest: dict[str, float] = {}

    def watch(name: str) -> Any:
        def hook(_module: nn.Module, inputs: tuple[Tensor, ...], _output: Tensor) -> None:
            largest[name] = max(largest.get(name, 0.0), float(inputs[0].abs().max()))

        return hook

    linear = [(name, module) for name, module in vision.named_modules() if isinstance(module, nn.Linear)]
    handles = [module.register_forward_hook(watch(name)) for name, module in linear]
    try:
        with torch.no_grad():
            for frame in frames:
                vision(torch.from_numpy(frame))
    finally:
        for handle in handles:
            handle.remove()
    return largest
