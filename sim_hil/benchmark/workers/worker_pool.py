"""Pool of worker processes: a new interpreter per job, one core each, ended with the parent; messages are JSON.

`sim_hil.benchmark.workers.worker_process` is the worker's side.
"""

from __future__ import annotations

import json
import os
import selectors
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Final

from sim_hil.benchmark.workers.worker_process import SINGLE_THREADED, Message

GRACE_S: Final = 2.0
SILENT_S: Final = 3600.0
"""Time without a message after which a worker counts as hanging, s."""
_TAIL_CHARS: Final = 400
_GREETING: Final = "pybullet build time"  # printed by every process that loads the engine
_EXIT_POLL_S: Final = 0.05


@dataclass(frozen=True)
class Told:
    """Event of a worker; `message` is None once it has ended, and `why` explains a failure."""

    key: str
    message: Message | None
    why: str = ""


@dataclass
class _Worker:
    key: str
    process: subprocess.Popen[bytes]
    lines: IO[bytes]
    log: Path
    heard_ns: int
    buffer: bytearray = field(default_factory=bytearray)
    at_end: bool = False


class Workers:
    """Pool of up to `jobs` parallel processes of `command`."""

    def __init__(self, command: Sequence[str], jobs: int) -> None:
        if jobs < 1:
            raise ValueError(f"workers: expected 1 job or more, found {jobs}")
        self._command, self._jobs = command, jobs
        self._running: dict[str, _Worker] = {}
        self._selector = selectors.DefaultSelector()

    def free(self) -> int:
        """Return the number of further processes that may start."""
        return self._jobs - len(self._running)

    def running(self) -> int:
        """Return the number of running processes."""
        return len(self._running)

    def pids(self) -> dict[str, int]:
        """Return the process id of every running job."""
        return {key: worker.process.pid for key, worker in self._running.items()}

    def start(self, key: str, job: Mapping[str, object], log: Path) -> None:
        """Start a process for a job; its output is in `log` until it succeeds. Raises OSError."""
        reading, writing = os.pipe()
        try:
            with log.open("wb") as output:
                process = subprocess.Popen(
                    [*self._command, "--fd", str(writing), "--parent", str(os.getpid())],
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
        worker = _Worker(key, process, os.fdopen(reading, "rb", buffering=0), log, time.monotonic_ns())
        self._running[key] = worker
        self._selector.register(worker.lines, selectors.EVENT_READ, worker)
        stdin = process.stdin
        if stdin is not None:
            with suppress(BrokenPipeError):  # it has already died, which `wait` detects
                stdin.write(json.dumps(job).encode())
            with suppress(BrokenPipeError):
                stdin.close()

    def wait(self, timeout_s: float) -> list[Told]:
        """Wait until a worker reports or the time is over; return the events since the last call."""
        if any(worker.at_end for worker in self._running.values()):
            timeout_s = min(timeout_s, _EXIT_POLL_S)
        told: list[Told] = []
        for key, _ in self._selector.select(timeout_s):
            told += self._read(key.data)
        for worker in list(self._running.values()):
            if time.monotonic_ns() - worker.heard_ns > SILENT_S * 1e9:
                worker.process.kill()
            if worker.process.poll() is not None:
                told += self._read(worker)
                told.append(self._finish(worker))
        return told

    def close(self) -> None:
        """End all processes: SIGTERM, then SIGKILL."""
        for worker in self._running.values():
            worker.process.terminate()
        deadline_ns = time.monotonic_ns() + round(GRACE_S * 1e9)
        for worker in self._running.values():
            try:
                worker.process.wait(max(0.0, (deadline_ns - time.monotonic_ns()) / 1e9))
            except subprocess.TimeoutExpired:
                worker.process.kill()
                worker.process.wait()
            worker.lines.close()
        self._running.clear()
        self._selector.close()

    def _read(self, worker: _Worker) -> list[Told]:
        while not worker.at_end and (data := worker.lines.read(1 << 16)) is not None:  # None: nothing yet
            worker.buffer += data
            worker.heard_ns = time.monotonic_ns()
            if not data:  # a pipe at its end is always readable: left registered, it would wake `wait` at once for ever
                worker.at_end = True
                self._selector.unregister(worker.lines)
        *whole, rest = bytes(worker.buffer).split(b"\n")
        worker.buffer[:] = rest
        return [Told(worker.key, message) for line in whole if (message := _message(line)) is not None]

    def _finish(self, worker: _Worker) -> Told:
        del self._running[worker.key]
        if not worker.at_end:  # a process that the worker has left behind holds its end open
            self._selector.unregister(worker.lines)
        worker.lines.close()
        code = worker.process.returncode
        if code == 0:
            worker.log.unlink(missing_ok=True)
            return Told(worker.key, None)
        how = f"ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return Told(worker.key, None, f"{how}{_tail(worker.log)}")


def _message(line: bytes) -> Message | None:
    """Parse a line; None if it is invalid, such as one torn by a dying process."""
    try:
        content = json.loads(line)
    except ValueError:
        return None
    return content if isinstance(content, dict) else None


def _tail(log: Path) -> str:
    try:
        text = log.read_text(encoding="utf-8", errors="replace")[-_TAIL_CHARS:]
    except OSError:
        return ""
    last = [line.strip() for line in text.splitlines() if line.strip() and not line.startswith(_GREETING)]
    return f": {last[-1]}" if last else ""
