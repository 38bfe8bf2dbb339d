"""Weights on disk: safetensors with the network's configuration as metadata; `export.checkpoint` reads them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors.torch import save_file

from export.core.tensor_file import replacing
from export.model.network import PARTS, TicVla

FORMAT = "tic-vla-edge/1"


class WeightsError(ValueError):
    """Weights file with unexpected content."""


class CheckpointError(WeightsError):
    """Checkpoint that does not match the network; its text is the one line to show."""


@dataclass(frozen=True)
class WeightsInfo:
    """Metadata of a weights file."""

    trained: bool
    origin: str


def weights_sha256(model: TicVla) -> str:
    """Hash every tensor's name, shape and bytes, independent of its file."""
    digest = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        digest.update(f"{name}:{tuple(tensor.shape)}:{tensor.dtype}".encode())
        digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


def save_weights(model: TicVla, path: Path, info: WeightsInfo, parts: Sequence[str] = PARTS) -> None:
    """Write the weights of `parts` atomically. Raises OSError."""
    metadata = {
        "format": FORMAT,
        "config": json.dumps(model.config.to_dict(), sort_keys=True),
        "trained": "true" if info.trained else "false",
        "origin": info.origin,
    }
    tensors = {k: v.contiguous() for k, v in model.state_dict().items() if k.split(".")[0] in parts}
    with replacing(path) as partial:
        save_file(tensors, str(partial), metadata=metadata)
