"""Episodes on a Ray cluster: one Ray task per episode, which runs the same worker process as a local run.

If a worker or node dies, the driver submits its task again; each episode's result counts once. Ray is an optional
extra, imported only here. Nodes need this package, and the artifacts at the same path.
"""

from __future__ import annotations

import json
import logging
import os
import socket
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from edge.core.cli import EXIT_BAD_INPUT
from sim_hil.benchmark.results.record import EpisodeResult
from sim_hil.benchmark.results.store import CAUSES, EPISODES, FLIGHTS, VIDEOS
from sim_hil.benchmark.workers.code_version import code_sha256
from sim_hil.benchmark.workers.jobs import WORKER, Ended, LocalJobs
from sim_hil.benchmark.workers.task import EpisodeTask

ATTEMPTS = 4
"""Attempts per episode; more than locally, because a dying node ends its episodes regardless of their content."""
CPUS_PER_EPISODE = 1
REACH_S = 5.0
"""Longest time for a connection to the cluster's head, s."""
NO_PROCESSOR_S = 60.0
"""Longest time without any processor in the cluster, s; a restarting node is back by then."""


class ClusterError(RuntimeError):
    """No cluster, or no processor in it; one line."""


def _check_reachable(address: str) -> None:
    """Raise ClusterError where nothing listens: Ray would try for a minute and print its own log."""
    host, _, port = address.rpartition(":")
    if not port.isdecimal():
        return  # `auto` and the like, which only tests use
    try:
        socket.create_connection((host.strip("[]"), int(port)), REACH_S).close()
    except (OSError, UnicodeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise ClusterError(
            f"--cluster {address}: no Ray cluster there ({reason}); start one with `ray start --head`, and run this on "
            "one of its nodes"
        ) from error


class ClusterJobs:
    """Backend that runs as many episodes in parallel as the cluster has processors.

    Raises ClusterError if the cluster cannot be reached, or (in `free` and `wait`) has no processor for NO_PROCESSOR_S.
    """

    attempts = ATTEMPTS

    def __init__(
        self,
        address: str,
        worker: Sequence[str] | None = None,
        *,
        now_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Connect; `worker`: command of a worker process on a node, default: the node's own interpreter."""
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        try:
            import ray
        except ImportError as error:
            raise ClusterError(
                "--cluster: needs the packages of the extra 'cluster': pip install 'tic-vla-edge[cluster]'"
            ) from error
        self._ray: Any = ray
        _check_reachable(address)
        try:
            ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False, configure_logging=False)
        except (ConnectionError, ValueError, RuntimeError, TimeoutError) as error:
            line = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
            raise ClusterError(
                f"--cluster {address}: no Ray cluster there ({line[:200]}); start one with `ray start --head`, and run "
                "this on one of its nodes"
            ) from error
        # The driver retries, so that every death is reported and counted in one place.
        self._remote = ray.remote(num_cpus=CPUS_PER_EPISODE, max_retries=0)(run_on_node)
        self._worker = None if worker is None else list(worker)
        self._code_sha256 = code_sha256()
        self._running: dict[Any, str] = {}
        self._open = True
        self._address, self._now_ns, self._sleep = address, now_ns, sleep
        self._had_processor_ns = now_ns()

    def free(self) -> int:
        """Return the number of processors without an episode of this run."""
        return self._slots() - len(self._running)

    def _slots(self) -> int:
        slots = int(self._ray.cluster_resources().get("CPU", 0)) // CPUS_PER_EPISODE
        now_ns = self._now_ns()
        if slots > 0:
            self._had_processor_ns = now_ns
        elif now_ns - self._had_processor_ns > NO_PROCESSOR_S * 1e9:
            raise ClusterError(
                f"--cluster {self._address}: expected a processor for an episode, found none for {NO_PROCESSOR_S:g} s; "
                "add a node with `ray start --address`, then repeat the command (with --resume if it had --out)"
            )
        return slots

    def start(self, task: EpisodeTask) -> None:
        """Submit a task."""
        reference = self._remote.remote(json.dumps(task.as_json()), self._code_sha256, self._worker)
        self._running[reference] = task.episode.id

    def wait(self, timeout_s: float) -> Sequence[Ended]:
        """Return the tasks that have ended, with or without a result."""
        self._slots()
        if not self._running:
            self._sleep(timeout_s)
            return ()
        ready, _ = self._ray.wait(list(self._running), num_returns=1, timeout=timeout_s)
        return [self._ended(reference) for reference in ready]

    def _ended(self, reference: object) -> Ended:
        name = self._running.pop(reference)
        try:
            outcome, files = self._ray.get(reference)
        except self._ray.exceptions.RayError as error:
            return Ended(name, why=f"its cluster worker ended: {type(error).__name__}")
        content = json.loads(outcome)
        if content["result"] is None:
            return Ended(name, why=content["why"], refused_code=content["refused_code"])
        result = replace(EpisodeResult.of_json(content["result"]), host=content["host"])
        return Ended(name, result, tuple(files))

    def times_s(self) -> dict[str, float]:
        """Return nothing, because nodes do not report times."""
        return {}

    def close(self) -> None:
        """Cancel the running tasks and disconnect from the cluster."""
        if not self._open:
            return
        self._open = False
        for reference in self._running:
            with suppress(self._ray.exceptions.RayError, ValueError):
                self._ray.cancel(reference, force=True)
        self._running.clear()
        self._ray.shutdown()


def run_on_node(task_json: str, code: str, worker: Sequence[str] | None) -> tuple[str, list[tuple[str, bytes]]]:
    """Run a task in a process of this node; return its outcome as JSON, and its files by path below the run's folder.

    `code`: the driver's `code_sha256`; the task is refused if this node has other code.
    """
    host = os.uname().nodename
    if code_sha256() != code:
        why = f"{host} has other code than the machine that started the run: install the same version on every node"
        return json.dumps({"result": None, "why": why, "refused_code": EXIT_BAD_INPUT, "host": host}), []
    with tempfile.TemporaryDirectory(prefix="edge-bench-") as folder:
        for name in (EPISODES, VIDEOS, FLIGHTS, CAUSES):
            (Path(folder) / name).mkdir()
        task = replace(EpisodeTask.of_json(json.loads(task_json)), folder=Path(folder))
        ended = _one(task, worker)
        found = [path for path in sorted(Path(folder).rglob("*")) if path.suffix in (".json", ".mp4", ".mcap")]
        files = [(path.relative_to(folder).as_posix(), path.read_bytes()) for path in found]
    outcome = {
        "result": None if ended.result is None else ended.result.as_json(),
        "why": ended.why,
        "refused_code": ended.refused_code,
        "host": host,
    }
    return json.dumps(outcome), files


def _one(task: EpisodeTask, worker: Sequence[str] | None) -> Ended:
    jobs = LocalJobs(1, worker or WORKER)
    try:
        jobs.start(task)
        while True:
            for ended in jobs.wait(1.0):
                return ended
    finally:
        jobs.close()
