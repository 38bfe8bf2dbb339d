"""Timed rounds: in each round every contender is asked for every task once, the others idle; foreign load is seen."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tools.bench.peers.process import Worker, WorkerError

CALLS = {"action": 20}
"""Calls of a sample where one takes milliseconds; the sample is their median."""
FOREIGN_CORES = 0.1
"""Processor time of others, in cores, from which a sample counts as disturbed."""
GRAIN_S = 0.02
"""The kernel counts busy time in steps of 0.01 s: a short sample must not be blamed for the steps at its ends."""
SETTLE_S = 0.3
"""Runtimes keep their threads spinning for up to 0.2 s after a call: the next contender waits that out."""


@dataclass(frozen=True)
class Sample:
    """One contender, one task, once."""

    contender: str
    task: str
    values: Mapping[str, float]
    wall_s: float
    cpu_s: float
    foreign_cores: float
    calls: Mapping[str, Sequence[float]]


@dataclass(frozen=True)
class Round:
    """All samples of a round in the order they were taken."""

    group: str
    index: int
    load_average: tuple[float, float, float]
    idle_foreign_cores: float
    """Busy cores while every contender was idle, just before the round."""
    samples: tuple[Sample, ...]

    @property
    def quiet(self) -> bool:
        """Whether nothing else took part of the machine."""
        return max([self.idle_foreign_cores, *(s.foreign_cores for s in self.samples)]) <= FOREIGN_CORES

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON form."""
        return {**asdict(self), "quiet": self.quiet}


def busy_s(stat: str) -> float:
    """Seconds that all cores together were busy or stolen by the host, from the text of /proc/stat."""
    fields = next(line.split()[1:] for line in stat.splitlines() if line.startswith("cpu "))
    user, nice, system, _idle, _iowait, irq, softirq, steal = (int(v) for v in fields[:8])
    return (user + nice + system + irq + softirq + steal) / os.sysconf("SC_CLK_TCK")


def _machine_busy_s() -> float:
    return busy_s(Path("/proc/stat").read_text(encoding="ascii"))


def idle_foreign_cores(window_s: float) -> float:
    """Cores busy during a window in which no contender works."""
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
    """The upper median: a value that occurred."""
    return sorted(values)[len(values) // 2]


def take(worker: Worker, task: str) -> Sample:
    """Ask a contender for one sample; raises WorkerError."""
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
    """Rounds until `repeats` were quiet, at most half as many again; a contender that fails leaves the field."""
    alive = dict(workers)
    for worker, tasks in list(alive.values()):
        try:
            for task in tasks:
                take(worker, task)  # warm-up: first calls allocate, page in and compile
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
        # Every contender gets every place in the order: whoever comes after a hot neighbour is not always the same.
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
