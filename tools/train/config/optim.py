"""Configuration of an optimiser."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tools.train.config.checks import Checked, Fraction, Natural, Positive, Range, Share


@dataclass(frozen=True)
class OptimConfig(Checked):
    """AdamW with warm-up and cosine decay; the defaults are the paper's for the action expert (Table 8)."""

    lr: Annotated[float, Range(0, 1, above=True, below=True)] = 2e-4
    final_lr_share: Share = 0.0
    """Final learning rate as a share of `lr`."""
    weight_decay: Fraction = 1e-2
    warmup_steps: Natural = 1000
    clip: Positive = 1.0
    beta1: Fraction = 0.9
    beta2: Fraction = 0.999
    bf16: bool = False
    """Compute forward passes in bfloat16; weights and moments stay float32."""
