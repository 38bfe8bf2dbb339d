"""AdamW with warm-up, cosine decay and clipped gradients (paper Table 8), and bfloat16 on request."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import cache

import torch

from tools.train.config.optim import OptimConfig
from tools.train.run import checkpoint
from tools.train.run.distributed import SINGLE, Ranks


class Optimiser:
    """AdamW over parameters for a known number of steps; `tensors` and `restore` resume it exactly."""

    def __init__(
        self, parameters: Iterable[torch.nn.Parameter], config: OptimConfig, total_steps: int, ranks: Ranks = SINGLE
    ) -> None:
        self.config = config
        self.total_steps = total_steps
        self.step_count = 0
        self._ranks = ranks
        self.parameters = [each for each in parameters if each.requires_grad]
        # No weight decay for gains and biases.
        decayed = [each for each in self.parameters if each.ndim >= 2]
        others = [each for each in self.parameters if each.ndim < 2]
        groups = [{"params": decayed, "weight_decay": config.weight_decay}, {"params": others, "weight_decay": 0.0}]
        self._adam = torch.optim.AdamW(
            [group for group in groups if group["params"]], lr=config.lr, betas=(config.beta1, config.beta2)
        )

    @property
    def lr(self) -> float:
        """Learning rate of the next step."""
        return learning_rate(self.config, self.step_count, self.total_steps)

    def zero_grad(self) -> None:
        """Reset the gradients."""
        self._adam.zero_grad(set_to_none=True)

    def step(self, weight: float = 1.0) -> float:
        """Update once from the gradients of this rank's mean loss over `weight` samples; return the gradient norm.

        Gradients are averaged over ranks and clipped first; if the norm is not finite, the update is skipped.
        """
        self._ranks.average_gradients(self.parameters, weight)
        norm = float(torch.nn.utils.clip_grad_norm_(self.parameters, self.config.clip))
        for group in self._adam.param_groups:
            group["lr"] = self.lr
        if math.isfinite(norm):
            self._adam.step()
        self.step_count += 1
        self.zero_grad()
        return norm

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return the moments and the step for a checkpoint."""
        count = torch.tensor(self.step_count, dtype=torch.int64)
        return {**checkpoint.with_prefix("adam", checkpoint.optimiser_tensors(self._adam)), "step_count": count}

    def restore(self, tensors: Mapping[str, torch.Tensor]) -> None:
        """Resume from what `tensors` returned."""
        self.step_count = int(tensors["step_count"])
        checkpoint.restore_optimiser(self._adam, checkpoint.under("adam", tensors))


def learning_rate(config: OptimConfig, step: int, total_steps: int) -> float:
    """Return the rate at a step: linear warm-up for at most a tenth of the run, then a cosine to `final_lr_share`."""
    warmup = min(config.warmup_steps, total_steps // 10)
    if step < warmup:
        return config.lr * (step + 1) / warmup
    share = min((step - warmup) / max(total_steps - warmup, 1), 1.0)
    low = config.lr * config.final_lr_share
    return low + (config.lr - low) * (1 + math.cos(math.pi * share)) / 2


def autocast(device: str, bf16: bool) -> AbstractContextManager[object]:
    """Return a context for bfloat16 if `bf16` is set and the device supports it, else for float32."""
    kind = torch.device(device).type
    return torch.autocast(kind, dtype=torch.bfloat16) if bf16 and computes_bf16(kind) else nullcontext()


@cache
def computes_bf16(device: str) -> bool:
    """Return whether the device has bfloat16 instructions: emulation takes twelve times as long as float32."""
    if torch.device(device).type != "cpu":
        return True
    found = torch.cpu.get_capabilities()
    return any(found.get(name, False) for name in ("avx512_bf16", "amx_bf16", "bf16"))
