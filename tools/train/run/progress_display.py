"""Progress of a stage on standard error: a bar on a terminal, otherwise a line from time to time."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager
from typing import TextIO

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

from tools.train.run.job import PlainProgress, QuietProgress, StageProgress


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


class _Lines(AbstractContextManager[StageProgress]):
    """Context manager around a progress that needs no cleanup."""

    def __init__(self, progress: StageProgress) -> None:
        self._progress = progress

    def __enter__(self) -> StageProgress:
        return self._progress

    def __exit__(self, *_: object) -> None:
        return


def progress_for(
    stage: str, *, quiet: bool = False, stream: TextIO | None = None
) -> AbstractContextManager[StageProgress]:
    """Return the progress display for a stage: a bar, lines, or with `quiet` nothing."""
    if quiet:
        return _Lines(QuietProgress())
    console = Console(file=stream if stream is not None else sys.stderr, highlight=False, soft_wrap=True)
    return StageBar(stage, console) if console.is_terminal else _Lines(PlainProgress(stage))
