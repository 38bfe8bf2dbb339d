"""Worker's side of the protocol: JSON lines on standard input and output, one process per contender.

    {"load": {...}}                → {"ok": true, "tasks": [...], "versions": {...}}
    {"run": TASK, "calls": N}      → {"ok": true, "values": {METRIC: [...]}, "wall_s": …, "cpu_s": …}
    {"end": true}                  → the worker exits

The libraries' standard output is redirected to standard error, so that standard output has answers only.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Task = Callable[[], Mapping[str, float]]
"""One timed call: metric → value (`…_ms`, `…_tokens_per_s`)."""


@dataclass(frozen=True)
class Load:
    """Request to open parts of the model."""

    model: str
    cache: Path
    threads: int
    parts: tuple[str, ...]
    options: Mapping[str, str]

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Load:
        """Build the request from a message. Raises ValueError for missing or unknown fields."""
        if set(content) != {"model", "cache", "threads", "parts", "options"}:
            raise ValueError(f"load: unexpected fields {sorted(content)}")
        return cls(**{**content, "cache": Path(content["cache"]), "parts": tuple(content["parts"])})

    def of(self, part: str) -> dict[str, str]:
        """Return the options of one part, without their prefix."""
        return {key.partition(".")[2]: v for key, v in self.options.items() if key.startswith(part + ".")}

    def folder(self, runtime: str, part: str) -> Path:
        """Return the folder in which `models.prepare` has put a runtime's model of a part, in the options' form."""
        return self.cache / self.model / runtime / f"{part}-{self.options[part + '.form']}"


def timed_ms(call: Callable[[], object]) -> float:
    """Measure a call, ms."""
    started_ns = time.monotonic_ns()
    call()
    return (time.monotonic_ns() - started_ns) / 1e6


def timed_task(metric: str, call: Callable[[], object]) -> Task:
    """Create the task of one call, such as a frame through the encoder (`encoder_ms`)."""
    return lambda: {metric: timed_ms(call)}


def language_task(prefill: Callable[[], int], step: Callable[[int], int], steps: int) -> Task:
    """Create the task of a prefill and `steps` decode steps, each of which reads a token and returns the next."""

    def run() -> dict[str, float]:
        started_ns = time.monotonic_ns()
        token = prefill()
        prefilled_ns = time.monotonic_ns()
        for _ in range(steps):
            token = step(token)
        return generation((prefilled_ns - started_ns) / 1e6, (time.monotonic_ns() - prefilled_ns) / 1e6, steps)

    return run


def generation(prefill_ms: float, decode_ms: float, tokens: int) -> dict[str, float]:
    """Return the values of a generation of so many tokens."""
    rate = 1e3 * tokens / decode_ms
    return {"prefill_ms": prefill_ms, "decode_tokens_per_s": rate, "generation_ms": prefill_ms + decode_ms}


def serve(load: Callable[[Load], Mapping[str, Task]], packages: Sequence[str]) -> int:
    """Answer requests until the end; a failure is answered in one line and ends the worker with code 1."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    tasks: Mapping[str, Task] = {}
    for line in sys.stdin:
        request = json.loads(line)
        if "end" in request:
            return 0
        try:
            if "load" in request:
                tasks = load(Load.from_dict(request["load"]))
                versions = {name: importlib.metadata.version(name) for name in packages}
                answer: dict[str, Any] = {"ok": True, "tasks": sorted(tasks), "versions": versions}
            else:
                answer = {"ok": True, **_run(tasks[request["run"]], int(request["calls"]))}
        except Exception as error:  # noqa: BLE001 - a runtime may raise anything; the parent reports it and goes on
            first = (str(error).strip().splitlines() or [""])[0]
            answer = {"ok": False, "error": f"{type(error).__name__}: {first}"}
        answers.write(json.dumps(answer) + "\n")
        answers.flush()
        if not answer["ok"]:
            return 1
    return 0


def _run(task: Task, calls: int) -> dict[str, Any]:
    values: dict[str, list[float]] = {}
    started_ns, cpu_before = time.monotonic_ns(), time.process_time()
    for _ in range(calls):
        for metric, value in task().items():
            values.setdefault(metric, []).append(value)
    wall_s, cpu_s = (time.monotonic_ns() - started_ns) / 1e9, time.process_time() - cpu_before
    return {"values": values, "wall_s": wall_s, "cpu_s": cpu_s}
