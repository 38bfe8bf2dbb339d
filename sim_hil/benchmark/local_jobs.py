"""Episodes in processes of this machine: a fresh interpreter each, one core, ended with their parent."""

from __future__ import annotations

import json
import os
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from sim_hil.benchmark.conditions import ConditionsError
from sim_hil.benchmark.jobs import Ended
from sim_hil.benchmark.results import EpisodeResult, ResultError
from sim_hil.benchmark.store import EPISODES
from sim_hil.benchmark.task import EpisodeTask
from sim_hil.benchmark.worker_process import SINGLE_THREADED

ATTEMPTS = 2
"""An episode whose process died is run once more."""
LONGEST_NS = 7_200_000_000_000
"""An episode that takes more than two hours of real time hangs."""
GRACE_S = 2.0
EXIT_POLL_S = 0.05
"""How soon the exit of a worker is seen that has said its last."""
TAIL_CHARS = 400
_GREETING = "pybullet build time"
"""What every process says that loads the engine; no reason to die."""
WORKER: Sequence[str] = (sys.executable, "-m", "sim_hil.benchmark.worker")


@dataclass
class Attempt:
    """A worker process and what it has told so far."""

    task: EpisodeTask
    process: subprocess.Popen[bytes]
    lines: IO[bytes]
    log: Path
    started_ns: int
    buffer: bytearray = field(default_factory=bytearray)
    time_s: float = 0.0
    ended: Ended | None = None
    at_end: bool = False
    """Nothing more can come: the worker has closed its end, or has died."""


class LocalJobs:
    """Up to `jobs` worker processes at a time."""

    attempts = ATTEMPTS

    def __init__(self, jobs: int, worker: Sequence[str] = WORKER) -> None:
        if jobs < 1:
            raise ConditionsError(f"--jobs: expected 1 or more, found {jobs}")
        self._jobs = jobs
        self._worker = worker
        self._running: dict[str, Attempt] = {}
        self._selector = selectors.DefaultSelector()

    def free(self) -> int:
        """Processes that may still be started."""
        return self._jobs - len(self._running)

    def pids(self) -> dict[str, int]:
        """Process id of every episode that runs."""
        return {name: attempt.process.pid for name, attempt in self._running.items()}

    def start(self, task: EpisodeTask) -> None:
        """Start a worker; raises OSError when there can be no process."""
        log = task.folder / EPISODES / f"{task.episode.id}.log"
        reading, writing = os.pipe()
        try:
            with log.open("wb") as output:
                process = subprocess.Popen(
                    [*self._worker, "--fd", str(writing), "--parent", str(os.getpid())],
                    stdin=subprocess.PIPE,
                    stdout=output,
                    stderr=output,
                    pass_fds=(writing,),
                    env={**os.environ, **SINGLE_THREADED},
                    start_new_session=True,  # Ctrl-C is for the parent, which ends its workers itself
                )
        except BaseException:
            os.close(reading)
            raise
        finally:
            os.close(writing)
        os.set_blocking(reading, False)
        lines = os.fdopen(reading, "rb", buffering=0)
        attempt = Attempt(task, process, lines, log, time.monotonic_ns())
        self._running[task.episode.id] = attempt
        self._selector.register(lines, selectors.EVENT_READ, attempt)
        _hand_over(process, json.dumps(task.as_json()).encode())

    def wait(self, timeout_s: float) -> Sequence[Ended]:
        """Attempts whose process has ended."""
        if any(attempt.at_end for attempt in self._running.values()):
            timeout_s = min(timeout_s, EXIT_POLL_S)
        for key, _ in self._selector.select(timeout_s):
            self._read(key.data)
        ended: list[Ended] = []
        for name, attempt in list(self._running.items()):
            if time.monotonic_ns() - attempt.started_ns > LONGEST_NS:
                attempt.process.kill()
            if attempt.process.poll() is not None:
                self._read(attempt)
                ended.append(self._finish(name, attempt))
        return ended

    def times_s(self) -> dict[str, float]:
        """Episode time of what runs."""
        return {name: attempt.time_s for name, attempt in self._running.items()}

    def close(self) -> None:
        """End all workers: SIGTERM, then SIGKILL."""
        for attempt in self._running.values():
            attempt.process.terminate()
        deadline_ns = time.monotonic_ns() + round(GRACE_S * 1e9)
        for attempt in self._running.values():
            try:
                attempt.process.wait(max(0.0, (deadline_ns - time.monotonic_ns()) / 1e9))
            except subprocess.TimeoutExpired:
                attempt.process.kill()
                attempt.process.wait()
            attempt.lines.close()
        self._running.clear()
        self._selector.close()

    def _read(self, attempt: Attempt) -> None:
        while not attempt.at_end and (data := attempt.lines.read(1 << 16)) is not None:  # None: nothing yet
            attempt.buffer += data
            if not data:  # a pipe at its end is always readable: left registered, it would wake `wait` at once for ever
                attempt.at_end = True
                self._selector.unregister(attempt.lines)
        *whole, rest = bytes(attempt.buffer).split(b"\n")
        attempt.buffer[:] = rest
        for line in whole:
            _understand(attempt, line)

    def _finish(self, name: str, attempt: Attempt) -> Ended:
        del self._running[name]
        if not attempt.at_end:  # a process that the worker has left behind holds its end open
            self._selector.unregister(attempt.lines)
        attempt.lines.close()
        if attempt.ended is not None:
            attempt.log.unlink(missing_ok=True)
            return attempt.ended
        code = attempt.process.returncode
        how = f"ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return Ended(name, why=f"its process {how} before a result{_tail(attempt.log)}")


def _hand_over(process: subprocess.Popen[bytes], data: bytes) -> None:
    if process.stdin is None:
        return
    with suppress(BrokenPipeError):  # it has died already, which `wait` finds
        process.stdin.write(data)
        process.stdin.flush()
    with suppress(BrokenPipeError):
        process.stdin.close()


def _understand(attempt: Attempt, line: bytes) -> None:
    """A worker's line; one that makes no sense is as good as none."""
    name = attempt.task.episode.id
    try:
        content = json.loads(line)
        if "result" in content:
            attempt.ended = Ended(name, result=EpisodeResult.of_json(content["result"]))
        elif "refused" in content:
            attempt.ended = Ended(name, why=str(content["refused"]), refused_code=int(content["code"]))
        elif "failed" in content:
            attempt.ended = Ended(name, why=str(content["failed"]))
        else:
            attempt.time_s = float(content["time_s"])
    except (ValueError, KeyError, TypeError, ResultError):
        return


def _tail(log: Path) -> str:
    """The end of what a process has said, for the line that tells of its death."""
    try:
        text = log.read_text(encoding="utf-8", errors="replace")[-TAIL_CHARS:]
    except OSError:
        return ""
    last = [line.strip() for line in text.splitlines() if line.strip() and not line.startswith(_GREETING)]
    return f": {last[-1]}" if last else ""
