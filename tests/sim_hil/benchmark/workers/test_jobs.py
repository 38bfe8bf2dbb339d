"""Episodes in worker processes: each is counted once, whatever happens to its process."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from sim_hil.benchmark.results.store import ResultStore, read_results
from sim_hil.benchmark.workers.jobs import Ended, LocalJobs, RefusedRunError, RunWatcher, run_all
from sim_hil.benchmark.workers.task import EpisodeTask
from tests.support.benchmark import dynanav_fakes as fakes

FAKE_WORKER = (sys.executable, "-m", "tests.support.benchmark.dynanav_fakes")


class Scripted:
    """A backend that ends attempts as a script says: id → what comes of its attempts, one after the other."""

    attempts = 2

    def __init__(self, slots: int, **script: Sequence[str]) -> None:
        self._slots, self._script = slots, {name: list(ends) for name, ends in script.items()}
        self.running: list[EpisodeTask] = []
        self.most = 0
        self.closed = False

    def free(self) -> int:
        return self._slots - len(self.running)

    def start(self, task: EpisodeTask) -> None:
        self.running.append(task)
        self.most = max(self.most, len(self.running))

    def wait(self, timeout_s: float) -> list[Ended]:
        task = self.running.pop()
        name = task.episode.id
        end = (self._script.get(name) or ["ok"]).pop(0)
        if end == "twice":
            return [Ended(name, fakes.result(name))] * 2
        if end == "dies":
            return [Ended(name, why="died")]
        files = ((f"causes/{name}.json", b"{}"), (f"flights/{name}.mcap", b"log")) if end == "files" else ()
        return [Ended(name, fakes.result(name, attempts=task.attempt), files=files)]

    def times_s(self) -> dict[str, float]:
        return {}

    def close(self) -> None:
        self.closed = True


def store_in(folder: Path) -> ResultStore:
    return ResultStore.create(folder / "out", {"episodes": []})


def tasks_in(store: ResultStore, *names: str) -> list[EpisodeTask]:
    return [fakes.task(name, store.directory) for name in names]


def test_every_episode_gets_one_result_and_no_more_run_at_a_time_than_there_are_slots(tmp_path: Path) -> None:
    store, backend = store_in(tmp_path), Scripted(2)
    assert run_all(tasks_in(store, "a", "b", "c", "d", "e"), backend, store)
    assert sorted(r.id for r in read_results(store.directory)) == ["a", "b", "c", "d", "e"]
    assert backend.most == 2 and backend.closed


def test_what_another_node_has_written_is_put_into_folders_that_the_run_lacks(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    assert run_all(tasks_in(store, "a"), Scripted(1, a=["files"]), store, stopped=lambda: False)
    assert (store.directory / "causes/a.json").read_bytes() == b"{}"
    assert (store.directory / "flights/a.mcap").read_bytes() == b"log"


def test_an_attempt_that_ends_without_a_result_is_run_again_once(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    run_all(tasks_in(store, "a"), Scripted(1, a=["dies", "ok"]), store)
    assert [(r.id, r.attempts) for r in store.results] == [("a", 2)] and not store.failed


def test_an_episode_whose_process_always_dies_is_a_failed_run_and_in_no_rate(tmp_path: Path) -> None:
    store, failures = store_in(tmp_path), []
    run_all(
        tasks_in(store, "a", "b"), Scripted(1, a=["dies", "dies"]), store, watcher=RunWatcher(failed=failures.append)
    )
    assert [r.id for r in store.results] == ["b"]
    assert (
        [(f.id, f.attempts, f.why) for f in store.failed]
        == [("a", 2, "died")]
        == [(f.id, f.attempts, f.why) for f in failures]
    )


def test_a_result_that_is_reported_twice_counts_once(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    run_all(tasks_in(store, "a", "b"), Scripted(2, a=["twice"], b=["twice"]), store)
    assert sorted(r.id for r in read_results(store.directory)) == ["a", "b"]


def test_episodes_that_have_a_result_are_not_run_again(tmp_path: Path) -> None:
    store, backend = store_in(tmp_path), Scripted(1)
    store.add(fakes.result("a"))
    started: list[str] = []
    backend.start = lambda task: (started.append(task.episode.id), backend.running.append(task))  # type: ignore[method-assign]
    run_all(tasks_in(store, "a", "b"), backend, store)
    assert started == ["b"]


def test_a_stop_ends_the_run_with_what_is_finished(tmp_path: Path) -> None:
    store, backend = store_in(tmp_path), Scripted(1)
    finished = run_all(tasks_in(store, "a", "b", "c"), backend, store, stopped=lambda: len(store.results) == 2)
    assert not finished and len(read_results(store.directory)) == 2 and backend.closed


@pytest.mark.slow
def test_a_killed_worker_process_is_reported_with_its_signal_and_its_last_lines(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    run_all(tasks_in(store, "dies"), LocalJobs(1, FAKE_WORKER), store)
    assert store.failed[0].why == "its process gave no result: ended by SIGKILL: out of luck"


def test_a_worker_process_that_is_killed_once_is_run_again_and_leaves_no_log(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    run_all(tasks_in(store, "dies-once", "a"), LocalJobs(2, FAKE_WORKER), store)
    assert sorted((r.id, r.attempts) for r in store.results) == [("a", 1), ("dies-once", 2)]
    assert sorted(path.name for path in (store.directory / "episodes").iterdir()) == ["a.json", "dies-once.json"]


@pytest.mark.slow
def test_half_a_result_is_none(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    run_all(tasks_in(store, "half"), LocalJobs(1, FAKE_WORKER), store)
    assert not store.results and store.failed[0].why == "its process gave no result: ended with exit code 0"


def test_a_process_that_the_guard_of_unproven_graphs_ends_is_a_refusal(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    with pytest.raises(RefusedRunError, match=r"exit code 3: .*self-test: not done after its limit of 9 s") as caught:
        run_all(tasks_in(store, "guarded"), LocalJobs(1, FAKE_WORKER), store)
    assert caught.value.code == 3 and not store.failed


def test_a_permanent_failure_ends_the_run_with_its_line(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    with pytest.raises(RefusedRunError, match="episode refuses: no such scene") as caught:
        run_all(tasks_in(store, "refuses"), LocalJobs(1, FAKE_WORKER), store)
    assert caught.value.code == 2


@pytest.mark.slow
def test_a_worker_that_is_slow_to_exit_is_waited_for_without_spinning(tmp_path: Path) -> None:
    jobs, waits, ended = LocalJobs(1, FAKE_WORKER), 0, []
    jobs.start(fakes.task("lingers", tmp_path))
    while not ended and waits < 200:
        ended = list(jobs.wait(0.2))
        waits += 1
    jobs.close()
    assert ended and ended[0].result is not None and waits < 200


def test_closing_ends_the_workers_that_still_run(tmp_path: Path) -> None:
    jobs = LocalJobs(1, FAKE_WORKER)
    jobs.start(fakes.task("hangs", tmp_path))
    (pid,) = jobs.pids().values()
    jobs.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
