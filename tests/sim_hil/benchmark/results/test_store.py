"""A run's directory is valid after any interruption, and a resumed run is the same run."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from sim_hil.benchmark.results import compare
from sim_hil.benchmark.results import store as store_module
from sim_hil.benchmark.results.record import DELAY_POINTS, FailedRun, ResultError
from sim_hil.benchmark.results.store import FAILED, RESULTS, ResultStore, StoreError, read_failed, read_results
from tests.support.benchmark import dynanav_fakes as fakes

CONFIG = {"suite": "dynanav", "conditions": {"drift": "none"}, "episodes": ["a", "b"]}


def made(folder: Path) -> ResultStore:
    return ResultStore.create(folder / "out", CONFIG)


def test_a_result_is_on_the_disk_when_it_was_added(tmp_path: Path) -> None:
    store = made(tmp_path)
    store.add(
        fakes.result(
            "a", collided=True, collisions=("person",), delay_s={"mean": 3.0, "p50": 3.0, "p99": 4.0, "max": 4.0}
        )
    )
    assert read_results(store.directory) == store.results


def test_a_second_result_of_an_episode_is_refused(tmp_path: Path) -> None:
    store = made(tmp_path)
    assert store.add(fakes.result("a")) and not store.add(fakes.missed("a"))
    assert [r.success for r in read_results(store.directory)] == [True]


def test_a_line_that_was_cut_by_a_death_is_no_result_and_resuming_removes_it(tmp_path: Path) -> None:
    store = made(tmp_path)
    store.add(fakes.result("a"))
    store.close()
    with (store.directory / RESULTS).open("a") as file:
        file.write('{"id": "b", "sce')
    resumed = ResultStore.resume(store.directory, CONFIG)
    resumed.add(fakes.result("b"))
    assert [r.id for r in read_results(store.directory)] == ["a", "b"]


def test_resuming_with_other_conditions_is_refused_with_the_difference(tmp_path: Path) -> None:
    made(tmp_path).close()
    other = {**CONFIG, "conditions": {"drift": "severe"}}
    with pytest.raises(StoreError, match=r'conditions of .* differs .*drift: "none" then, "severe" now'):
        ResultStore.resume(tmp_path / "out", other)


def test_a_directory_with_files_is_not_written_into(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(StoreError, match="new or empty directory"):
        ResultStore.create(tmp_path, CONFIG)


def test_a_run_that_died_before_its_configuration_was_written_is_begun_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(store_module, "write_whole", killed)
        made(tmp_path)
    assert made(tmp_path).results == []


def test_resuming_where_no_run_is_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="contains no benchmark run"):
        ResultStore.resume(tmp_path, CONFIG)


def test_two_runs_cannot_share_a_directory_at_a_time(tmp_path: Path) -> None:
    store = made(tmp_path)
    with pytest.raises(StoreError, match="another edge-bench uses this directory"):
        ResultStore.resume(store.directory, CONFIG)
    store.close()
    ResultStore.resume(store.directory, CONFIG).close()


def test_failed_runs_are_recorded_and_tried_again_by_a_resumed_run(tmp_path: Path) -> None:
    store = made(tmp_path)
    store.add_failed(FailedRun("a", 2, "died"))
    assert "died" in (store.directory / "failed.jsonl").read_text()
    store.close()
    resumed = ResultStore.resume(store.directory, CONFIG)
    assert not resumed.failed and not resumed.has("a") and not (store.directory / "failed.jsonl").exists()


def test_failed_runs_are_read_back_without_a_torn_last_line(tmp_path: Path) -> None:
    store = made(tmp_path)
    assert read_failed(store.directory) == []
    store.add_failed(FailedRun("a", 2, "died"))
    with (store.directory / FAILED).open("a") as file:
        file.write('{"id": "b", "att')
    assert read_failed(store.directory) == [FailedRun("a", 2, "died")] == store.failed


def _line(**wrong: object) -> str:
    return json.dumps({**fakes.result("a").as_json(), **wrong})


@pytest.mark.parametrize(
    ("name", "read", "line", "problem"),
    [
        (
            FAILED,
            read_failed,
            '{"id": "a", "attempts": "two", "why": "died"}',
            "failed run: expected an object with id",
        ),
        (RESULTS, read_results, '{"id": 3}', "result: expected an object with the keys"),
        (RESULTS, read_results, "[" * 100_000, "nested too deeply"),
        (FAILED, read_failed, "[" * 100_000, "nested too deeply"),
        (RESULTS, read_results, _line(id=[]), r"episode \[\]: expected id as text, found \[\]"),
        (RESULTS, read_results, _line(scene={}), r"episode a: expected scene as text, found \{\}"),
        (RESULTS, read_results, _line(ne_m=10**400), "an integer of 1329 bits"),
        (RESULTS, read_results, _line(seed="1"), "episode a: expected seed as a whole number, found '1'"),
        (RESULTS, read_results, _line(collisions=[{}], collided=True), "episode a: expected collisions as texts"),
        (RESULTS, read_results, _line(delay_s=5), "result: 'int' object"),
        (RESULTS, read_results, _line(delay_s=dict.fromkeys(DELAY_POINTS, "x")), "episode a: expected delay_s with"),
    ],
)
def test_a_damaged_line_is_refused_with_its_number(
    tmp_path: Path, name: str, read: Callable[[Path], object], line: str, problem: str
) -> None:
    store = made(tmp_path)
    (store.directory / name).write_text(f"{line}\n")
    with pytest.raises(StoreError, match=f"{name}:1: {problem}"):
        read(store.directory)


def make_sparse(path: Path) -> None:
    path.touch()
    os.truncate(path, 3 << 30)


SPECIAL: dict[str, tuple[Callable[[Path], object], str]] = {
    "a FIFO": (os.mkfifo, "is not a regular file"),
    "a link to /dev/zero": (lambda path: path.symlink_to("/dev/zero"), "is not a regular file"),
    "a sparse file of 3 GB": (make_sparse, "is larger than 64000000 bytes"),
}


@pytest.mark.parametrize(("make", "found"), SPECIAL.values(), ids=SPECIAL)
@pytest.mark.timeout(20)
def test_results_that_would_hang_or_fill_the_memory_are_refused(
    tmp_path: Path, make: Callable[[Path], object], found: str
) -> None:
    store = made(tmp_path)
    store.close()
    for name, read in ((RESULTS, read_results), (FAILED, read_failed)):
        make(store.directory / name)
        with pytest.raises(StoreError, match=f"{name}: cannot be read .*{found}"):
            read(store.directory)
    with pytest.raises(StoreError, match=f"{RESULTS}: cannot be read .*{found}"):
        ResultStore.resume(store.directory, CONFIG)


@pytest.mark.parametrize(
    "wrong",
    [{"ne_m": float("nan")}, {"spl": 120.0}, {"success": False}, {"collided": True}, {"trajectory_sha256": "abc"}],
    ids=lambda wrong: next(iter(wrong)),
)
def test_a_result_that_contradicts_itself_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ResultError):
        fakes.result("a", **wrong)


@pytest.mark.parametrize("job", [["compare", "out", "out"], ["report", "out"]], ids=lambda job: job[0])
@pytest.mark.parametrize(
    ("content", "found"),
    [({}, "'suite' as str, found None"), ({**CONFIG, "suite_sha256": "", "conditions": []}, "'conditions' as dict")],
    ids=["empty", "conditions that are a list"],
)
def test_a_run_with_a_damaged_configuration_is_refused_in_one_line(
    content: dict[str, object],
    found: str,
    job: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    store = made(tmp_path)
    store.add(fakes.result("a"))
    (store.directory / "config.json").write_text(json.dumps(content), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert compare.main(job) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "config.json: expected the configuration" in error and found in error
