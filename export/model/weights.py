"""Weights on disk: safetensors with the network's configuration as metadata; never pickle."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from export.model.config import PRESETS, TicVlaConfig
from export.model.network import PARTS, TicVla

FORMAT = "tic-vla-edge/1"


class WeightsError(ValueError):
    """A weights file that is not what its reader was asked for."""


@dataclass(frozen=True)
class WeightsInfo:
    """What a weights file says of itself."""

    trained: bool
    origin: str


def weights_sha256(model: TicVla) -> str:
    """Hash of every tensor's name, shape and bytes; independent of the file it came from."""
    digest = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        digest.update(f"{name}:{tuple(tensor.shape)}:{tensor.dtype}".encode())
        digest.update(tensor.detach().contiguous().reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


def save_weights(model: TicVla, path: Path, info: WeightsInfo, parts: Sequence[str] = PARTS) -> None:
    """Write the weights of `parts` in one rename; raises OSError."""
    metadata = {
        "format": FORMAT,
        "config": json.dumps(model.config.to_dict(), sort_keys=True),
        "trained": "true" if info.trained else "false",
        "origin": info.origin,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    tensors = {k: v.contiguous() for k, v in model.state_dict().items() if k.split(".")[0] in parts}
    save_file(tensors, str(partial), metadata=metadata)
    partial.replace(path)


def load_weights(path: Path, config: TicVlaConfig) -> tuple[TicVla, WeightsInfo]:
    """Read a weights file made by `save_weights`; raises WeightsError when it is not exactly `config`'s network."""
    try:
        with safe_open(str(path), framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dict
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"{path}: not a readable safetensors file ({error})") from error
    if metadata.get("format") != FORMAT:
        raise WeightsError(f"{path}: format {metadata.get('format')!r}, expected {FORMAT!r}")
    if metadata.get("config") != json.dumps(config.to_dict(), sort_keys=True):
        raise WeightsError(f"{path}: was made for another configuration than preset {config.name!r}")
    model = TicVla(config)
    wanted = model.state_dict()
    missing, extra = sorted(set(wanted) - set(tensors)), sorted(set(tensors) - set(wanted))
    if missing or extra:
        raise WeightsError(f"{path}: missing tensors {missing[:3]}, unknown tensors {extra[:3]}")
    for name, tensor in tensors.items():
        if tensor.shape != wanted[name].shape or tensor.dtype != wanted[name].dtype:
            want = wanted[name]
            raise WeightsError(
                f"{path}: {name} is {tensor.dtype}{list(tensor.shape)}, expected {want.dtype}{list(want.shape)}"
            )
        if not torch.isfinite(tensor).all():
            raise WeightsError(f"{path}: {name} has values that are not finite")
    model.load_state_dict(tensors)
    return model.eval(), WeightsInfo(metadata.get("trained") == "true", metadata.get("origin", ""))


def preset(name: str) -> TicVlaConfig:
    """The configuration of a preset; raises WeightsError naming the presets there are."""
    if name not in PRESETS:
        raise WeightsError(f"model {name!r} is not known; expected one of: {', '.join(sorted(PRESETS))}")
    return PRESETS[name]
