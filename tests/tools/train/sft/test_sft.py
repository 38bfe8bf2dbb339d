"""Supervised fine-tuning learns what is said, touches nothing but the language model, and is exact when ended."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from tests.support.train.train_drives import made_up_drive, small_dataset, write_dataset
from tests.support.train.train_sft_rank import CONFIG, sft_job, trained
from tests.support.train.train_stage_contract import Run, StageContract
from tools.train.config.checks import OptimConfig, TrainError
from tools.train.config.collect import CollectConfig, TourConfig
from tools.train.config.recipe import load_recipe
from tools.train.config.sft import RelabelConfig, SftConfig
from tools.train.drives.drive import Dataset
from tools.train.pipeline.chain import Step, budget_of, run_step
from tools.train.run.job import StageJob
from tools.train.run.network_file import stage_weights
from tools.train.sft.sft import run


@pytest.fixture(scope="module", autouse=True)
def as_on_the_command_line() -> Iterator[None]:
    """`edge-train` asks torch for deterministic algorithms: one that is not would raise. Tiny layers: one thread."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    torch.set_deterministic_debug_mode("error")
    yield
    torch.set_deterministic_debug_mode("default")
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return small_dataset(tmp_path_factory.mktemp("collect"))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, dataset: Dataset) -> Run:
    """A run that nobody ended."""
    return run_of(dataset, sft_job(tmp_path_factory.mktemp("whole")))


def run_of(dataset: Dataset, job: StageJob) -> Run:
    network, result = trained(dataset, job)
    return Run(network.state_dict(), list(job.run_dir.lines()), result)


@pytest.mark.slow
def test_the_loss_falls_on_training_and_held_out_data(tmp_path: Path, dataset: Dataset) -> None:
    job = sft_job(tmp_path, dataclasses.replace(CONFIG, epochs=12, optim=OptimConfig(lr=1e-2, warmup_steps=0)))
    _, result = trained(dataset, job)
    lines = list(job.run_dir.lines())
    held = [line["held_loss"] for line in lines if "held_loss" in line]
    assert result["steps"] == len(lines) == 36 and result["held_anchors"] == 7 and len(held) == 12
    assert lines[0]["loss"] > 6.5
    assert result["loss"] < 0.5 * lines[0]["loss"]
    assert held[-1] < 0.7 * held[0]


@pytest.mark.slow
class TestStage(StageContract):
    rank = "tests.support.train.train_sft_rank"
    other = dataclasses.replace(CONFIG, batch=7)

    @pytest.fixture(autouse=True)
    def _drives(self, dataset: Dataset) -> None:
        self._dataset = dataset

    def prepare(self, out: Path) -> list[str]:
        return [str(self._dataset.folder)]

    def train(self, out: Path, config: SftConfig | None = None, **options: Any) -> Run:
        return run_of(self._dataset, sft_job(out, config or CONFIG, **options))


def test_drives_without_traces_cannot_be_learned_from(tmp_path: Path) -> None:
    silent = write_dataset(tmp_path / "collect", [made_up_drive("a", 20, traces=())])
    with pytest.raises(TrainError, match="no anchors"):
        trained(silent, sft_job(tmp_path))


@pytest.mark.slow
def test_the_stage_reads_the_runs_drives_and_leaves_the_runs_network(tmp_path: Path) -> None:
    small_dataset(tmp_path / "collect")
    few = dataclasses.replace(CONFIG.evaluate, anchors=2, epoch_anchors=1, drives=1, max_new_tokens=3)
    job = sft_job(tmp_path, dataclasses.replace(CONFIG, epochs=1, evaluate=few))
    result = run(job)
    assert result["steps"] == 3 and np.isfinite(result["held_loss"])
    assert result["held_out"]["taught"]["answers"] == 2 and result["held_out"]["own"]["answers"] == 4
    assert [line["progress_share"] for line in job.run_dir.lines() if "progress_share" in line] == [0.0]
    assert (tmp_path / "sft" / "model.safetensors").read_bytes() == job.run_dir.model_path.read_bytes()


@pytest.mark.slow
def test_after_a_round_of_dagger_it_goes_on_from_what_it_was(tmp_path: Path) -> None:
    small_dataset(tmp_path / "collect")
    silent = dataclasses.replace(CONFIG.evaluate, anchors=0, epoch_anchors=0, drives=0)
    job = sft_job(tmp_path, dataclasses.replace(CONFIG, epochs=2, evaluate=silent, go_on_share=0.5, go_on_lr_share=0.1))
    steps = run_step(job, Step("sft"))["steps"]
    assert run_step(job, Step("sft", 1))["steps"] == steps / 2
    before, after = (load_file(stage_weights(tmp_path, name)) for name in ("sft-0", "sft"))
    name = "language.layers.0.down.weight"
    assert 0 < (after[name] - before[name]).abs().max() < steps * CONFIG.optim.lr * 0.1


@pytest.mark.slow
def test_after_a_round_of_dagger_a_share_of_the_tours_is_learned_again_and_none_is_made(tmp_path: Path) -> None:
    small_dataset(tmp_path / "collect")
    silent = dataclasses.replace(CONFIG.evaluate, anchors=0, epoch_anchors=0, drives=0)
    tours = TourConfig(count=2, per_layout=2, people_most=0)
    numbers = dataclasses.replace(CONFIG, epochs=1, evaluate=silent, mirrored=0.0, tours=tours, tours_again=0.5)
    job = sft_job(tmp_path, numbers)
    recipe = dataclasses.replace(job.recipe, collect=CollectConfig(kinds={"corridor": 1.0}, jobs=1))
    job = dataclasses.replace(job, recipe=recipe)
    first = run_step(job, Step("sft"))
    made = sorted((tmp_path / "collect" / "tours").glob("*/drives/*"))
    again = run_step(job, Step("sft", 1))
    assert 0 < again["more_anchors"] < first["more_anchors"]
    assert sorted((tmp_path / "collect" / "tours").glob("*/drives/*")) == made


def test_the_budget_of_a_round_has_no_tours_to_make() -> None:
    recipe = load_recipe("nano", ["sft.tours.count=100", "sft.tours_again=0.1", "dagger.rounds=1"])
    lines = {line.what: line.samples for line in budget_of(recipe, [Step("sft")], "cpu")}
    later = {line.what: line.samples for line in budget_of(recipe, [Step("sft", 1)], "cpu")}
    assert lines["tours: made"] == 100 and not {"tours: made", "tours: frames encoded"} & set(later)
    share = (recipe.sft or SftConfig()).go_on_share
    assert later["tours: anchors learned"] == round(lines["tours: anchors learned"] * share * 0.1)


def test_the_budget_counts_the_other_instructions_of_drives_and_of_tours() -> None:
    few = ["collect.episodes=30", "sft.tours.count=100", "sft.retold.ways=2", "sft.retold.tour_ways=3"]
    lines = {line.what: line.samples for line in budget_of(load_recipe("nano", few), [Step("sft")], "cpu")}
    assert lines["other instructions"] == 60 and lines["tours: other instructions"] == 300
    none = load_recipe("nano", [*few, "sft.retold.ways=0", "sft.retold.tour_ways=0"])
    assert not any("instructions" in line.what for line in budget_of(none, [Step("sft")], "cpu"))


@pytest.mark.slow
def test_tours_are_made_and_learned_from_beside_the_drives(tmp_path: Path) -> None:
    small_dataset(tmp_path / "collect")
    silent = dataclasses.replace(CONFIG.evaluate, anchors=0, epoch_anchors=0, drives=0)
    tours = TourConfig(count=2, per_layout=2, people_most=0)
    job = sft_job(tmp_path, dataclasses.replace(CONFIG, epochs=1, evaluate=silent, mirrored=0.5, tours=tours))
    recipe = dataclasses.replace(job.recipe, collect=CollectConfig(kinds={"corridor": 1.0}, jobs=1))
    result = run(dataclasses.replace(job, recipe=recipe))
    made = Dataset.open(next((tmp_path / "collect" / "tours").iterdir()))
    assert 0 < result["more_anchors"] <= sum(entry.frames // 10 + 1 for entry in made.entries)
    assert {entry.driver for entry in made.entries} == {"tour"}
    assert not set(made.ids) & set(Dataset.open(tmp_path / "collect").ids)


@pytest.mark.slow
def test_tours_are_learned_from_under_other_instructions_too(tmp_path: Path) -> None:
    small_dataset(tmp_path / "collect")
    silent = dataclasses.replace(CONFIG.evaluate, anchors=0, epoch_anchors=0, drives=0)
    tours = TourConfig(count=2, per_layout=2, people_most=0)
    numbers = dataclasses.replace(CONFIG, epochs=1, evaluate=silent, mirrored=0.0, tours=tours)
    retold = dataclasses.replace(numbers, retold=RelabelConfig(tour_ways=2))
    found = []
    for name, config in (("once", numbers), ("retold", retold)):
        job = sft_job(tmp_path / name, config)
        shutil.copytree(tmp_path / "collect", tmp_path / name / "collect")
        recipe = dataclasses.replace(job.recipe, collect=CollectConfig(kinds={"corridor": 1.0}, jobs=1))
        found.append(run(dataclasses.replace(job, recipe=recipe))["more_anchors"])
    assert found[1] > found[0] > 0
