"""Progress of a stage on standard error: a bar on a terminal, otherwise a line from time to time."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

from reporting.progress import Progress
from tools.train.run.job import QuietProgress, StageProgress


class StageDisplay(Progress):
    """Progress with the newest values; a `StageProgress`."""

    def update(self, done: int, total: int, **numbers: float) -> None:
        """Report `done` of `total` units of work, with values to show."""
        self.show(", ".join(f"{name} {value:.4g}" for name, value in numbers.items()), done, total)


def progress_for(stage: str, *, quiet: bool = False) -> AbstractContextManager[StageProgress]:
    """Return the progress display of a stage; with `quiet` one that shows nothing."""
    return nullcontext(QuietProgress()) if quiet else StageDisplay(f"edge-train: {stage}: ", bar=True)
