"""Imitation learns to follow delayed words, touches nothing but the action expert, and is exact when ended."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from export.model.config import TicVlaConfig
from export.model.network import build
from tests.support.train.train_drives import MadeUpTokens, tiny_model
from tests.support.train.train_imitate_rank import CONFIG, FRAMES, imitate_job, side_dataset, trained
from tests.support.train.train_stage_contract import Run, StageContract
from tools.train.config.checks import OptimConfig, TrainError
from tools.train.config.imitate import POINT_GOAL, ImitateConfig, ImitateEvalConfig, SampleConfig
from tools.train.drives.drive import Dataset
from tools.train.imitate.data import NoStates
from tools.train.imitate.imitate import POINT_GOAL_FILE, fit, run
from tools.train.imitate.trainable_policies import PointGoalNetPolicy, build_point_goal, load_point_goal
from tools.train.pipeline.chain import Step, run_step
from tools.train.run import distributed
from tools.train.run.job import StageJob
from tools.train.run.network_file import stage_weights

LONG = dataclasses.replace(
    CONFIG,
    samples=16 * 120,
    batch=16,
    optim=OptimConfig(lr=3e-3, warmup_steps=0),
    held_samples=64,
    held_steps=60,
    evaluate=ImitateEvalConfig(samples=128, batch=32),
)


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return side_dataset(tmp_path_factory.mktemp("collect"))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, dataset: Dataset) -> Run:
    """A run that nobody ended."""
    return run_of(dataset, imitate_job(tmp_path_factory.mktemp("whole")))


def run_of(dataset: Dataset, job: StageJob) -> Run:
    network, result = trained(dataset, job)
    return Run(network.state_dict(), list(job.run_dir.lines()), result)


@pytest.mark.slow
def test_it_learns_to_follow_the_semantic_state_in_unseen_layouts(tmp_path: Path, dataset: Dataset) -> None:
    job = imitate_job(tmp_path, LONG)
    _, result = trained(dataset, job)
    lines = list(job.run_dir.lines())
    assert result["steps"] == len(lines) == 120 and result["drives"] == 2 and result["frames"] == 2 * FRAMES
    held = [line["held_loss"] for line in lines if "held_loss" in line]
    assert len(held) == 2 and held[-1] < 0.5 * lines[0]["loss"]
    errors = result["held_out"]["all"]
    # The side is in the words alone: with the other drive's it goes the other way.
    assert errors["policy"]["fde_m"]["3s"] < 0.8 * errors["other_words"]["fde_m"]["3s"]


def test_all_of_the_action_expert_learns_and_nothing_else(whole: Run) -> None:
    before = build(tiny_model(), 1).state_dict()
    moved = {name for name, tensor in whole.weights.items() if not torch.equal(tensor, before[name])}
    parameters = {name for name, _ in build(tiny_model(), 1).named_parameters() if name.startswith("action.")}
    assert moved == parameters


class TestStage(StageContract):
    rank = "tests.support.train.train_imitate_rank"
    other = dataclasses.replace(CONFIG, inject_delay=False)

    @pytest.fixture(autouse=True)
    def _drives(self, dataset: Dataset) -> None:
        self._dataset = dataset

    def prepare(self, out: Path) -> list[str]:
        return [str(self._dataset.folder)]

    def train(self, out: Path, config: ImitateConfig | None = None, **options: Any) -> Run:
        return run_of(self._dataset, imitate_job(out, config or CONFIG, **options))


def with_action(**changed: Any) -> TicVlaConfig:
    model = tiny_model()
    return dataclasses.replace(model, action=dataclasses.replace(model.action, **changed))


VARIANTS: list[tuple[dict[str, Any], dict[str, Any]]] = [
    ({"semantic_interface": "values-only"}, {}),
    ({"semantic_interface": "waypoints"}, {}),
    ({"semantic_interface": "waypoints", "latency_aware": False}, {"inject_delay": False}),
    ({"latency_aware": False}, {"inject_delay": False}),
    ({"motion_offset": False}, {}),
    ({"steps": 10, "layers": 3}, {}),
    ({"steps": 50}, {}),
    ({"parameterisation": "offsets"}, {}),
    ({"head": "diffusion"}, {}),
    ({"head": "flow"}, {}),
    ({}, {"optim": dataclasses.replace(CONFIG.optim, bf16=True)}),
    ({}, {"sample": SampleConfig(group=2, reasoning=False)}),
]


@pytest.mark.slow
@pytest.mark.parametrize(("model", "config"), VARIANTS, ids=[str({**a, **b})[:60] for a, b in VARIANTS])
def test_every_variant_of_the_paper_can_be_trained(
    tmp_path: Path, dataset: Dataset, model: dict[str, Any], config: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(distributed, "computes_bf16", lambda _device: True)
    short = dataclasses.replace(CONFIG, samples=16, held_steps=2, evaluate=ImitateEvalConfig(samples=4, batch=4))
    job = imitate_job(tmp_path, dataclasses.replace(short, **config), with_action(**model))
    network, result = trained(dataset, job)
    assert result["steps"] == 2 and np.isfinite([result["loss"], result["held_loss"]]).all()
    assert result["mean_age_s"] == pytest.approx(0.0 if not config.get("inject_delay", True) else 5.0)
    assert result["held_out"]["all"]["policy"]["samples"] == 4
    before = build(job.recipe.model, 1).action.state_dict()
    assert not torch.equal(network.action.state_dict()["queries"], before["queries"])


@pytest.mark.slow
def test_the_point_goal_baseline_learns_from_where_the_goal_is(tmp_path: Path, dataset: Dataset) -> None:
    config = dataclasses.replace(LONG, policy=POINT_GOAL)
    job = imitate_job(tmp_path, config)
    policy = PointGoalNetPolicy(build_point_goal(tiny_model(), job.generator("start")), config.loss)
    states = NoStates({entry.id: entry.frames for entry in dataset.entries}, 32)
    result = fit(job, policy, dataset, MadeUpTokens(), states, of="test")
    assert result["mean_age_s"] == 0.0 and set(result["held_out"]["all"]) == {"policy", "keep_state"}
    assert result["held_loss"] < 0.5 * next(iter(job.run_dir.lines()))["loss"]


@pytest.mark.slow
def test_the_stage_reads_the_runs_drives_and_goes_on_after_a_round_of_dagger(tmp_path: Path) -> None:
    side_dataset(tmp_path / "collect")
    config = dataclasses.replace(CONFIG, samples=16, evaluate=ImitateEvalConfig(samples=4, batch=4))
    job = imitate_job(tmp_path, config)
    result = run_step(job, Step("imitate"))
    assert result["steps"] == 2 and np.isfinite(result["held_loss"])
    first = stage_weights(tmp_path, "imitate").read_bytes()
    assert first == job.run_dir.model_path.read_bytes()
    again = run_step(job, Step("imitate", 1))
    assert again["steps"] == 1 and stage_weights(tmp_path, "imitate-0").read_bytes() == first
    # One step of learning rate 3e-3 moves no weight further, so it did not begin from nothing.
    before, after = (load(stage_weights(tmp_path, name)) for name in ("imitate-0", "imitate"))
    name = "action.layers.0.fc1.weight"
    assert 0 < (after[name] - before[name]).abs().max() < 4e-3


def load(path: Path) -> dict[str, torch.Tensor]:
    return load_file(path)


@pytest.mark.slow
def test_the_point_goal_stage_leaves_its_own_weights(tmp_path: Path) -> None:
    side_dataset(tmp_path / "collect")
    config = dataclasses.replace(CONFIG, policy=POINT_GOAL, samples=16)
    job = imitate_job(tmp_path, config)
    run(job)
    path = tmp_path / "imitate" / POINT_GOAL_FILE
    network = load_point_goal(path, tiny_model())
    plans = network(torch.zeros(2, 4, 32), torch.zeros(2, 3), torch.tensor([[5.0, 0.0], [0.0, 0.0]]))
    assert plans.shape == (2, 30, 3) and torch.isfinite(plans).all()
    assert not stage_weights(tmp_path, "imitate").exists()
    with pytest.raises(TrainError, match="another size"):
        load_point_goal(path, with_action(steps=10))
