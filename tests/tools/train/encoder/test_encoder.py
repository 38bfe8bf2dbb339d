"""The encoder learns to see, nothing else is changed, and a run that was ended goes on exactly."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from export.model.network import build
from tests.support.train.train_drives import tiny_model
from tests.support.train.train_encoder_rank import CONFIG, encoder_job
from tests.support.train.train_stage_contract import Run, StageContract
from tools.train.config.checks import OptimConfig, TrainError
from tools.train.config.encoder import EncoderConfig, FramesConfig
from tools.train.config.recipe import Recipe
from tools.train.encoder.encoder import budget, run
from tools.train.run import distributed
from tools.train.samples.tokens import encoder_sha256

STEPS = 8


def trained(out: Path, **options: Any) -> Run:
    """Weights, log and result of a run."""
    job = encoder_job(out, **options)
    result = run(job)
    return Run(load_file(job.run_dir.model_path), list(job.run_dir.lines()), result)


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run that nobody ended."""
    return trained(tmp_path_factory.mktemp("whole"))


@pytest.mark.slow
def test_it_learns_to_see_better_than_whoever_does_not_look(tmp_path: Path) -> None:
    config = dataclasses.replace(CONFIG, epochs=25, look_steps=25, optim=OptimConfig(lr=5e-3, warmup_steps=0))
    _, lines, result = trained(tmp_path, config=config)
    held = [line["held_loss"] for line in lines if "held_loss" in line]
    assert held[-1] < 0.5 * held[0] and result["held_loss"] < 0.5 * held[0]
    seen, fixed = result["held_out"], result["fixed_answer"]
    assert seen["pictures"] == fixed["pictures"] == 16
    assert seen["person_recall"] > 0.8 and seen["landmark_bearing"] > 0.8
    assert seen["main_accuracy"] > fixed["main_accuracy"] + 0.3
    assert seen["near_relative_error"] < 0.3


def test_only_the_encoder_is_changed(whole: Run) -> None:
    before = build(tiny_model(), 1).state_dict()
    moved = {name for name, tensor in whole.weights.items() if not torch.equal(tensor, before[name])}
    assert {name.split(".")[0] for name in moved} == {"vision"}
    assert {name for name in before if name.startswith("vision.")} == moved


def test_its_log_has_a_line_a_step_and_looks_at_held_out_pictures(whole: Run) -> None:
    learned = [line for line in whole.lines if "lr" in line]
    assert [line["step"] for line in learned] == list(range(1, STEPS + 1))
    assert [line["step"] for line in whole.lines if "held_loss" in line] == [3, 6, 8]
    assert all(np.isfinite(line["loss"]) for line in learned)
    assert whole.result["steps"] == STEPS and whole.result["pictures"] == 40


@pytest.mark.slow
def test_the_result_names_the_encoder_that_was_left(tmp_path: Path) -> None:
    weights, _, result = trained(tmp_path)
    network = build(tiny_model(), 1)
    network.load_state_dict(weights)
    assert result["encoder_sha256"] == encoder_sha256(network.vision)


class TestStage(StageContract):
    rank = "tests.support.train.train_encoder_rank"
    other = dataclasses.replace(CONFIG, batch=7)

    def prepare(self, out: Path) -> list[str]:
        encoder_job(out)  # two processes would write the same pictures at once
        return []

    def train(self, out: Path, config: EncoderConfig | None = None, **options: Any) -> Run:
        return trained(out, config=config or CONFIG, **options)


def test_how_many_processes_render_makes_no_difference(tmp_path: Path, whole: Run) -> None:
    trained(tmp_path)
    more = dataclasses.replace(CONFIG, frames=dataclasses.replace(CONFIG.frames, jobs=3))
    assert trained(tmp_path, config=more, resume=True).result == whole.result


def test_bfloat16_gives_about_the_same_losses(tmp_path: Path, whole: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        distributed, "computes_bf16", lambda _device: True
    )  # slowly, where there are no instructions for it
    half = dataclasses.replace(CONFIG, optim=dataclasses.replace(CONFIG.optim, bf16=True))
    losses = [line["loss"] for line in trained(tmp_path, config=half).lines if "lr" in line]
    expected = [line["loss"] for line in whole.lines if "lr" in line]
    assert losses == pytest.approx(expected, rel=0.05) and losses != expected


def test_without_held_out_pictures_it_learns_all_the_same(tmp_path: Path) -> None:
    config = dataclasses.replace(CONFIG, frames=dataclasses.replace(CONFIG.frames, held=0))
    _, lines, result = trained(tmp_path, config=config)
    assert len(lines) == STEPS and "held_out" not in result


def test_without_pictures_the_encoder_stays_as_it_is(tmp_path: Path) -> None:
    weights, lines, result = trained(tmp_path, config=EncoderConfig(frames=FramesConfig(count=0, held=0)))
    before = build(tiny_model(), 1)
    assert lines == [] and result == {"steps": 0, "encoder_sha256": encoder_sha256(before.vision)}
    assert all(torch.equal(tensor, before.state_dict()[name]) for name, tensor in weights.items())


def test_a_network_whose_tokens_have_no_labels_is_refused(tmp_path: Path) -> None:
    job = encoder_job(tmp_path)
    odd = dataclasses.replace(tiny_model().vision, image_px=48)
    model = dataclasses.replace(
        tiny_model(), vision=odd, language=dataclasses.replace(tiny_model().language, token_merge=3)
    )
    recipe = dataclasses.replace(job.recipe, model=model)
    with pytest.raises(TrainError, match="3 x 3 tokens"):
        run(dataclasses.replace(job, recipe=recipe))


def test_the_work_is_told_beforehand() -> None:
    recipe = Recipe("test", 1, tiny_model(), encoder=CONFIG)
    assert [(count, key) for _, count, key in budget(recipe)] == [(56, "render"), (80, "encoder")]


@pytest.mark.parametrize("wrong", [{"epochs": 0}, {"batch": 0}, {"look_frames": -1}, {"checkpoint_steps": 0}])
def test_the_recipes_numbers_are_checked(wrong: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="from"):
        EncoderConfig(**wrong)  # type: ignore[arg-type]
