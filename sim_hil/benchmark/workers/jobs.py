"""Distribution of episodes to workers; each result counts once, even if workers die.

A `Backend` provides the workers: processes of this machine (`LocalJobs`) or a Ray cluster (`cluster`).
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from edge.core.cli import EXIT_REFUSED, write_whole
from sim_hil.benchmark.conditions.conditions import ConditionsError
from sim_hil.benchmark.results.record import EpisodeResult, FailedRun, ResultError
from sim_hil.benchmark.results.store import EPISODES, ResultStore
from sim_hil.benchmark.workers.task import EpisodeTask
from sim_hil.benchmark.workers.worker_pool import Workers
from sim_hil.processes.child_process import Message

POLL_S = 0.2
ATTEMPTS = 2
"""Attempts per episode: one repetition if its process died."""
WORKER: Sequence[str] = (sys.executable, "-m", "sim_hil.benchmark.workers.worker")


class RefusedRunError(Exception):
    """An episode that can never run, which ends the whole run; `code` is the exit code."""

    def __init__(self, line: str, code: int) -> None:
        super().__init__(line)
        self.code = code


@dataclass(frozen=True)
class Ended:
    """Outcome of one attempt: a result, or why there is none; a refusal applies to every further attempt."""

    id: str
    result: EpisodeResult | None = None
    files: tuple[tuple[str, bytes], ...] = ()
    """Files of a remote worker, by path below the run's directory."""
    why: str = ""
    refused_code: int | None = None


class Backend(Protocol):
    """Executor of tasks; `close` ends running tasks and may be called twice."""

    @property
    def attempts(self) -> int:
        """Maximum number of attempts per episode."""
        ...

    def free(self) -> int:
        """Return the number of further tasks that can start now."""
        ...

    def start(self, task: EpisodeTask) -> None:
        """Start a task."""
        ...

    def wait(self, timeout_s: float) -> Sequence[Ended]:
        """Wait until an attempt ends or the time is over; return the ended attempts."""
        ...

    def times_s(self) -> dict[str, float]:
        """Return the episode times of running tasks by id, s, as far as known."""
        ...

    def close(self) -> None:
        """End all started tasks."""
        ...


@dataclass
class RunWatcher:
    """Callbacks while episodes run; by default they do nothing."""

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
    """Run every task without a result; return False if `stopped` ended the run.

    An attempt without a result is repeated up to the backend's maximum, then recorded as failed. All started tasks are
    ended in any case. Raises RefusedRunError or OSError.
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
                # A duplicate report of an attempt is ignored: its task is no longer under way.
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
            path = store.directory / name
            path.parent.mkdir(exist_ok=True)
            write_whole(path, data)
        if store.add(ended.result):
            watcher.finished(ended.result)
    elif task.attempt < backend.attempts:
        watcher.retried(ended.id, ended.why)
        waiting.append(replace(task, attempt=task.attempt + 1))
    else:
        failed = FailedRun(ended.id, task.attempt, ended.why)
        store.add_failed(failed)
        watcher.failed(failed)


class LocalJobs:
    """Backend with up to `jobs` episodes in parallel."""

    attempts = ATTEMPTS

    def __init__(self, jobs: int, worker: Sequence[str] = WORKER) -> None:
        if jobs < 1:
            raise ConditionsError(f"--jobs: expected 1 or more, found {jobs}")
        self._workers = Workers(worker, jobs)
        self._times_s: dict[str, float] = {}
        self._results: dict[str, Ended] = {}

    def free(self) -> int:
        """Return the number of further processes that may start."""
        return self._workers.free()

    def pids(self) -> dict[str, int]:
        """Return the process id of every running episode."""
        return self._workers.pids()

    def start(self, task: EpisodeTask) -> None:
        """Start a worker. Raises OSError if no process can be created."""
        name = task.episode.id
        self._workers.start(name, task.as_json(), task.folder / EPISODES / f"{name}.log")
        self._times_s[name] = 0.0

    def wait(self, timeout_s: float) -> Sequence[Ended]:
        """Return the attempts whose process has ended."""
        ended: list[Ended] = []
        for event in self._workers.wait(timeout_s):
            if event.message is not None:
                self._take(event.key, event.message)
                continue
            del self._times_s[event.key]
            why = f"its process gave no result: {event.failure or 'ended with exit code 0'}"
            # The guard of unproven graphs ends a process that hangs in one: a further attempt would hang too.
            refused = EXIT_REFUSED if event.code == EXIT_REFUSED else None
            known = event.key in self._results
            ended.append(self._results.pop(event.key) if known else Ended(event.key, why=why, refused_code=refused))
        return ended

    def times_s(self) -> dict[str, float]:
        """Return the episode times of running tasks, s."""
        return dict(self._times_s)

    def close(self) -> None:
        """End all workers."""
        self._workers.close()
        self._times_s.clear()

    def _take(self, name: str, content: Message) -> None:
        """Keep what a worker reports; ignore a message of any other form."""
        try:
            if "result" in content:
                self._results[name] = Ended(name, result=EpisodeResult.of_json(content["result"]))
            elif "refused" in content:
                self._results[name] = Ended(name, why=str(content["refused"]), refused_code=int(content["code"]))
            elif "failed" in content:
                self._results[name] = Ended(name, why=str(content["failed"]))
            else:
                self._times_s[name] = float(content["time_s"])
        except (ValueError, KeyError, TypeError, ResultError):
            return
