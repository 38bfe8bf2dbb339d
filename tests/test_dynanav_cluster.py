"""Episodes on a local Ray cluster of two nodes: a killed worker's episode is run again, and counts once."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from sim_hil.benchmark.cluster import ClusterError, ClusterJobs, run_on_node
from sim_hil.benchmark.jobs import RunWatcher, run_all
from sim_hil.benchmark.store import ResultStore, read_results
from tests import dynanav_fakes as fakes
from tests.processes import REPOSITORY

pytest.importorskip("ray", reason="needs the packages of the extra 'cluster' (ray)")

OBJECT_STORE_BYTES = 80 * 2**20


@pytest.fixture(scope="module")
def cluster_address() -> Iterator[str]:
    """Two nodes with a processor each, in a folder of their own; only their own processes are ended."""
    # A short path: the cluster's sockets lie below it, and the system allows 107 bytes.
    folder = tempfile.mkdtemp(prefix="ray-")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_TMPDIR", folder)
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


def test_a_killed_workers_episode_is_run_again_and_none_is_lost_or_counted_twice(
    cluster_address: str, tmp_path: Path
) -> None:
    pids = tmp_path / "pids"
    pids.mkdir()
    worker = (sys.executable, "-m", "tests.dynanav_fakes", "--pids", str(pids))
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


def test_an_address_without_a_cluster_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ClusterError, match=r"--cluster nonsense: no Ray cluster there"):
        ClusterJobs("nonsense")


def test_a_node_with_other_code_refuses_its_episodes(tmp_path: Path) -> None:
    told, files = run_on_node(json.dumps(fakes.task("a", tmp_path).as_json()), "0" * 64, None)
    content = json.loads(told)
    assert content["result"] is None and content["refused_code"] == 2 and "other code" in content["why"] and not files
