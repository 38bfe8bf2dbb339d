"""The encoder's stage at test size, also as one of two processes: `python -m tests.support.train.train_encoder_rank
OUT`."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from safetensors.numpy import save_file

from tests.support.train.train_drives import tiny_model
from tools.train.config.checks import OptimConfig
from tools.train.config.encoder import AugmentConfig, EncoderConfig, FramesConfig
from tools.train.config.recipe import Recipe
from tools.train.encoder.data import Shard, finish, path_of, plan
from tools.train.encoder.encoder import run
from tools.train.encoder.labels import CLASSES, COLOUR_WORDS, COLUMNS, LANDMARK, NONE, PERSON, SOMEBODY, label_shapes
from tools.train.run.distributed import leave, ranks_of_environment
from tools.train.run.job import StageJob
from tools.train.run.run_dir import RunDir
from tools.train.samples.augment import encoded

SIDE = 2
"""Of the tiny network's tokens."""
CONFIG = EncoderConfig(
    frames=FramesConfig(count=40, held=16, per_scene=20, kinds=("office",)),
    epochs=2,
    batch=12,
    optim=OptimConfig(lr=3e-3, warmup_steps=0),
    augment=AugmentConfig(brightness=0.1, contrast=0.1, colour=0.02, jpeg_share=0.2),
    checkpoint_steps=2,
    look_steps=3,
    look_frames=6,
)
"""40 pictures to learn from: four steps an epoch, the last one smaller."""
_LOOKS = ((200, 200, 190), (40, 40, 160), (30, 140, 40))
_WALL, _MACHINE = CLASSES.index("wall"), CLASSES.index("vending_machine")
_KINDS = (_WALL, _MACHINE, PERSON)


def encoder_job(out: Path, config: EncoderConfig = CONFIG, **options: Any) -> StageJob:
    """A job of this stage alone, its pictures made up: four fields of three colours, each of a class and distance."""
    out.mkdir(parents=True, exist_ok=True)
    job = StageJob(Recipe("test", 1, tiny_model(), encoder=config), RunDir(out), seed=5, **options)
    folder = job.run_dir.stage("encoder") / "frames"
    folder.mkdir(exist_ok=True)
    for shard in plan(config.frames, job.seed, SIDE):
        if not path_of(folder, shard.name).exists():
            write_shard(folder, shard)
    return job


def write_shard(folder: Path, shard: Shard) -> None:
    """Pictures and labels of a made-up shard."""
    rng = np.random.default_rng(shard.seed)
    fields = rng.integers(0, 3, (shard.frames, SIDE, SIDE))
    near = np.where(fields == 0, 4.0, 1.0)
    labels = {name: np.zeros((shard.frames, *shape), kind) for name, (kind, shape) in label_shapes(SIDE).items()}
    labels["main"][:] = labels["thing"][:] = np.array(_KINDS)[fields]
    labels["rank"][:] = np.array((0, LANDMARK, SOMEBODY))[fields]
    labels["colour"][:] = np.where(fields == 1, COLOUR_WORDS.index("blue"), NONE)
    labels["facing"][:] = np.where(fields == 2, 4, NONE)
    labels["near_m"][:], labels["thing_m"][:] = near, near
    walled = (fields == 0).any(axis=1).repeat(COLUMNS // SIDE, axis=1)
    labels["free_m"][:] = np.where(walled, 2.0, 8.0)
    labels["open_kind"][:] = np.where(walled, 0, 1)
    labels["open_m"][:] = 3.0
    labels["place"][:] = 2
    jpegs = []
    for one in fields:
        picture = np.array(_LOOKS, np.uint8)[one]
        jpegs.append(encoded(cv2.resize(picture, (128, 128), interpolation=cv2.INTER_NEAREST), 95))
    ends = np.cumsum([len(jpeg) for jpeg in jpegs]).astype(np.int64)
    save_file({"jpeg": np.concatenate(jpegs), "jpeg_end": ends, **labels}, path_of(folder, shard.name))
    finish(folder, shard)


def main() -> None:
    """One rank, told by the environment as torchrun does."""
    torch.set_num_threads(1)
    with ranks_of_environment() as ranks:
        run(dataclasses.replace(encoder_job(Path(sys.argv[1])), ranks=ranks))


if __name__ == "__main__":
    main()
    leave(0)
