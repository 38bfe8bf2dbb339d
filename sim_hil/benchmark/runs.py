"""Run the benchmark from a program instead of the command line; existing results are kept."""

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
    """A run in which an episode has no result; one line."""


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
    """Return the results of all `episodes`, sorted by id; run those that `out` lacks and write `result.json`.

    Raises KeyboardInterrupt when `stopped` ended the run (finished episodes are kept), StoreError when `out` contains a
    run with other conditions or other code, RunsError for episodes whose process died, and the errors of
    `BenchRun.plan`.
    """
    chosen = reworded(episodes, conditions, lambda: load_suite(suite))
    run = BenchRun.plan(suite, chosen, conditions)
    started_ns = time.monotonic_ns()
    backend = LocalJobs(jobs)
    store: ResultStore | None = None
    try:
        store = (ResultStore.resume if (out / CONFIG).is_file() else ResultStore.create)(out, run.config())
        before = len(store.results)
        finished = run.run(store, backend, "none", stopped, watcher or RunWatcher())
    finally:
        backend.close()
        if store is not None:
            store.close()
    if len(store.results) > before or not (out / RESULT).is_file():
        result = bench_result(run, store, finished=finished, started_ns=started_ns)
        write_whole(out / RESULT, json.dumps(result, indent=1) + "\n")
    if not finished:
        raise KeyboardInterrupt
    if store.failed:
        raise RunsError(f"{out}: {len(store.failed)} episodes have no result, the first: {store.failed[0].why}")
    return sorted(store.results, key=lambda each: each.id)


def read_result(out: Path) -> dict[str, Any]:
    """Return the content of `result.json` of a finished run."""
    content: dict[str, Any] = json.loads((out / RESULT).read_text(encoding="utf-8"))
    return content
