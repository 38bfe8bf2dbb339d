"""Supervised fine-tuning learns what is said, touches nothing but the language model, and is exact when ended."""

from __future__ import annotations

import dataclasses
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from export.model.network import build
from tests.train_drives import made_up_drive, small_dataset, tiny_model, write_dataset
from tests.train_sft_rank import CONFIG, sft_job, trained
from tools.train.drive import Dataset
from tools.train.job import QuietProgress, StopFlag
from tools.train.optim import OptimConfig
from tools.train.sft import SftConfig, SftError, run

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module", autouse=True)
def as_on_the_command_line() -> Iterator[None]:
    """`edge-train` asks torch for deterministic algorithms: one that is not would raise. Tiny layers: one thread."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return small_dataset(tmp_path_factory.mktemp("collect"))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, dataset: Dataset) -> tuple[Any, list[dict[str, Any]]]:
    """Weights and log of a run that nobody ended."""
    job = sft_job(tmp_path_factory.mktemp("whole"))
    network, _ = trained(dataset, job)
    return network.state_dict(), list(job.run_dir.lines())


def test_the_loss_falls_on_what_is_learned_and_on_what_is_held_out(tmp_path: Path, dataset: Dataset) -> None:
    job = sft_job(tmp_path, dataclasses.replace(CONFIG, epochs=12, optim=OptimConfig(lr=1e-2, warmup_steps=0)))
    _, result = trained(dataset, job)
    lines = list(job.run_dir.lines())
    held = [line["held_loss"] for line in lines if "held_loss" in line]
    assert result["steps"] == len(lines) == 36 and result["held_anchors"] == 7 and len(held) == 12
    assert lines[0]["loss"] > 6.5
    assert result["loss"] < 0.5 * lines[0]["loss"]
    assert held[-1] < 0.7 * held[0]


def test_the_merge_layer_learns_and_all_but_the_language_model_stays(
    whole: tuple[Any, list[dict[str, Any]]],
) -> None:
    before = build(tiny_model(), 1).state_dict()
    moved = {name for name, tensor in whole[0].items() if not torch.equal(tensor, before[name])}
    assert {name.split(".")[0] for name in moved} == {"language"}
    assert {"language.merge.1.weight", "language.embed.weight", "language.lm_head.weight"} <= moved


class StopAfter(QuietProgress):
    """Asks to end after so many steps."""

    def __init__(self, steps: int) -> None:
        self.flag = StopFlag()
        self._steps = steps

    def update(self, done: int, total: int, **numbers: float) -> None:
        if done == self._steps:
            self.flag.ask()


@pytest.mark.parametrize("steps", [1, 3, 5])
def test_a_run_that_was_ended_goes_on_as_if_it_had_not_been(
    tmp_path: Path, dataset: Dataset, whole: tuple[Any, list[dict[str, Any]]], steps: int
) -> None:
    stopping = StopAfter(steps)
    with pytest.raises(KeyboardInterrupt):
        trained(dataset, sft_job(tmp_path, progress=stopping, stop=stopping.flag))
    job = sft_job(tmp_path, resume=True)
    assert [line["step"] for line in job.run_dir.lines()] == list(range(1, steps + 1))
    network, _ = trained(dataset, job)
    assert list(job.run_dir.lines()) == whole[1]
    for name, tensor in network.state_dict().items():
        assert torch.equal(tensor, whole[0][name]), name


def test_a_run_that_was_killed_goes_on_from_its_last_checkpoint(
    tmp_path: Path, dataset: Dataset, whole: tuple[Any, list[dict[str, Any]]]
) -> None:
    class Killed(QuietProgress):
        def update(self, done: int, total: int, **numbers: float) -> None:
            if done == 5:
                raise OSError

    with pytest.raises(OSError):
        trained(dataset, sft_job(tmp_path, progress=Killed()))
    job = sft_job(tmp_path, resume=True)
    assert len(list(job.run_dir.lines())) == 5
    trained(dataset, job)
    assert list(job.run_dir.lines()) == whole[1]


def test_a_finished_run_is_not_trained_again(tmp_path: Path, dataset: Dataset) -> None:
    one = dataclasses.replace(CONFIG, epochs=1)
    first, result = trained(dataset, sft_job(tmp_path, one))
    again, same = trained(dataset, sft_job(tmp_path, one, resume=True))
    assert result == same
    assert all(torch.equal(tensor, again.state_dict()[name]) for name, tensor in first.state_dict().items())


def test_a_checkpoint_of_another_recipe_is_refused(tmp_path: Path, dataset: Dataset) -> None:
    one = dataclasses.replace(CONFIG, epochs=1)
    trained(dataset, sft_job(tmp_path, one))
    with pytest.raises(SftError, match="another recipe"):
        trained(dataset, sft_job(tmp_path, dataclasses.replace(one, batch=7), resume=True))


def test_bfloat16_gives_about_the_same_losses(
    tmp_path: Path, dataset: Dataset, whole: tuple[Any, list[dict[str, Any]]]
) -> None:
    half = dataclasses.replace(CONFIG, optim=dataclasses.replace(CONFIG.optim, bf16=True))
    job = sft_job(tmp_path, half)
    trained(dataset, job)
    losses = [line["loss"] for line in job.run_dir.lines()]
    assert losses == pytest.approx([line["loss"] for line in whole[1]], rel=0.02)
    assert losses != [line["loss"] for line in whole[1]]


def test_two_processes_have_the_loss_curve_of_one(
    tmp_path: Path, dataset: Dataset, whole: tuple[Any, list[dict[str, Any]]]
) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    fixed = {
        "WORLD_SIZE": "2",
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
        "OMP_NUM_THREADS": "1",
        "GLOO_SOCKET_IFNAME": "lo",
    }
    command = [sys.executable, "-m", "tests.train_sft_rank", str(dataset.folder), str(tmp_path)]
    ranks = [
        subprocess.Popen(command, cwd=ROOT, env={**os.environ, **fixed, "RANK": str(rank), "LOCAL_RANK": str(rank)})
        for rank in range(2)
    ]
    try:
        assert [rank.wait(timeout=240) for rank in ranks] == [0, 0]
    finally:
        for rank in ranks:
            rank.kill()
    lines = list(sft_job(tmp_path).run_dir.lines())
    assert [line["step"] for line in lines] == [line["step"] for line in whole[1]]
    for key in ("loss", "held_loss"):
        expected = [line[key] for line in whole[1] if key in line]
        assert [line[key] for line in lines if key in line] == pytest.approx(expected, rel=1e-3)


def test_drives_without_traces_cannot_be_learned_from(tmp_path: Path) -> None:
    silent = write_dataset(tmp_path / "collect", [made_up_drive("a", 20, traces=())])
    with pytest.raises(SftError, match="no anchors"):
        trained(silent, sft_job(tmp_path))


def test_the_stage_reads_the_runs_drives_and_leaves_the_runs_network(tmp_path: Path) -> None:
    small_dataset(tmp_path / "collect")
    few = dataclasses.replace(CONFIG.evaluate, anchors=2, epoch_anchors=1, drives=1, max_new_tokens=3)
    job = sft_job(tmp_path, dataclasses.replace(CONFIG, epochs=1, evaluate=few))
    result = run(job)
    assert result["steps"] == 3 and np.isfinite(result["held_loss"])
    assert result["held_out"]["taught"]["answers"] == 2 and result["held_out"]["own"]["answers"] == 4
    assert [line["progress_share"] for line in job.run_dir.lines() if "progress_share" in line] == [0.0]
    assert (tmp_path / "sft" / "model.safetensors").read_bytes() == job.run_dir.model_path.read_bytes()


def test_the_recipes_numbers_are_checked() -> None:
    with pytest.raises(ValueError, match="from 1 on"):
        SftConfig(batch=0)
