"""A collection gives the same data set however many processes make it, and goes on where it was ended."""

from __future__ import annotations

import errno
import json
import os
import shutil
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from export.core.typed import plain
from export.model.config import PRESETS
from sim_hil.benchmark.language.instructions import is_held_out
from sim_hil.benchmark.policies.select import robot_config
from tests.support.train.train_fake_worker import BEGUN
from tools.train.collect import collection, worker
from tools.train.collect.collection import Collection, collect, fill
from tools.train.collect.worker import Draw, Order, messages
from tools.train.config.checks import TrainError
from tools.train.config.collect import CollectConfig
from tools.train.config.recipe import Recipe
from tools.train.config.rl import EvaluateConfig
from tools.train.drives.dataset import DatasetWriter
from tools.train.drives.drive import Dataset, Drive
from tools.train.drives.scenarios import KEPT_SEEDS
from tools.train.run.distributed import SINGLE, Ranks
from tools.train.run.job import StageFailedError, StageJob
from tools.train.run.run_dir import RunDir

FAKE = (sys.executable, "-m", "tests.support.train.train_fake_worker")
Faulty = Callable[..., None]
COUNT = 10


def _collection(count: int = COUNT, **changed: Any) -> Collection:
    return Collection("e", count, 3, 0, CollectConfig(episodes=count, drives_per_layout=8, **changed))


def _collect(folder: Path, count: int = COUNT, jobs: int = 2, stopped: Callable[[], bool] = lambda: False) -> Dataset:
    with DatasetWriter(folder) as writer:
        fill(writer, _collection(count), jobs, stopped=stopped, command=FAKE)
        return writer.finish()


def _begun(folder: Path) -> list[str]:
    return (folder / BEGUN).read_text().split()


@pytest.fixture
def faulty(monkeypatch: pytest.MonkeyPatch) -> Faulty:
    """Have the made-up workers misbehave."""
    return lambda **fault: monkeypatch.setenv("FAKE_WORKER", json.dumps(fault))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """All of a collection, made by three processes."""
    return _collect(tmp_path_factory.mktemp("whole"), jobs=3)


# -- who makes what ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_every_requested_drive_is_collected_and_no_other(whole: Dataset) -> None:
    assert whole.ids == tuple(f"e{number:05d}" for number in range(COUNT))
    assert Counter(_begun(whole.folder)).most_common(1)[0][1] == 1


@pytest.mark.slow
def test_how_many_processes_there_are_changes_nothing(tmp_path: Path, whole: Dataset) -> None:
    assert _collect(tmp_path, jobs=1).sha256 == whole.sha256


@pytest.mark.slow
def test_a_collection_that_was_ended_goes_on_to_the_same_data_set(tmp_path: Path, whole: Dataset) -> None:
    looks = iter([False, False, False])
    with pytest.raises(KeyboardInterrupt):
        _collect(tmp_path, jobs=1, stopped=lambda: next(looks, True))
    assert _collect(tmp_path, jobs=2).sha256 == whole.sha256


@pytest.mark.slow
def test_only_the_drive_whose_file_is_damaged_is_made_again(tmp_path: Path, whole: Dataset) -> None:
    shutil.copytree(whole.folder, tmp_path, dirs_exist_ok=True)
    (tmp_path / BEGUN).unlink()
    replace(whole, folder=tmp_path).path("e00009").write_bytes(b"damaged")
    assert _collect(tmp_path).sha256 == whole.sha256
    assert _begun(tmp_path) == ["e00009"]


# -- what goes wrong --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_drive_that_kills_its_process_is_given_up_and_the_others_come(tmp_path: Path, faulty: Faulty) -> None:
    faulty(die=["e00002", "e00003"])
    found = _collect(tmp_path, count=8)
    assert found.ids == ("e00000", "e00001", "e00004", "e00005", "e00006", "e00007")
    with DatasetWriter(tmp_path) as writer:
        assert writer.summary()["dropped"] == {"its process ended by SIGKILL": 2}


@pytest.mark.slow
def test_a_drive_with_nothing_to_learn_is_counted_and_not_tried_again(tmp_path: Path, faulty: Faulty) -> None:
    faulty(drop=["e00001"])
    assert "e00001" not in _collect(tmp_path, count=8).ids
    (tmp_path / BEGUN).unlink()
    faulty()
    assert len(_collect(tmp_path, count=9)) == 8
    assert _begun(tmp_path) == ["e00008"]


@pytest.mark.slow
def test_a_process_that_ends_badly_after_its_last_drive_costs_nothing(tmp_path: Path, faulty: Faulty) -> None:
    faulty(end_badly=True)
    assert len(_collect(tmp_path, count=8)) == 8


@pytest.mark.slow
def test_a_process_that_never_begins_ends_the_collection_with_its_last_lines(tmp_path: Path, faulty: Faulty) -> None:
    faulty(deaf=True)
    with pytest.raises(StageFailedError, match=r"e00000 .* exit code 5: no hands"):
        _collect(tmp_path, count=8)


def test_a_refusal_ends_the_collection(tmp_path: Path, faulty: Faulty) -> None:
    faulty(refuse=True)
    with pytest.raises(StageFailedError, match="not these artifacts"):
        _collect(tmp_path, count=8)


@pytest.mark.slow
def test_when_most_drives_fail_the_collection_ends_with_an_error(tmp_path: Path, faulty: Faulty) -> None:
    faulty(drop=[f"e{number:05d}" for number in range(80)])
    with pytest.raises(StageFailedError, match="gave nothing to learn, the last: it left the way"):
        _collect(tmp_path, count=80)


@pytest.mark.slow
def test_no_process_is_left_behind(tmp_path: Path, faulty: Faulty, monkeypatch: pytest.MonkeyPatch) -> None:
    faulty(refuse=True)
    opened: list[collection.Workers] = []

    class Watched(collection.Workers):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            opened.append(self)

    monkeypatch.setattr(collection, "Workers", Watched)
    with pytest.raises(StageFailedError):
        _collect(tmp_path)
    assert [workers.running() for workers in opened] == [0]


# -- orders and draws -------------------------------------------------------------------------------------------------


def test_one_process_records_several_small_layouts() -> None:
    small = Collection("e", COUNT, 3, 0, CollectConfig(episodes=COUNT, drives_per_layout=2))
    first, second = small.orders(Path("folder"), lambda _: False)
    assert (first.start, first.count, first.skip) == (0, 8, ())
    assert (second.start, second.skip) == (8, tuple(f"e{number:05d}" for number in range(10, 16)))


@pytest.mark.slow
def test_layouts_of_evaluation_and_reinforcement_learning_are_not_collected() -> None:
    found = {
        replace(_collection(), seed=seed, turn=1).orders(Path("folder"), lambda _: False)[0].scenario_seed
        for seed in range(400)
    }
    assert len(found) > 200 and found.isdisjoint(KEPT_SEEDS)
    assert EvaluateConfig().scenario_seed in KEPT_SEEDS


@pytest.mark.slow
def test_scenarios_are_drawn_in_the_requested_shares() -> None:
    config = CollectConfig(noise_share=0.3, sharp_share=0.2, typical_drift_share=0.5, severe_drift_share=0.1)
    draws = [Draw.of(config, 7, number) for number in range(3000)]
    shares = Counter(draw.drift for draw in draws)
    assert sum(draw.noise for draw in draws) / 3000 == pytest.approx(0.3, abs=0.03)
    assert sum(draw.camera.render_px == 256 for draw in draws) / 3000 == pytest.approx(0.2, abs=0.03)
    assert [shares[level] / 3000 for level in ("none", "typical", "severe")] == pytest.approx([0.4, 0.5, 0.1], abs=0.03)
    assert {draw.camera.jpeg_quality for draw in draws} == set(range(80, 96))


def test_the_expert_drives_no_faster_than_a_policy_may() -> None:
    assert CollectConfig().speed_mps <= robot_config().limits.vx_max_mps


# -- the real thing ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_real_drive_is_made_of_a_training_scenario_and_is_the_same_in_any_process(tmp_path: Path) -> None:
    config = CollectConfig(episodes=1, kinds={"corridor": 1.0}, noise_share=0.0)
    with DatasetWriter(tmp_path / "here") as here, DatasetWriter(tmp_path / "process") as there:
        order = Order(str(here.folder), "e", 7, 3, 0, 1, (), config)
        begun, made = list(messages(plain(order)))
        workers, received = collection.Workers(collection.WORKER, 1), []
        workers.start("e", plain(replace(order, folder=str(there.folder))), tmp_path / "e.log")
        while workers.running():
            received += [each.message for each in workers.wait(1.0)]
        workers.close()
        drive = Drive.load(here.path("e00000"))
    assert begun == {"begun": "e00000"} and received == [begun, dict(made), None]
    assert drive.about.kind == "corridor" and drive.about.outcome == "reached" and drive.about.driver == "expert"
    assert len(drive.wordings) >= 8 and not any(is_held_out(text) for text in drive.wordings)
    assert len(drive.traces) == (len(drive) - 1) // 10 + 1


def test_a_full_disk_ends_the_recording_and_drops_no_drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(worker, "_drive", full)
    order = Order(str(tmp_path), "e", 7, 3, 0, 2, (), CollectConfig(episodes=2, kinds={"corridor": 1.0}))
    *_, last = messages(plain(order))
    assert last == {"refused": f"{tmp_path}: No space left on device"}


@pytest.mark.slow
def test_the_stage_collects_by_the_recipe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collection.fill, "__kwdefaults__", {**collection.fill.__kwdefaults__, "command": FAKE})
    result = collect(_job(tmp_path))
    assert result["drives"] == 3 and result["sha256"] == Dataset.open(tmp_path / "collect").sha256
    json.dumps(result)


def test_under_torchrun_it_refuses(tmp_path: Path) -> None:
    with pytest.raises(TrainError, match="without torchrun"):
        collect(_job(tmp_path, ranks=Ranks(0, 2)))


def _job(folder: Path, ranks: Ranks = SINGLE) -> StageJob:
    recipe = Recipe("test", 1, PRESETS["nano"], collect=CollectConfig(episodes=3, jobs=1))
    return StageJob(recipe, RunDir(folder), seed=5, ranks=ranks)
