"""Configuration of an optimiser."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class OptimConfig:
    """AdamW with warm-up and cosine decay; the defaults are the paper's for the action expert (Table 8)."""

    lr: float = 2e-4
    final_lr_share: float = 0.0
    """Final learning rate as a share of `lr`."""
    weight_decay: float = 1e-2
    warmup_steps: int = 1000
    clip: float = 1.0
    beta1: float = 0.9
    beta2: float = 0.999
    bf16: bool = False
    """Compute forward passes in bfloat16; weights and moments stay float32."""

    def __post_init__(self) -> None:
        if not (0 < self.lr < 1 and 0 <= self.final_lr_share <= 1 and 0 <= self.weight_decay < 1 and self.clip > 0):
            raise ValueError("expected lr and weight_decay below 1, final_lr_share from 0 to 1 and clip above 0")
        if not (self.warmup_steps >= 0 and 0 <= self.beta1 < 1 and 0 <= self.beta2 < 1):
            raise ValueError("expected warmup_steps from 0 on and betas from 0 to below 1")
