"""How much the reasoning thread may think: set by the power governor, read before a generation."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class ReasoningBudget:
    """What is allowed from the next generation on; control is never part of it."""

    allowed: bool = True
    """False: no generation is started, and one under way is cancelled."""
    pause_s: float = 0.0
    """Rest between two generations."""
    max_new_tokens: int | None = None
    """Cap below the artifacts' own; None: no other cap."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.pause_s) and self.pause_s >= 0):
            raise ValueError(f"pause_s must be 0 or more, found {self.pause_s}")
        if self.max_new_tokens is not None and self.max_new_tokens < 0:
            raise ValueError(f"max_new_tokens must be 0 or more, found {self.max_new_tokens}")


UNLIMITED = ReasoningBudget()
