"""Rounding of weights: per output channel (`int8`) or in blocks (`int8-bN`, `int4-bN`), in ONNX Runtime's layouts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from export.quantize.precision import bits, block_size

Floats = npt.NDArray[np.float32]

SHRINKS = (1.0, 0.95, 0.9, 0.85, 0.8)
"""Factors tried on a 4-bit block's scale: clipping its largest weight a little often costs less than coarse steps."""

SLAB_ROWS = 4096


@dataclass(frozen=True)
class Channels:
    """Symmetric 8-bit weights [out, in] with one scale per output channel [out]."""

    values: npt.NDArray[np.int8]
    scales: Floats

    def dequantised(self) -> Floats:
        """The weights that the kernel multiplies with."""
        return self.values.astype(np.float32) * self.scales[:, None]


@dataclass(frozen=True)
class Blocks:
    """Symmetric 4- or 8-bit weights in blocks along the input: `MatMulNBits`' B [out, blocks, bytes] and scales."""

    packed: npt.NDArray[np.uint8]
    scales: Floats
    columns: int
    bits: int

    def dequantised(self) -> Floats:
        """The weights that the kernel multiplies with, [out, in]."""
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
    # In slabs of rows: the search below holds several copies of what it works on.
    slabs = [_quantise_slab(weight[i : i + SLAB_ROWS], block, width) for i in range(0, len(weight), SLAB_ROWS)]
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
