"""Episodes on a local Ray cluster of two nodes: a killed worker's episode is run again, and counts once."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import signal
import socket
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from sim_hil.benchmark.results.store import ResultStore, read_results
from sim_hil.benchmark.workers import cluster
from sim_hil.benchmark.workers.cluster import ClusterError, ClusterJobs, run_on_node
from sim_hil.benchmark.workers.code_version import code_sha256
from sim_hil.benchmark.workers.jobs import POLL_S, Ended, RunWatcher, run_all
from sim_hil.benchmark.workers.task import EpisodeTask
from tests.support.benchmark import dynanav_fakes as fakes
from tests.support.processes import REPOSITORY

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("ray") is None, reason="needs the packages of the extra 'cluster' (ray)"
)

OBJECT_STORE_BYTES = 80 * 2**20


@pytest.fixture(scope="module")
def cluster_address() -> Iterator[str]:
    """Two nodes with a processor each, in a folder of their own; only their own processes are ended."""
    # A short path: the cluster's sockets lie below it, and the system allows 107 bytes.
    folder = tempfile.mkdtemp(prefix="ray-")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_TMPDIR", folder)
        patch.setenv("TMPDIR", folder)  # where a worker that is killed leaves its files
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("PYTHONPATH", str(REPOSITORY))
        from ray.cluster_utils import Cluster

        node = {"num_cpus": 1, "object_store_memory": OBJECT_STORE_BYTES}
        cluster = Cluster(initialize_head=True, head_node_args={**node, "include_dashboard": False})
        try:
            cluster.add_node(**node)
            yield cluster.address
        finally:
            cluster.shutdown()
            shutil.rmtree(folder, ignore_errors=True)


@pytest.mark.slow
def test_a_killed_workers_episode_is_run_again_and_none_is_lost_or_counted_twice(
    cluster_address: str, tmp_path: Path
) -> None:
    pids = tmp_path / "pids"
    pids.mkdir()
    worker = (sys.executable, "-m", "tests.support.benchmark.dynanav_fakes", "--pids", str(pids))
    store = ResultStore.create(tmp_path / "out", {"episodes": []})
    names = ["a", "hangs-once", "b", "c"]
    killed: list[int] = []
    retried: list[tuple[str, str]] = []

    def kill_the_one_that_hangs() -> bool:
        written = pids / "hangs-once.1"
        if not killed and written.exists() and written.read_text():
            killed.append(int(written.read_text()))
            os.kill(killed[0], signal.SIGKILL)  # the Ray worker that the episode's process belongs to
        return False

    jobs = ClusterJobs(cluster_address, worker)
    assert jobs.free() == 2
    done = run_all(
        [fakes.task(name, store.directory) for name in names],
        jobs,
        store,
        stopped=kill_the_one_that_hangs,
        watcher=RunWatcher(retried=lambda name, why: retried.append((name, why))),
    )
    assert done and killed and not store.failed
    assert sorted((r.id, r.attempts) for r in read_results(store.directory)) == [
        ("a", 1), ("b", 1), ("c", 1), ("hangs-once", 2),
    ]  # fmt: skip
    assert retried == [("hangs-once", "its cluster worker ended: WorkerCrashedError")]
    # What a node's worker has written comes back with its result.
    assert sorted(path.name for path in (store.directory / "episodes").glob("*.json")) == [
        f"{name}.json" for name in sorted(names)
    ]


@pytest.mark.slow
def test_an_address_without_a_cluster_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ClusterError, match=r"--cluster nonsense: no Ray cluster there"):
        ClusterJobs("nonsense")


class NoProcessors:
    """A cluster, as Ray tells of it, whose processors come and go as a test says."""

    def __init__(self) -> None:
        self.address = ""
        self.processors = 0
        self.now_ns = 0
        self.slept_s: list[float] = []

    def sleep(self, time_s: float) -> None:
        self.slept_s.append(time_s)
        self.now_ns += round(time_s * 1e9)

    def init(self, **_: object) -> None:
        """Nothing to reach."""

    def remote(self, **_: object) -> Callable[[object], object]:
        return lambda function: function

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": float(self.processors)} if self.processors else {}

    def shutdown(self) -> None:
        """Nothing to leave."""


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch) -> Iterator[NoProcessors]:
    cluster = NoProcessors()
    monkeypatch.setitem(sys.modules, "ray", cluster)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        cluster.address = f"127.0.0.1:{listening.getsockname()[1]}"
        yield cluster


def jobs_on(cluster: NoProcessors) -> ClusterJobs:
    return ClusterJobs(cluster.address, now_ns=lambda: cluster.now_ns, sleep=cluster.sleep)


def test_a_cluster_without_processors_is_given_up_in_one_line_and_not_spun_on(
    bare: NoProcessors, tmp_path: Path
) -> None:
    store = ResultStore.create(tmp_path / "out", {"episodes": []})
    with pytest.raises(
        ClusterError, match=r"--cluster 127\.0\.0\.1:\d+: expected a processor .* none for 60 s; add a node"
    ):
        run_all([fakes.task("a", store.directory)], jobs_on(bare), store)
    assert set(bare.slept_s) == {POLL_S} and sum(bare.slept_s) == pytest.approx(60, abs=1)


def test_a_cluster_whose_processors_come_back_is_not_given_up(bare: NoProcessors) -> None:
    jobs = jobs_on(bare)
    bare.sleep(59)
    assert jobs.free() == 0
    bare.processors = 2
    assert jobs.free() == 2
    bare.processors = 0
    bare.sleep(59)
    assert jobs.wait(0.2) == () and jobs.free() == 0


@pytest.mark.slow
def test_a_node_sends_back_flight_logs_and_causes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def one(task: EpisodeTask, _: object) -> Ended:
        task.flight_path.write_bytes(b"log")
        (task.folder / "causes" / "a.json").write_bytes(b"{}")
        return Ended("a", fakes.result("a"))

    monkeypatch.setattr(cluster, "_one", one)
    _, files = run_on_node(json.dumps(fakes.task("a", tmp_path).as_json()), code_sha256(), None)
    assert dict(files) == {"flights/a.mcap": b"log", "causes/a.json": b"{}"}


@pytest.mark.slow
def test_a_node_with_other_code_refuses_its_episodes(tmp_path: Path) -> None:
    answer, files = run_on_node(json.dumps(fakes.task("a", tmp_path).as_json()), "0" * 64, None)
    content = json.loads(answer)
    assert content["result"] is None and content["refused_code"] == 2 and "other code" in content["why"] and not files
