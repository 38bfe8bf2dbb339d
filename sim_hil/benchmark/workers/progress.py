"""Progress of a benchmark run on stderr: a bar on a terminal, otherwise a line per episode."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from sim_hil.benchmark.results.record import EpisodeResult, FailedRun
from sim_hil.benchmark.workers.jobs import RunWatcher

SHOWN = 4


class BenchProgress(AbstractContextManager["BenchProgress"]):
    """Progress display; pass `watcher` to the run."""

    def __init__(self, total: int, done: int, stream: TextIO | None = None) -> None:
        self._stream = stream if stream is not None else sys.stderr
        self._total, self._done = total, done
        self._reached = 0
        self._collided = 0
        self._console = Console(file=self._stream, highlight=False, soft_wrap=True)
        self._bar: Progress | None = None
        if self._stream.isatty():
            self._bar = Progress(
                TextColumn("[bold]edge-bench"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
                TimeRemainingColumn(), TextColumn("{task.description}", markup=False), console=self._console,
            )  # fmt: skip
            self._bar_task = self._bar.add_task("", total=total, completed=done)

    def __enter__(self) -> BenchProgress:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    @property
    def watcher(self) -> RunWatcher:
        """Callbacks for the run."""
        return RunWatcher(self._finished, self._failed, self._retried, self._running)

    def say(self, line: str) -> None:
        """Print a line above the bar."""
        self._console.print(line, markup=False)

    def _finished(self, result: EpisodeResult) -> None:
        self._done += 1
        end = "reached" if result.success else result.end
        hit = f", collided with {', '.join(result.collisions)}" if result.collided else ""
        took = f"{result.time_s:.0f} s simulated in {result.wall_s:.0f} s"
        self.say(f"[{self._done}/{self._total}] {result.id}: {end}, {result.ne_m:.1f} m from the goal{hit}; {took}")
        self._reached += result.success
        self._collided += result.collided
        self._advance()

    def _failed(self, failed: FailedRun) -> None:
        self._done += 1
        self.say(f"[{self._done}/{self._total}] {failed.id}: FAILED {failed.attempts} times: {failed.why}")
        self._advance()

    def _retried(self, episode_id: str, why: str) -> None:
        self.say(f"{episode_id}: runs again: {why}")

    def _advance(self) -> None:
        if self._bar is not None:
            self._bar.update(self._bar_task, completed=self._done)

    def _running(self, times: dict[str, float]) -> None:
        if self._bar is not None:
            at = ", ".join(f"{time_s:.0f} s" for time_s in sorted(times.values(), reverse=True)[:SHOWN])
            now = f"; at {at}" if times else ""
            counted = f"{self._reached} reached, {self._collided} collided{now}"
            self._bar.update(self._bar_task, description=counted)
