"""Hands episodes to workers and takes each result once, whatever happens to a worker.

Where the workers are is a `Backend`: processes of this machine (`local_jobs`) or a Ray cluster (`cluster`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from edge.core.cli import write_whole
from sim_hil.benchmark.results.record import EpisodeResult, FailedRun
from sim_hil.benchmark.results.store import ResultStore
from sim_hil.benchmark.workers.task import EpisodeTask

POLL_S = 0.2


class RefusedRunError(Exception):
    """An episode that no further attempt can run; the whole run is ended by it. `code` is the exit code."""

    def __init__(self, line: str, code: int) -> None:
        super().__init__(line)
        self.code = code


@dataclass(frozen=True)
class Ended:
    """What came of one attempt: a result, or why there is none; a refusal holds for every further attempt."""

    id: str
    result: EpisodeResult | None = None
    files: tuple[tuple[str, bytes], ...] = ()
    """Files of a worker elsewhere, by their path below the run's directory."""
    why: str = ""
    refused_code: int | None = None


class Backend(Protocol):
    """Runs tasks; `close` ends what still runs and may be called twice."""

    @property
    def attempts(self) -> int:
        """How often an episode is tried."""
        ...

    def free(self) -> int:
        """How many more tasks it takes now."""
        ...

    def start(self, task: EpisodeTask) -> None:
        """Begin a task."""
        ...

    def wait(self, timeout_s: float) -> Sequence[Ended]:
        """Attempts that have ended, waited for until there is one or the time is over."""
        ...

    def times_s(self) -> dict[str, float]:
        """Episode time of what runs, by id, as far as it is known."""
        ...

    def close(self) -> None:
        """End everything that was started."""
        ...


@dataclass
class RunWatcher:
    """What is told while episodes run; the default tells nobody."""

    finished: Callable[[EpisodeResult], None] = lambda result: None
    failed: Callable[[FailedRun], None] = lambda failed: None
    retried: Callable[[str, str], None] = lambda episode_id, why: None
    running: Callable[[dict[str, float]], None] = lambda times: None


def run_all(
    tasks: Sequence[EpisodeTask],
    backend: Backend,
    store: ResultStore,
    *,
    stopped: Callable[[], bool] = lambda: False,
    watcher: RunWatcher | None = None,
) -> bool:
    """Run every task that has no result yet; False when `stopped` ended it before.

    An attempt that ends without a result is repeated up to the backend's attempts, then recorded as failed. Raises
    RefusedRunError, OSError. What was started is ended in any case.
    """
    watcher = watcher or RunWatcher()
    waiting = deque(task for task in tasks if not store.has(task.episode.id))
    under_way: dict[str, EpisodeTask] = {}
    try:
        while waiting or under_way:
            if stopped():
                return False
            while waiting and backend.free() > 0:
                task = waiting.popleft()
                under_way[task.episode.id] = task
                backend.start(task)
            for ended in backend.wait(POLL_S):
                # Told twice, an attempt counts once: the second finds nothing under way.
                task_ended = under_way.pop(ended.id, None)
                if task_ended is not None:
                    _take(ended, task_ended, backend, store, watcher, waiting)
            watcher.running(backend.times_s())
        return True
    finally:
        backend.close()


def _take(
    ended: Ended,
    task: EpisodeTask,
    backend: Backend,
    store: ResultStore,
    watcher: RunWatcher,
    waiting: deque[EpisodeTask],
) -> None:
    if ended.refused_code is not None:
        raise RefusedRunError(f"episode {ended.id}: {ended.why}", ended.refused_code)
    if ended.result is not None:
        for name, data in ended.files:
            write_whole(store.directory / name, data)
        if store.add(ended.result):
            watcher.finished(ended.result)
    elif task.attempt < backend.attempts:
        watcher.retried(ended.id, ended.why)
        waiting.append(replace(task, attempt=task.attempt + 1))
    else:
        failed = FailedRun(ended.id, task.attempt, ended.why)
        store.add_failed(failed)
        watcher.failed(failed)
