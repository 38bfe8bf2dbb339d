"""What a stage is handed: numbers, folder, device, seed, ranks, and where it tells how far it is."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, field
from typing import Protocol
from zlib import crc32

import numpy as np
import torch

from reporting.build_progress import duration
from tools.train.config.recipe import Recipe
from tools.train.run.distributed import SINGLE, Ranks
from tools.train.run.run_dir import RunDir


class StageFailedError(Exception):
    """Work of a stage that went wrong, though what was asked for is sound; one line: what, and what to do."""


class StageProgress(Protocol):
    """Where a stage tells how far it is; called on every step, shown now and then."""

    def update(self, done: int, total: int, **numbers: float) -> None:
        """`done` of `total` units of work, with the numbers worth watching (loss, success …)."""

    def say(self, line: str) -> None:
        """One line for people."""


class QuietProgress:
    """Tells nobody."""

    def update(self, done: int, total: int, **numbers: float) -> None:
        """Nothing to do."""

    def say(self, line: str) -> None:
        """Nothing to do."""


class PlainProgress:
    """Lines on standard error, one in `period_s` at most."""

    def __init__(self, stage: str, period_s: float = 15.0) -> None:
        self._stage = stage
        self._period_s = period_s
        self._said_ns = time.monotonic_ns()
        self._began: tuple[int, int, int] | None = None
        """Total, first count and instant of the work under way: a stage may do one thing after another."""
        self._last = 0

    def update(self, done: int, total: int, **numbers: float) -> None:
        """Say it if the last line is long enough ago, or if that was the last of it."""
        now_ns = time.monotonic_ns()
        if self._began is None or self._began[0] != total or done < self._last:
            self._began, self._last = (total, done, now_ns), -1
        due = (now_ns - self._said_ns) / 1e9 >= self._period_s
        if done == self._last or not (due or done >= total):
            return
        self._said_ns, self._last = now_ns, done
        _, first, since_ns = self._began
        rate = (done - first) / max((now_ns - since_ns) / 1e9, 1e-9)
        shown = "".join(f", {name} {value:.4g}" for name, value in numbers.items())
        left = f", {duration((total - done) / rate)} to go" if rate > 0 and done < total else ""
        self.say(f"{done} of {total} ({rate:.3g} /s{left}){shown}")

    def say(self, line: str) -> None:
        """One line."""
        sys.stderr.write(f"edge-train: {self._stage}: {line}\n")


class StopFlag:
    """Set by a signal's handler; read between steps."""

    def __init__(self) -> None:
        self.asked = False

    def ask(self) -> None:
        """Have the running stage end at its next step, with a checkpoint."""
        self.asked = True


@dataclass(frozen=True)
class StageJob:
    """One stage of one run; a stage is a module with `run(job: StageJob) -> dict` (JSON numbers of its result)."""

    recipe: Recipe
    run_dir: RunDir
    resume: bool = False
    """Go on from the stage's checkpoint if there is one; else begin anew."""
    device: str = "cpu"
    progress: StageProgress = field(default_factory=QuietProgress)
    seed: int = 0
    """Of this stage in this run; what else must be random takes it with a tag of its own."""
    ranks: Ranks = SINGLE
    """This process among those of torchrun; one alone otherwise."""
    stop: StopFlag = field(default_factory=StopFlag)

    def rng(self, *tags: int | str) -> np.random.Generator:
        """Numpy's generator of this stage's seed and `tags`."""
        return np.random.default_rng((self.seed, *map(_number, tags)))

    def generator(self, *tags: int | str) -> torch.Generator:
        """Torch's generator on the CPU, of this stage's seed and `tags`."""
        seed = int(self.rng(*tags).integers(2**62))
        return torch.Generator().manual_seed(seed)

    def should_stop(self) -> bool:
        """Whether any rank was told to end: save a checkpoint, then raise KeyboardInterrupt. Call it on every rank."""
        return self.ranks.any(self.stop.asked)


def _number(tag: int | str) -> int:
    return tag if isinstance(tag, int) else crc32(tag.encode())
