"""A benchmark run: its plan, execution and result; from a program, existing results are kept."""

from __future__ import annotations

import hashlib
import json
import platform
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any
from zlib import crc32

from edge.core.cli import write_whole
from edge.core.stats import percentiles
from edge.live.options import LiveOptions
from firmware_bridge.system.input_file import read_json
from sim_hil.benchmark.conditions.conditions import Conditions, ConditionsError
from sim_hil.benchmark.conditions.rewording import reworded
from sim_hil.benchmark.policies.select import check_artifacts, open_policy
from sim_hil.benchmark.results.causes import cause_counts, read_causes
from sim_hil.benchmark.results.record import EpisodeResult, read_log
from sim_hil.benchmark.results.store import CONFIG, EPISODES, ResultStore
from sim_hil.benchmark.results.summary import summarise
from sim_hil.benchmark.suite.episode import Episode, load_suite
from sim_hil.benchmark.suite.strata import is_fresh
from sim_hil.benchmark.workers.code_version import code_sha256
from sim_hil.benchmark.workers.jobs import Backend, LocalJobs, RunWatcher, run_all
from sim_hil.benchmark.workers.run_episode import RUNNERS
from sim_hil.benchmark.workers.task import EpisodeTask

RESULT = "result.json"
SCHEMA = 1
_PACKAGES = (
    "tic-vla-edge",
    "numpy",
    "pybullet",
    "panda3d",
    "scipy",
    "onnxruntime",
    "opencv-python-headless",
)


@dataclass(frozen=True)
class BenchRun:
    """Plan of a run; `trained`: from the manifest, True for a policy without one; `first`: see `tasks`.

    `first` is no part of the configuration: a resumed run can have more or fewer.
    """

    suite: str
    episodes: tuple[Episode, ...]
    conditions: Conditions
    manifest_sha256: str
    trained: bool
    first: int | None = None

    @staticmethod
    def plan(suite: str, episodes: Sequence[Episode], conditions: Conditions, first: int | None = None) -> BenchRun:
        """Check everything that is known before the first episode; open an external policy or a network's file once.

        Raises ArtifactError, ConditionsError, ExternalError.
        """
        if conditions.clock not in RUNNERS:
            raise ConditionsError(
                f"--clock {conditions.clock}: not in this version; expected {', '.join(sorted(RUNNERS))}"
            )
        artifacts = check_artifacts(conditions)
        if artifacts is not None:
            conditions = conditions.with_defaults_of(artifacts.runtime.switches)
        sha256, trained = ("", True) if artifacts is None else (artifacts.manifest_sha256, artifacts.trained)
        run = BenchRun(suite, tuple(episodes), conditions, sha256, trained, first)
        run.tasks(Path())
        if conditions.policy.kind in ("external", "point-goal-net"):
            open_policy(conditions).close()
        return run

    @property
    def asked(self) -> int:
        """Number of episodes to run."""
        return len(self.episodes[: self.first])

    def config(self) -> dict[str, Any]:
        """Return the configuration that a resumed run must share."""
        return {
            "schema": SCHEMA,
            "suite": self.suite,
            "suite_sha256": hashlib.sha256(
                json.dumps([asdict(episode) for episode in self.episodes], sort_keys=True).encode()
            ).hexdigest(),
            "episodes": [episode.id for episode in self.episodes],
            "conditions": self.conditions.as_json(),
            "manifest_sha256": self.manifest_sha256,
            "trained": self.trained,
            "versions": versions(),
        }

    def tasks(
        self, folder: Path, video: str = "none", flights: str = "none", live: LiveOptions | None = None
    ) -> list[EpisodeTask]:
        """Return one task per episode in the order of their start. Raises ConditionsError.

        The longest come first, for an even load. Those of the fresh suite, and of a run of the `first` few, come in an
        order without regard to their kind, so that the rates of an unfinished run are of a fair sample.
        """
        tasks = [
            EpisodeTask(episode, self.conditions, folder, video, flights, self.manifest_sha256, live=live)
            for episode in self.episodes
        ]
        if is_fresh(self.suite) or self.first is not None:
            return sorted(tasks, key=lambda task: crc32(task.episode.id.encode()))[: self.first]
        # Simulation time grows with the time limit and the crowd.
        return sorted(tasks, key=lambda task: -task.episode.timeout_s * (20 + task.episode.people))


def versions() -> dict[str, str]:
    """Return the versions of code and packages, on which results may depend."""
    found = {"python": platform.python_version(), "machine": platform.machine(), "system": sys.platform}
    found["code"] = code_sha256()
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed as a package"
    return found


def bench_result(
    run: BenchRun, store: ResultStore, *, finished: bool, started_ns: int, before: Collection[str] = ()
) -> dict[str, Any]:
    """Return the result for `--json`; `before`: ids of episodes that an earlier session of the run has finished.

    `wall_s` and `simulated_s` are of this session alone.
    """
    results = sorted(store.results, key=lambda result: result.id)
    wall_s = (time.monotonic_ns() - started_ns) / 1e9
    causes, failed = read_causes(store.directory, results), any(not each.success or each.collided for each in results)
    return {
        "summary": {
            **summarise(results),
            "asked": run.asked,
            "failed_runs": len(store.failed),
            "finished": finished,
        },
        "causes": None if failed and not causes else cause_counts(results, causes),
        "episodes": [result.as_json() for result in results],
        "failed_runs": [asdict(failed) for failed in store.failed],
        "latency": latency_result(store.directory, run.conditions, results),
        "conditions": run.conditions.as_json(),
        "suite": run.suite,
        "suite_sha256": run.config()["suite_sha256"],
        "manifest_sha256": run.manifest_sha256,
        "trained": run.trained,
        "versions": store.config["versions"],
        "code_changed": store.config["versions"]["code"] != code_sha256(),
        "wall_s": round(wall_s, 1),
        "simulated_s": round(sum(result.time_s for result in results if result.id not in before), 1),
        "tagged": "measured",
    }


def latency_result(directory: Path, conditions: Conditions, results: Sequence[EpisodeResult]) -> dict[str, Any]:
    """Return the delays over all control periods of all episodes, and their latency profile."""
    delays: list[float] = []
    for result in results:
        if result.delay_s is not None:
            try:
                columns: Mapping[str, Any] = read_log(directory / EPISODES / f"{result.id}.json")["columns"]
            except (OSError, ValueError):
                continue  # the log was removed; use the others
            delays += [delay for delay in columns["delay_s"] if delay is not None]
    profile = conditions.latency
    return {
        "delay_s": {
            "mean": round(sum(delays) / len(delays), 4) if delays else None,
            **percentiles(delays, "p50", "p99", "max"),
        },
        "periods": len(delays),
        "profile": None if profile is None else profile.name,
        "profile_mean_s": None if profile is None else round(profile.mean_s, 4),
        "profile_source": None if profile is None else profile.source,
        "profile_tagged": None if profile is None else profile.tagged,
    }


@dataclass(frozen=True)
class Execution:
    """An executed run: its closed store, its result for `--json`, and the number of episodes that it has added."""

    store: ResultStore
    finished: bool
    result: dict[str, Any]
    added: int


def execute(
    run: BenchRun,
    directory: Path,
    backend: Backend,
    *,
    resume: bool,
    video: str = "none",
    flights: str = "none",
    live: LiveOptions | None = None,
    stopped: Callable[[], bool],
    watcher: RunWatcher | None = None,
) -> Execution:
    """Run the episodes that `directory` lacks, then close the backend. Raises StoreError, RefusedRunError, OSError."""
    started_ns = time.monotonic_ns()
    store: ResultStore | None = None
    try:
        store = (ResultStore.resume if resume else ResultStore.create)(directory, run.config())
        before = {result.id for result in store.results}
        tasks = run.tasks(store.directory, video, flights, live)
        finished = run_all(tasks, backend, store, stopped=stopped, watcher=watcher)
    finally:
        backend.close()
        if store is not None:
            store.close()
    result = bench_result(run, store, finished=finished, started_ns=started_ns, before=before)
    return Execution(store, finished, result, len(store.results) - len(before))


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
    resume = (out / CONFIG).is_file()
    execution = execute(run, out, LocalJobs(jobs), resume=resume, stopped=stopped, watcher=watcher)
    store, finished = execution.store, execution.finished
    if execution.added or not _is_current(out / RESULT, len(store.results)):
        write_whole(out / RESULT, json.dumps(execution.result, indent=1) + "\n")
    if not finished:
        raise KeyboardInterrupt
    if store.failed:
        raise RunsError(f"{out}: {len(store.failed)} episodes have no result, the first: {store.failed[0].why}")
    return sorted(store.results, key=lambda each: each.id)


def _is_current(path: Path, episodes: int) -> bool:
    """Return whether a result is that of a finished run with so many episodes: a kill can come before it is written."""
    try:
        content = read_json(path)
        return content["summary"]["finished"] is True and len(content["episodes"]) == episodes
    except (OSError, ValueError, KeyError, TypeError):
        return False


def read_result(out: Path) -> dict[str, Any]:
    """Return the content of `result.json` of a finished run."""
    content: dict[str, Any] = read_json(out / RESULT)
    return content
