"""The harness's side of the protocol: a worker process, and the memory that it holds."""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sim_hil.processes.child_process import ChildProcess, parse_message

ROOT = Path(__file__).parents[3]
"""The folder that holds the packages `tools` and `export`, which workers import by name."""

END_S = 10.0
"""Time that a worker has to end after it was asked to, s."""
ANSWER_S = 3600.0
"""Time that a worker has for one answer, s: loading and a round of calls of the slowest model."""
SAMPLE_S = 0.02


class WorkerError(RuntimeError):
    """A worker that refused, failed or died; the text is one line."""


def worker_command(python: Path, stack: str) -> list[str]:
    """Command of a stack's worker under an interpreter."""
    return [str(python), "-m", f"tools.bench.peers.workers.{stack}_worker"]


@dataclass
class Worker:
    """One contender's process, pinned to `cores`; idle unless it is asked something."""

    name: str
    command: Sequence[str]
    cores: frozenset[int]
    log: Path
    _process: ChildProcess = field(init=False)

    def __enter__(self) -> Worker:
        threads = str(len(self.cores))
        env = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": threads, "MKL_NUM_THREADS": threads}
        before = os.sched_getaffinity(0)
        # A child inherits the affinity; its libraries count the cores when they are loaded.
        os.sched_setaffinity(0, self.cores)
        try:
            self._process = ChildProcess(self.command, log=self.log, env=env, new_session=True)
        except OSError as error:
            raise WorkerError(f"{self.name}: cannot start {self.command[0]} ({error.strerror})") from error
        finally:
            os.sched_setaffinity(0, before)
        return self

    def __exit__(self, *_: object) -> None:
        self._process.send(json.dumps({"end": True}).encode())
        self._process.close(END_S)

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def ask(self, message: Mapping[str, object]) -> dict[str, Any]:
        """Send a message and wait for its answer; raises WorkerError."""
        if not self._process.send(json.dumps(message).encode()):
            raise WorkerError(f"{self.name}: the worker is gone; its log: {self.log}")
        try:
            line = self._process.read_one(ANSWER_S)
        except TimeoutError as error:
            raise WorkerError(f"{self.name}: {error}; its log: {self.log}") from error
        if line is None:
            code = self._process.wait(END_S)
            raise WorkerError(f"{self.name}: the worker ended with code {code}; its log: {self.log}")
        answer = parse_message(line)
        if answer is None:
            raise WorkerError(f"{self.name}: expected a JSON object as answer, found {line[:80]!r}")
        if not answer.pop("ok", False):
            raise WorkerError(f"{self.name}: {answer.get('error', 'refused without a reason')}; its log: {self.log}")
        return answer


@dataclass(frozen=True)
class Peak:
    """Largest memory of a process, MB (10⁶ bytes)."""

    rss_mb: float
    """All resident pages, mapped weight files included (the kernel's own high-water mark)."""
    pss_mb: float
    """The same with shared pages divided by their users (sampled)."""
    anon_mb: float
    """Only what is not a copy of a file and could not be dropped (sampled)."""


def _kib(text: str, key: str) -> int:
    line = next((row for row in text.splitlines() if row.startswith(key + ":")), None)
    if line is None:
        raise WorkerError(f"/proc has no {key} on this kernel")
    return int(line.split()[1])


class MemoryWatch:
    """Samples a process's memory in a thread of this process until the block is left."""

    def __init__(self, pid: int) -> None:
        self._folder = Path("/proc") / str(pid)
        self._pss_kib = self._anon_kib = 0
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> MemoryWatch:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._done.is_set():
            try:
                self._sample()
            except (OSError, WorkerError):
                return  # the process is gone; `peak` says so
            time.sleep(SAMPLE_S)

    def _sample(self) -> None:
        self._anon_kib = max(self._anon_kib, _kib((self._folder / "status").read_text(), "RssAnon"))
        self._pss_kib = max(self._pss_kib, _kib((self._folder / "smaps_rollup").read_text(), "Pss"))

    def peak(self) -> Peak:
        """The peaks until now; raises WorkerError when the process is gone."""
        try:
            self._sample()
            rss_kib = _kib((self._folder / "status").read_text(), "VmHWM")
        except OSError as error:
            raise WorkerError(f"{self._folder}: the worker is gone") from error
        return Peak(*(round(kib * 1024 / 1e6, 1) for kib in (rss_kib, self._pss_kib, self._anon_kib)))
