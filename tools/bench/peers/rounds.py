"""Harness of the workers: processes, their memory, and rounds in which each worker runs every task once.

Other workers idle meanwhile; load from other programs is measured.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from sim_hil.processes.child_process import ChildProcess, parse_message

ROOT = Path(__file__).parents[3]
"""Folder with the packages `tools` and `export`, which workers import."""

END_S = 10.0
"""Timeout of a worker's end after the request, s."""
ANSWER_S = 3600.0
"""Timeout of a worker's answer, s: covers loading and a round of calls of the slowest model."""
SAMPLE_S = 0.02


class WorkerError(RuntimeError):
    """Worker that refused, failed or died; its text is one line."""


def worker_command(python: Path, stack: str) -> list[str]:
    """Return the command of a stack's worker; one worker module serves a runtime and its GenAI pipeline."""
    module = {"genai": "onnxruntime", "openvino_genai": "openvino"}.get(stack, stack)
    return [str(python), "-m", f"tools.bench.peers.workers.{module}_worker", stack]


@dataclass
class Worker:
    """Process of a contender, pinned to `cores`; idle without a request."""

    name: str
    command: Sequence[str]
    cores: frozenset[int]
    log: Path
    _process: ChildProcess = field(init=False)

    def __enter__(self) -> Worker:
        threads = str(len(self.cores))
        env = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": threads, "MKL_NUM_THREADS": threads}
        before = os.sched_getaffinity(0)
        # A child inherits the affinity, and its libraries count the cores when they are loaded.
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
            raise WorkerError(f"{self.name}: the worker has ended; its log: {self.log}")
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
    """Peak memory of a process, MB (10⁶ bytes)."""

    rss_mb: float
    """Resident pages, including mapped weight files (the kernel's high-water mark)."""
    pss_mb: float
    """Resident pages, with shared pages divided by their users (sampled)."""
    anon_mb: float
    """Anonymous pages, which are no copy of a file (sampled)."""


def _kib(text: str, key: str) -> int:
    line = next((row for row in text.splitlines() if row.startswith(key + ":")), None)
    if line is None:
        raise WorkerError(f"/proc has no {key} on this kernel")
    return int(line.split()[1])


class MemoryWatch:
    """Context manager that samples a process's memory in a thread."""

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
                return  # the process has ended; `peak` raises
            time.sleep(SAMPLE_S)

    def _sample(self) -> None:
        self._anon_kib = max(self._anon_kib, _kib((self._folder / "status").read_text(), "RssAnon"))
        self._pss_kib = max(self._pss_kib, _kib((self._folder / "smaps_rollup").read_text(), "Pss"))

    def peak(self) -> Peak:
        """Return the peaks so far. Raises WorkerError if the process has ended."""
        try:
            self._sample()
            rss_kib = _kib((self._folder / "status").read_text(), "VmHWM")
        except OSError as error:
            raise WorkerError(f"{self._folder}: the worker is gone") from error
        return Peak(*(round(kib * 1024 / 1e6, 1) for kib in (rss_kib, self._pss_kib, self._anon_kib)))


CALLS = {"action": 20}
"""Calls per sample of a task that takes milliseconds; the sample is their median."""
FOREIGN_CORES = 0.1
"""Load of other programs above which a sample counts as disturbed, cores."""
GRAIN_S = 0.02
"""Tolerance, s: the kernel counts busy time in steps of 0.01 s, which matters for short samples."""
SETTLE_S = 0.3
"""Pause before the next contender, s: runtimes keep their threads spinning for up to 0.2 s after a call."""


@dataclass(frozen=True)
class Sample:
    """One measurement of one task of a contender."""

    contender: str
    task: str
    values: Mapping[str, float]
    wall_s: float
    cpu_s: float
    foreign_cores: float
    calls: Mapping[str, Sequence[float]]


@dataclass(frozen=True)
class Round:
    """Samples of a round in the order of measurement."""

    group: str
    index: int
    load_average: tuple[float, float, float]
    idle_foreign_cores: float
    """Busy cores while every contender was idle, just before the round."""
    samples: tuple[Sample, ...]

    @property
    def quiet(self) -> bool:
        """Whether no other program disturbed the round."""
        return max([self.idle_foreign_cores, *(s.foreign_cores for s in self.samples)]) <= FOREIGN_CORES

    def to_dict(self) -> dict[str, Any]:
        """Return the plain JSON form."""
        return {**asdict(self), "quiet": self.quiet}


def busy_s(stat: str) -> float:
    """Return the time all cores together were busy or stolen by the host, s, from the text of /proc/stat."""
    fields = next(line.split()[1:] for line in stat.splitlines() if line.startswith("cpu "))
    user, nice, system, _idle, _iowait, irq, softirq, steal = (int(v) for v in fields[:8])
    return (user + nice + system + irq + softirq + steal) / os.sysconf("SC_CLK_TCK")


def _machine_busy_s() -> float:
    return busy_s(Path("/proc/stat").read_text(encoding="ascii"))


def idle_foreign_cores(window_s: float) -> float:
    """Measure the busy cores during a window without contenders."""
    before, started_ns = _machine_busy_s(), time.monotonic_ns()
    time.sleep(window_s)
    return (_machine_busy_s() - before) / ((time.monotonic_ns() - started_ns) / 1e9)


def wait_for_quiet(limit_s: float) -> float:
    """Wait until the machine is quiet, at most `limit_s`; returns the foreign cores last seen."""
    deadline_ns = time.monotonic_ns() + int(limit_s * 1e9)
    while True:
        foreign = idle_foreign_cores(1.0)
        if foreign <= FOREIGN_CORES or time.monotonic_ns() > deadline_ns:
            return foreign


def middle(values: Sequence[float]) -> float:
    """Return the upper median, which is one of the values."""
    return sorted(values)[len(values) // 2]


def take(worker: Worker, task: str) -> Sample:
    """Take one sample of a contender. Raises WorkerError."""
    time.sleep(SETTLE_S)
    before, started_ns = _machine_busy_s(), time.monotonic_ns()
    answer = worker.ask({"run": task, "calls": CALLS.get(task, 1)})
    busy, elapsed_s = _machine_busy_s() - before, (time.monotonic_ns() - started_ns) / 1e9
    foreign = max(0.0, (busy - answer["cpu_s"] - GRAIN_S) / elapsed_s)
    values = {metric: middle(calls) for metric, calls in answer["values"].items()}
    return Sample(worker.name, task, values, answer["wall_s"], answer["cpu_s"], round(foreign, 3), answer["values"])


def run_rounds(
    group: str,
    workers: Mapping[str, tuple[Worker, Sequence[str]]],
    repeats: int,
    quiet_wait_s: float,
    failed: Callable[[str, str], None],
) -> Iterator[Round]:
    """Run rounds until `repeats` were quiet, at most 1.5 times as many; a contender that fails is removed."""
    alive = dict(workers)
    for worker, tasks in list(alive.values()):
        try:
            for task in tasks:
                take(worker, task)  # warm-up: first calls allocate memory, load pages and compile
        except WorkerError as error:
            failed(worker.name, str(error))
            del alive[worker.name]
    quiet = 0
    for index in range(repeats + (repeats + 1) // 2):
        if quiet == repeats or not alive:
            return
        foreign = wait_for_quiet(quiet_wait_s)
        load = os.getloadavg()
        names = list(alive)
        # Rotate the order, so that no contender always follows the same one on a hot processor.
        order = names[index % len(names) :] + names[: index % len(names)]
        samples: list[Sample] = []
        for name in order:
            worker, tasks = alive[name]
            try:
                samples += [take(worker, task) for task in tasks]
            except WorkerError as error:
                failed(name, str(error))
                del alive[name]
        done = Round(group, index, load, round(foreign, 3), tuple(samples))
        quiet += done.quiet
        yield done
