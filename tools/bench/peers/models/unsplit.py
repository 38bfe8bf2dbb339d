"""The network's parts as PyTorch modules for the peers: seeded weights, the action expert in one piece."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from export.model.action import ActionExpert
from export.model.config import TicVlaConfig
from export.model.vision import VisionEncoder, pixel_shuffle_v2


class UnsplitAction(nn.Module):
    """Context projection and step in one forward, as every peer would run the action expert."""

    def __init__(self, expert: ActionExpert) -> None:
        super().__init__()
        self.expert = expert

    def forward(self, visual_tokens: Tensor, state: Tensor, latency: Tensor, last_layer_kv: Tensor) -> Tensor:
        """Trajectory [1, steps, 3] from visual tokens, state, latency and the semantic state [1, T, kv_dim]."""
        keys, values = self.expert.context(last_layer_kv)
        trajectory: Tensor = self.expert(visual_tokens, state, latency, keys, values)
        return trajectory


class FixedEncoder(nn.Module):
    """The encoder with its grid as a number: a tracer cannot take the root of a traced count of tokens."""

    def __init__(self, encoder: VisionEncoder) -> None:
        super().__init__()
        self.encoder = encoder

    def forward(self, frame: Tensor) -> Tensor:
        """Visual tokens [1, N, D] of a frame [1, px, px, 3]."""
        e, c = self.encoder, self.encoder.config
        pixels = ((frame.float() - e.mean) * e.inv_std).to(e.cls.dtype)
        x = e.embed(pixels.permute(0, 3, 1, 2)).flatten(2).transpose(1, 2)
        x = torch.cat([e.cls, x], dim=1) + e.position
        for block in e.blocks:
            x = block(x)
        x = x[:, 1:].reshape(1, c.grid, c.grid, c.hidden)
        if c.pixel_shuffle > 1:
            x = pixel_shuffle_v2(x, c.pixel_shuffle)
        tokens: Tensor = e.projector(x.reshape(1, c.tokens, c.hidden * c.pixel_shuffle**2))
        return tokens


def _filled(module: nn.Module, path: Path) -> None:
    module.load_state_dict(load_file(str(path)), assign=True)
    module.eval().requires_grad_(False)


def load_vision(config: TicVlaConfig, reference: Path) -> FixedEncoder:
    """The encoder with the reference's weights."""
    # On "meta" nothing is allocated: a peer's peak memory must not hold weights that are replaced at once.
    with torch.device("meta"):
        encoder = VisionEncoder(config.vision)
    encoder.mean = torch.tensor(config.vision.mean) * 255
    encoder.inv_std = 1 / (torch.tensor(config.vision.std) * 255)
    _filled(encoder, reference / "vision.safetensors")
    return FixedEncoder(encoder)


def load_action(config: TicVlaConfig, reference: Path) -> UnsplitAction:
    """The unsplit action expert with the reference's weights."""
    with torch.device("meta"):
        expert = ActionExpert(config)
    _filled(expert, reference / "action.safetensors")
    return UnsplitAction(expert)
