"""The interface of a stage, `StageJob`, and its progress display: a bar on a terminal, otherwise lines."""

from __future__ import annotations

import sys
import time
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Protocol, TextIO
from zlib import crc32

import numpy as np
import torch
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from reporting.build_progress import duration
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


class PlainProgress:
    """Progress as lines on standard error, at most one per `period_s`."""

    def __init__(self, stage: str, period_s: float = 15.0) -> None:
        self._stage = stage
        self._period_s = period_s
        self._shown_ns = time.monotonic_ns()
        self._began: tuple[int, int, int] | None = None
        """Total, first count and start of the current work, ns: a stage may have several parts."""
        self._last = 0

    def update(self, done: int, total: int, **numbers: float) -> None:
        """Write a line if the last one is at least `period_s` old, or if the work is done."""
        now_ns = time.monotonic_ns()
        if self._began is None or self._began[0] != total or done < self._last:
            self._began, self._last = (total, done, now_ns), -1
        due = (now_ns - self._shown_ns) / 1e9 >= self._period_s
        if done == self._last or not (due or done >= total):
            return
        self._shown_ns, self._last = now_ns, done
        _, first, since_ns = self._began
        rate = (done - first) / max((now_ns - since_ns) / 1e9, 1e-9)
        values = "".join(f", {name} {value:.4g}" for name, value in numbers.items())
        left = f", {duration((total - done) / rate)} to go" if rate > 0 and done < total else ""
        self.say(f"{done} of {total} ({rate:.3g} /s{left}){values}")

    def say(self, line: str) -> None:
        """Write one line."""
        sys.stderr.write(f"edge-train: {self._stage}: {line}\n")


@dataclass
class StopFlag:
    """A flag that a signal handler sets: the running stage ends at its next step, with a checkpoint."""

    asked: bool = False


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
        return self.ranks.any(self.stop.asked)


class StageBar(AbstractContextManager["StageBar"]):
    """A progress bar with the newest values; a `StageProgress`."""

    def __init__(self, stage: str, console: Console) -> None:
        self._stage, self._console = stage, console
        self._bar = Progress(
            TextColumn(f"[bold]edge-train[/bold] {stage}"), BarColumn(bar_width=24), MofNCompleteColumn(),
            TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("{task.description}", markup=False), console=console,
        )  # fmt: skip
        self._task: TaskID | None = None
        self._total = 0

    def __enter__(self) -> StageBar:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def update(self, done: int, total: int, **numbers: float) -> None:
        """Move the bar."""
        if self._task is None:
            self._task, self._total = self._bar.add_task("", total=total, completed=done), total
        if total != self._total:  # a stage may have several parts
            self._bar.reset(self._task, total=total)
            self._total = total
        values = ", ".join(f"{name} {value:.4g}" for name, value in numbers.items())
        self._bar.update(self._task, completed=done, total=total, description=values)

    def say(self, line: str) -> None:
        """Write a line above the bar."""
        self._console.print(f"edge-train: {self._stage}: {line}", markup=False)


def progress_for(
    stage: str, *, quiet: bool = False, stream: TextIO | None = None
) -> AbstractContextManager[StageProgress]:
    """Return the progress display for a stage: a bar, lines, or with `quiet` nothing."""
    if quiet:
        return nullcontext(QuietProgress())
    console = Console(file=stream if stream is not None else sys.stderr, highlight=False, soft_wrap=True)
    return StageBar(stage, console) if console.is_terminal else nullcontext(PlainProgress(stage))
