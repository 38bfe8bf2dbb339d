"""The interface of a stage: `StageJob` with recipe, folder, device, seed, ranks and progress display."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol
from zlib import crc32

import numpy as np
import torch

from tools.train.config.recipe import Recipe
from tools.train.run.distributed import SINGLE, Ranks
from tools.train.run.run_dir import RunDir


class StageFailedError(Exception):
    """Failed work of a stage with valid arguments; one line: what failed and what to do."""


class StageProgress(Protocol):
    """Receives a stage's progress at every step and shows it from time to time."""

    def update(self, done: int, total: int, **numbers: float) -> None:
        """Report `done` of `total` units of work, with values to show (loss, success …)."""

    def say(self, line: str) -> None:
        """Show one line of text."""


class QuietProgress:
    """A progress that shows nothing."""

    def update(self, done: int, total: int, **numbers: float) -> None:
        """Nothing to do."""

    def say(self, line: str) -> None:
        """Nothing to do."""


class StopFlag:
    """A flag that a signal handler sets and a stage reads between steps."""

    def __init__(self) -> None:
        self.asked = False

    def ask(self) -> None:
        """Request that the running stage ends at its next step, with a checkpoint."""
        self.asked = True


@dataclass(frozen=True)
class StageJob:
    """Input of one stage; a stage is a module with `run(job: StageJob) -> dict`, which returns JSON values."""

    recipe: Recipe
    run_dir: RunDir
    resume: bool = False
    """Resume from the stage's checkpoint if there is one; else start anew."""
    device: str = "cpu"
    progress: StageProgress = field(default_factory=QuietProgress)
    seed: int = 0
    """Seed of this stage in this run; random numbers derive from it with a tag (`rng`, `generator`)."""
    ranks: Ranks = SINGLE
    """This process among those of torchrun."""
    stop: StopFlag = field(default_factory=StopFlag)

    def rng(self, *tags: int | str) -> np.random.Generator:
        """Return a numpy generator for this stage's seed and `tags`."""
        return np.random.default_rng((self.seed, *map(_number, tags)))

    def generator(self, *tags: int | str) -> torch.Generator:
        """Return a torch generator on the CPU for this stage's seed and `tags`."""
        seed = int(self.rng(*tags).integers(2**62))
        return torch.Generator().manual_seed(seed)

    def should_stop(self) -> bool:
        """Return whether any rank was interrupted. Then save a checkpoint and raise KeyboardInterrupt.

        Every rank must call this function.
        """
        return self.ranks.any(self.stop.asked)


def _number(tag: int | str) -> int:
    return tag if isinstance(tag, int) else crc32(tag.encode())
