"""The interface of a stage, `StageJob`, and its progress display: a bar on a terminal, otherwise lines."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Protocol
from zlib import crc32

import numpy as np
import torch

from reporting.progress import Progress
from tools.train.config.recipe import Recipe
from tools.train.run.distributed import SINGLE, Ranks
from tools.train.run.run_dir import RunDir


class StageFailedError(Exception):
    """Failed work of a stage with valid arguments; one line: what failed and what to do."""


class StageProgress(Protocol):
    """Receives a stage's progress at every step and shows it from time to time."""

    def update(self, done: int, total: int, **numbers: float) -> None:
        """Report `done` of `total` units of work, with values to show (loss, success …)."""

    def log(self, line: str) -> None:
        """Show one line of text."""


class QuietProgress:
    """A progress that shows nothing."""

    def update(self, done: int, total: int, **numbers: float) -> None:
        """Nothing to do."""

    def log(self, line: str) -> None:
        """Nothing to do."""


@dataclass
class StopFlag:
    """A flag that a signal handler sets: the running stage ends at its next step, with a checkpoint."""

    requested: bool = False


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
        numbers = (tag if isinstance(tag, int) else crc32(tag.encode()) for tag in tags)
        return np.random.default_rng((self.seed, *numbers))

    def generator(self, *tags: int | str) -> torch.Generator:
        """Return a torch generator on the CPU for this stage's seed and `tags`."""
        seed = int(self.rng(*tags).integers(2**62))
        return torch.Generator().manual_seed(seed)

    def should_stop(self) -> bool:
        """Return whether any rank was interrupted. Then save a checkpoint and raise KeyboardInterrupt.

        Every rank must call this function.
        """
        return self.ranks.any(self.stop.requested)


class StageDisplay(Progress):
    """Progress with the newest values; a `StageProgress`."""

    def update(self, done: int, total: int, **numbers: float) -> None:
        """Report `done` of `total` units of work, with values to show."""
        self.show(", ".join(f"{name} {value:.4g}" for name, value in numbers.items()), done, total)


def progress_for(stage: str, *, quiet: bool = False) -> AbstractContextManager[StageProgress]:
    """Return the progress display of a stage; with `quiet` one that shows nothing."""
    return nullcontext(QuietProgress()) if quiet else StageDisplay(f"edge-train: {stage}: ", bar=True)
