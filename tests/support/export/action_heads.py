"""Small action experts of every head, with weights that look trained, and inputs for them."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from torch import Tensor, nn

from export.model.action import ActionExpert
from export.model.config import ActionConfig, LanguageConfig, TicVlaConfig, VisionConfig
from export.model.network import TicVla, build

HEADS = ("query", "diffusion", "flow")
TINY = TicVlaConfig(
    name="tiny",
    vision=VisionConfig(image_px=28, hidden=16, layers=1, heads=2, mlp=16, pixel_shuffle=1, token_dim=32),
    language=LanguageConfig(
        hidden=32,
        layers=1,
        heads=2,
        kv_heads=1,
        head_dim=8,
        mlp=16,
        vocab=32,
        max_context=64,
        im_start_id=1,
        im_end_id=2,
        img_start_id=3,
        img_end_id=4,
        img_context_id=5,
    ),
    action=ActionConfig(hidden=32, layers=2, heads=2, ffn=48, steps=11),
)
"""An odd number of steps: a flow's halves are not equal."""


def with_head(config: TicVlaConfig, head: str, **fields: Any) -> TicVlaConfig:
    return dataclasses.replace(config, action=dataclasses.replace(config.action, head=head, **fields))


def lively(config: TicVlaConfig, seed: int = 0) -> TicVla:
    """A network whose head says something: what it gives is not near zero, and actions have sizes of their own."""
    model = build(config, seed)
    generator = torch.Generator().manual_seed(seed + 1000)
    action = model.action
    with torch.no_grad():
        for name, module in action.named_modules():
            if isinstance(module, nn.Linear) and name.split(".")[-1] == "out":
                # The query head's numbers are metres and radians a step, the others' are without unit.
                spread = (0.05 if config.action.head == "query" else 0.5) * module.in_features**-0.5
                module.weight.normal_(0.0, spread, generator=generator)
                module.bias.normal_(0.0, spread, generator=generator)
        if action.scale is not None:
            action.scale.mean.normal_(0.0, 0.05, generator=generator)
            action.scale.std.uniform_(0.02, 0.08, generator=generator)
        if action.flow is not None:
            action.flow.noise.normal_(generator=generator)
    return model


def expert(head: str, seed: int = 0, **fields: Any) -> ActionExpert:
    return lively(with_head(TINY, head, **fields), seed).action


def normal(seed: int, *shape: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def instants(batch: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Visual tokens [B, 4, 32], state [B, 3] and latency [B, 4]."""
    return normal(seed, batch, 4, 32), normal(seed + 1, batch, 3), normal(seed + 2, batch, 4)


def states(batch: int, tokens: int, seed: int = 5) -> Tensor:
    """K‖V [B, T, kv_dim]."""
    return normal(seed, batch, tokens, TINY.kv_dim)


def drives(batch: int, steps: int = 11, seed: int = 9) -> Tensor:
    """Driven trajectories [B, steps, 3]: forward about 0.05 m a step, turning either way."""
    steps_driven = 0.02 * normal(seed, batch, steps, 3) + torch.tensor([0.05, 0.0, 0.0])
    return steps_driven.cumsum(dim=1)
