"""The encoder learns to see, nothing else is changed, and a run that was ended goes on exactly."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from export.model.network import build
from export.model.vision import TORCH_ATTENTION
from tests.support.train.train_drives import tiny_model
from tests.support.train.train_encoder_rank import CONFIG, encoder_job
from tests.support.train.train_stage_contract import Run, StageContract
from tools.train.config.checks import OptimConfig, TrainError
from tools.train.config.encoder import EncoderConfig, FramesConfig
from tools.train.encoder.encoder import plain_attention, run
from tools.train.samples.tokens import encoder_sha256

STEPS = 8


def trained(out: Path, **options: Any) -> Run:
    """Weights, log and result of a run."""
    job = encoder_job(out, **options)
    result = run(job)
    return Run(load_file(job.run_dir.model_path), list(job.run_dir.lines()), result)


pytestmark = [pytest.mark.usefixtures("one_thread"), pytest.mark.slow]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run that nobody ended."""
    return trained(tmp_path_factory.mktemp("whole"))


def test_it_learns_more_than_a_fixed_answer(tmp_path: Path) -> None:
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


class TestStage(StageContract):
    rank = "tests.support.train.train_encoder_rank"
    other = dataclasses.replace(CONFIG, batch=7)

    def prepare(self, out: Path) -> list[str]:
        encoder_job(out)  # two processes would write the same pictures at once
        return []

    def train(self, out: Path, config: EncoderConfig | None = None, **options: Any) -> Run:
        return trained(out, config=config or CONFIG, **options)


def test_tokens_and_gradients_are_those_of_torchs_own_attention() -> None:
    vision = build(tiny_model(), 1).vision
    px = vision.config.image_px
    pictures = torch.randint(0, 256, (3, px, px, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(1))
    found: list[list[torch.Tensor]] = []
    for attention in (plain_attention, TORCH_ATTENTION):
        vision.zero_grad()
        tokens = vision(pictures, attention)
        tokens.square().mean().backward()
        found.append([tokens.detach(), *(weight.grad.clone() for weight in vision.parameters())])
    torch.testing.assert_close(found[0], found[1], atol=1e-5, rtol=1e-3)


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
