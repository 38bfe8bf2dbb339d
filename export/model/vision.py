"""Vision encoder: InternViT blocks, pixel shuffle v2 and the projector into visual tokens."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, TypeAlias

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 - torch's own idiom

from export.model.attention import TypedModuleList
from export.model.config import VisionConfig

Attention: TypeAlias = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Queries, keys and values [n, heads, t, d] to the attended values [n, heads, t, d]."""
TORCH_ATTENTION: Final[Attention] = F.scaled_dot_product_attention
"""That of the exported graphs."""


def pixel_shuffle_v2(x: Tensor, side: int) -> Tensor:
    """Fold each side×side square of a [n, w, h, c] map into one cell of side²·c channels (InternVL's `v2` order)."""
    n, w, h, c = x.shape
    x = x.reshape(n, w, h // side, c * side).permute(0, 2, 1, 3)
    x = x.reshape(n, h // side, w // side, c * side * side)
    return x.permute(0, 2, 1, 3)


def fold_tokens(tokens: Tensor, side: int) -> Tensor:
    """Apply `pixel_shuffle_v2` to a square of tokens [n, g², c], giving [n, (g/side)², side²·c]."""
    if side == 1:
        return tokens
    n, count, c = tokens.shape
    grid = round(count**0.5)
    folded = pixel_shuffle_v2(tokens.reshape(n, grid, grid, c), side)
    return folded.reshape(n, (grid // side) ** 2, c * side * side)


class VisionBlock(nn.Module):
    """Pre-norm attention and MLP with LayerScale."""

    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        self.heads = config.heads
        self.norm1 = nn.LayerNorm(config.hidden, eps=config.layer_norm_eps)
        self.qkv = nn.Linear(config.hidden, 3 * config.hidden)
        self.proj = nn.Linear(config.hidden, config.hidden)
        self.ls1 = nn.Parameter(torch.full((config.hidden,), config.layer_scale_init))
        self.norm2 = nn.LayerNorm(config.hidden, eps=config.layer_norm_eps)
        self.fc1 = nn.Linear(config.hidden, config.mlp)
        self.fc2 = nn.Linear(config.mlp, config.hidden)
        self.ls2 = nn.Parameter(torch.full((config.hidden,), config.layer_scale_init))

    def forward(self, x: Tensor, attention: Attention = TORCH_ATTENTION) -> Tensor:
        n, t, d = x.shape
        qkv: Tensor = self.qkv(self.norm1(x)).reshape(n, t, 3, self.heads, d // self.heads).permute(2, 0, 3, 1, 4)
        attended = attention(qkv[0], qkv[1], qkv[2])
        x = x + self.ls1 * self.proj(attended.transpose(1, 2).reshape(n, t, d))
        out: Tensor = x + self.ls2 * self.fc2(F.gelu(self.fc1(self.norm2(x))))
        return out


class VisionEncoder(nn.Module):
    """uint8 frame [n, H, W, 3] (RGB) → visual tokens [n, N, D]; normalisation is part of the graph."""

    mean: Tensor
    inv_std: Tensor

    def __init__(self, config: VisionConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("mean", torch.tensor(config.mean) * 255, persistent=False)
        self.register_buffer("inv_std", 1 / (torch.tensor(config.std) * 255), persistent=False)
        if config.stem_channels:
            layers: list[nn.Module] = []
            channels = 3
            for width in config.stem_channels:
                layers += [nn.Conv2d(channels, width, 3, stride=2, padding=1), nn.GELU()]
                channels = width
            self.embed: nn.Module = nn.Sequential(*layers, nn.Conv2d(channels, config.hidden, 1))
        else:
            self.embed = nn.Conv2d(3, config.hidden, config.patch_px, stride=config.patch_px)
        self.cls = nn.Parameter(torch.zeros(1, 1, config.hidden))
        self.position = nn.Parameter(torch.zeros(1, 1 + config.grid**2, config.hidden))
        self.blocks = TypedModuleList(VisionBlock(config) for _ in range(config.layers))
        folded = config.hidden * config.pixel_shuffle**2
        self.projector = nn.Sequential(
            nn.LayerNorm(folded, eps=config.projector_eps),
            nn.Linear(folded, config.token_dim),
            nn.GELU(),
            nn.Linear(config.token_dim, config.token_dim),
        )

    def forward(self, frame: Tensor, attention: Attention = TORCH_ATTENTION) -> Tensor:
        pixels = (frame.float() - self.mean) * self.inv_std
        x = self.embed(pixels.permute(0, 3, 1, 2)).flatten(2).transpose(1, 2)
        x = torch.cat([self.cls.expand(x.shape[0], -1, -1), x], dim=1) + self.position
        for block in self.blocks:
            x = block(x, attention)
        # No CLS token and no final norm, like the input of InternVL's projector.
        tokens: Tensor = self.projector(fold_tokens(x[:, 1:], self.config.pixel_shuffle))
        return tokens
