"""Runs of the benchmark asked for by a program instead of a command line; what is there already is kept."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from edge.core.cli import write_whole
from sim_hil.benchmark.conditions.conditions import Conditions
from sim_hil.benchmark.conditions.rewording import reworded
from sim_hil.benchmark.results.record import EpisodeResult
from sim_hil.benchmark.results.store import CONFIG, ResultStore
from sim_hil.benchmark.suite.episode import Episode, load_suite
from sim_hil.benchmark.workers.bench_run import BenchRun, bench_result
from sim_hil.benchmark.workers.jobs import RunWatcher
from sim_hil.benchmark.workers.local_jobs import LocalJobs

RESULT = "result.json"


class RunsError(RuntimeError):
    """A run whose episodes have no result; one line."""


def run_episodes(
    suite: str,
    episodes: Sequence[Episode],
    conditions: Conditions,
    out: Path,
    *,
    jobs: int,
    stopped: Callable[[], bool] = lambda: False,
    watcher: RunWatcher | None = None,
) -> list[EpisodeResult]:
    """Results of all `episodes` of a suite, run where `out` does not hold them yet; `result.json` is written too.

    Raises KeyboardInterrupt when `stopped` ended it (what is finished stays), StoreError where `out` holds a run that
    was asked for differently or by other code, RunsError for episodes whose processes died, and what
    `BenchRun.plan` raises.
    """
    chosen = reworded(episodes, conditions, lambda: load_suite(suite))
    run = BenchRun.plan(suite, chosen, conditions)
    started_ns = time.monotonic_ns()
    backend = LocalJobs(jobs)
    store: ResultStore | None = None
    try:
        store = (ResultStore.resume if (out / CONFIG).is_file() else ResultStore.create)(out, run.config())
        before = len(store.results)
        whole = run.run(store, backend, "none", stopped, watcher or RunWatcher())
    finally:
        backend.close()
        if store is not None:
            store.close()
    if len(store.results) > before or not (out / RESULT).is_file():
        result = bench_result(run, store, finished=whole, started_ns=started_ns)
        write_whole(out / RESULT, json.dumps(result, indent=1) + "\n")
    if not whole:
        raise KeyboardInterrupt
    if store.failed:
        raise RunsError(f"{out}: {len(store.failed)} episodes have no result, the first: {store.failed[0].why}")
    return sorted(store.results, key=lambda each: each.id)


def read_result(out: Path) -> dict[str, Any]:
    """`result.json` of a finished run."""
    content: dict[str, Any] = json.loads((out / RESULT).read_text(encoding="utf-8"))
    return content
