"""Backend that runs episodes in processes of this machine."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from sim_hil.benchmark.conditions.conditions import ConditionsError
from sim_hil.benchmark.results.record import EpisodeResult, ResultError
from sim_hil.benchmark.results.store import EPISODES
from sim_hil.benchmark.workers.jobs import Ended
from sim_hil.benchmark.workers.task import EpisodeTask
from sim_hil.benchmark.workers.worker_pool import Workers
from sim_hil.processes.child_process import Message

ATTEMPTS = 2
"""Attempts per episode: one repetition if its process died."""
WORKER: Sequence[str] = (sys.executable, "-m", "sim_hil.benchmark.workers.worker")


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
            known = event.key in self._results
            ended.append(self._results.pop(event.key) if known else Ended(event.key, why=why))
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
