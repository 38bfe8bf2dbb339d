"""Supervised fine-tuning at test size, also as one of two processes: `python -m tests.support.train.train_sft_rank
DRIVES OUT`."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

import torch

from export.model.network import TicVla, build
from tests.support.train.train_drives import MadeUpTokens, tiny_model
from tools.train.config.checks import OptimConfig
from tools.train.config.recipe import Recipe
from tools.train.config.sft import DrawConfig, EvalConfig, SftConfig
from tools.train.drives.drive import Dataset
from tools.train.run.distributed import leave, ranks_of_environment
from tools.train.run.job import StageJob
from tools.train.run.run_dir import RunDir
from tools.train.samples.mirror import Views
from tools.train.sft.sft import fit

CONFIG = SftConfig(
    epochs=2,
    batch=8,
    words=DrawConfig(waypoints_only=0.3),
    optim=OptimConfig(lr=3e-3, warmup_steps=0),
    held_anchors=5,
    deciding=1,
    checkpoint_steps=2,
    evaluate=EvalConfig(anchors=0, epoch_anchors=0, drives=0),
)
"""20 anchors to learn from: three steps an epoch."""


def sft_job(out: Path, config: SftConfig = CONFIG, **options: Any) -> StageJob:
    """A job of this stage alone."""
    out.mkdir(parents=True, exist_ok=True)
    return StageJob(Recipe("test", 1, tiny_model(), sft=config), RunDir(out), seed=5, **options)


def trained(dataset: Dataset, job: StageJob) -> tuple[TicVla, dict[str, Any]]:
    """The network after `fit`, and its result."""
    network = build(tiny_model(), 1)
    return network, fit(job, network, dataset, Views(MadeUpTokens(), MadeUpTokens(10)))


def main() -> None:
    """One rank, told by the environment as torchrun does."""
    folder, out = map(Path, sys.argv[1:])
    torch.set_num_threads(1)
    with ranks_of_environment() as ranks:
        job = dataclasses.replace(sft_job(out), ranks=ranks)
        trained(Dataset.open(folder), job)


if __name__ == "__main__":
    main()
    leave(0)
