"""Ranges of the encoder's activations over a calibration set: what static 8-bit rounding needs to know beforehand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from export.model.vision import VisionEncoder


def activation_ranges(vision: VisionEncoder, frames: Sequence[npt.NDArray[np.uint8]]) -> dict[str, float]:
    """Largest magnitude at the input of every linear layer over frames [1, px, px, 3], by the layer's name."""
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
