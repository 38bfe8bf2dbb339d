"""Pool of worker processes: a new interpreter per job, one core each, ended with the parent; messages are JSON.

The worker's side is `sim_hil.benchmark.workers.worker_process`.
"""

from __future__ import annotations

import json
import os
import selectors
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sim_hil.benchmark.workers.worker_process import SINGLE_THREADED
from sim_hil.processes.child_process import ChildProcess, Message, exit_text, last_lines, parse_message

GRACE_S: Final = 2.0
"""Time from SIGTERM to SIGKILL, s."""
SILENT_S: Final = 3600.0
"""Time without a message after which a worker counts as hung and is killed, s."""
_TAIL_CHARS: Final = 400
_EXIT_POLL_S: Final = 0.05
_POLL_S: Final = 0.5


@dataclass(frozen=True)
class WorkerEvent:
    """A message of a worker, or its end: then `message` is None, and `failure` says how it ended if not well."""

    key: str
    message: Message | None
    failure: str = ""
    code: int = 0
    """Exit code of a worker that has ended, negative for a signal."""


@dataclass(frozen=True)
class WorkerJob:
    """One job: its name among the jobs, its content as JSON values, and the file for what its process prints."""

    key: str
    content: Mapping[str, Any]
    log: Path


@dataclass
class _Worker:
    key: str
    process: ChildProcess
    log: Path
    last_message_ns: int
    registered: bool = True


class Workers:
    """Up to `jobs` processes of `command` at a time; 0 jobs: one per core. All are ended when the block is left."""

    def __init__(self, command: Sequence[str], jobs: int) -> None:
        if jobs < 0:
            raise ValueError(f"workers: expected 0 jobs or more, found {jobs}")
        self._command, self._jobs = command, jobs or len(os.sched_getaffinity(0))
        self._running: dict[str, _Worker] = {}
        self._selector = selectors.DefaultSelector()

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def free(self) -> int:
        """Return the number of further processes that may start."""
        return self._jobs - len(self._running)

    def running(self) -> int:
        """Return the number of running processes."""
        return len(self._running)

    def pids(self) -> dict[str, int]:
        """Return the process id of every running job."""
        return {key: worker.process.pid for key, worker in self._running.items()}

    def run(self, waiting: deque[WorkerJob], stopped: Callable[[], bool]) -> Iterator[list[WorkerEvent]]:
        """Run all jobs, also those appended to `waiting` meanwhile; yields the events of each half second.

        Raises OSError when a process cannot be started, KeyboardInterrupt when `stopped`.
        """
        while waiting or self._running:
            if stopped():
                raise KeyboardInterrupt
            while waiting and self.free() > 0:
                job = waiting.popleft()
                self.start(job.key, job.content, job.log)
            yield self.wait(_POLL_S)

    def start(self, key: str, job: Mapping[str, object], log: Path) -> None:
        """Start a process on a job; what it prints is in `log` until it ends well. Raises OSError."""
        process = ChildProcess(self._command, log=log, own_pipe=True, env=SINGLE_THREADED, new_session=True)
        worker = self._running[key] = _Worker(key, process, log, time.monotonic_ns())
        self._selector.register(process, selectors.EVENT_READ, worker)
        process.send(json.dumps(job).encode())  # one that has died already is found by `wait`
        process.close_input()

    def wait(self, timeout_s: float) -> list[WorkerEvent]:
        """Events since the last call; waits until there is one or the time is over."""
        if any(worker.process.at_end for worker in self._running.values()):
            timeout_s = min(timeout_s, _EXIT_POLL_S)
        events: list[WorkerEvent] = []
        for key, _ in self._selector.select(timeout_s):
            events += self._read(key.data)
        for worker in list(self._running.values()):
            if time.monotonic_ns() - worker.last_message_ns > SILENT_S * 1e9:
                worker.process.kill()
            code = worker.process.poll()
            if code is not None:
                events += self._read(worker)
                events.append(self._finish(worker, code))
        return events

    def close(self) -> None:
        """End all processes: SIGTERM, then SIGKILL."""
        for worker in self._running.values():
            worker.process.terminate()
        deadline_ns = time.monotonic_ns() + round(GRACE_S * 1e9)
        for worker in self._running.values():
            worker.process.close(max(0.0, (deadline_ns - time.monotonic_ns()) / 1e9))
        self._running.clear()
        self._selector.close()

    def _read(self, worker: _Worker) -> list[WorkerEvent]:
        lines = worker.process.read()
        if lines:
            worker.last_message_ns = time.monotonic_ns()
        if worker.process.at_end:  # a pipe at its end is always readable: it would end every `wait` at once
            self._unregister(worker)
        return [WorkerEvent(worker.key, message) for line in lines if (message := parse_message(line)) is not None]

    def _unregister(self, worker: _Worker) -> None:
        if worker.registered:
            self._selector.unregister(worker.process)
        worker.registered = False

    def _finish(self, worker: _Worker, code: int) -> WorkerEvent:
        del self._running[worker.key]
        self._unregister(worker)  # a process that the worker has left behind may hold the pipe open
        worker.process.close(0.0)
        if code == 0:
            worker.log.unlink(missing_ok=True)
            return WorkerEvent(worker.key, None)
        return WorkerEvent(worker.key, None, f"{exit_text(code)}{_last_line(worker.log)}", code)


def _last_line(log: Path) -> str:
    lines = last_lines(log)
    return f": {lines[-1].strip()[-_TAIL_CHARS:]}" if lines else ""
