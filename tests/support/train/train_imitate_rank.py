"""Imitation at test size, also as one of two processes: `python -m tests.support.train.train_imitate_rank DRIVES
OUT`."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import torch

from edge.state.reasoning_text import format_waypoints
from export.model.config import TicVlaConfig
from export.model.network import TicVla, build
from tests.support.train.train_drives import VAL_LAYOUT, MadeUpTokens, made_up_drive, tiny_model, write_dataset
from tools.train.config.checks import OptimConfig
from tools.train.config.collect import TRACE_EVERY
from tools.train.config.imitate import ImitateConfig, ImitateEvalConfig, SampleConfig
from tools.train.config.recipe import Recipe
from tools.train.drives.drive import EXPERT, FUTURE_STEPS, Dataset, Drive
from tools.train.drives.futures import label_futures, relative
from tools.train.imitate.imitate import fit
from tools.train.imitate.trainable_policies import ActionExpertPolicy
from tools.train.run.distributed import leave, ranks_of_environment
from tools.train.run.job import StageJob
from tools.train.run.run_dir import RunDir
from tools.train.samples.kv_cache import CachedState

FRAMES = 130
CONFIG = ImitateConfig(
    samples=8 * 6,
    batch=8,
    optim=OptimConfig(lr=3e-3, warmup_steps=0),
    sample=SampleConfig(group=2),
    held_samples=12,
    held_steps=3,
    checkpoint_steps=2,
    evaluate=ImitateEvalConfig(samples=8, batch=8),
)
"""Six steps."""


def side_of(drive_id: str) -> float:
    """1: it turns left, -1: right."""
    return 1.0 if drive_id.startswith("left") else -1.0


def side_drive(drive_id: str, layout_seed: int = 100, *, start_mps: float = 0.0, **about: Any) -> Drive:
    """Speeds up to 0.6 m/s, goes straight for 6 s, then turns to its side by 0.5 rad/s for 3 s, then on."""
    k = np.arange(FRAMES)
    speed = np.minimum(start_mps + 0.06 * k, 0.6)
    turning = np.where((k > 60) & (k <= 90), 0.5 * side_of(drive_id), 0.0)
    heading = np.cumsum(turning) / 10
    step = np.stack([speed * np.cos(heading), speed * np.sin(heading)], axis=1) / 10
    step[0] = 0.0
    pose = np.column_stack([np.cumsum(step, axis=0), heading])
    future, steps = label_futures(
        pose, np.zeros((FRAMES, FUTURE_STEPS, 3)), np.full(FRAMES, EXPERT, np.uint8), goes_on=False
    )
    ahead = np.minimum(k[:, None] + (30, 60, 90), FRAMES - 1)
    plan = np.stack([relative(pose[i], pose[ahead[i]])[:, :2] for i in range(FRAMES)])
    goal = {"goal_xy": (float(pose[-1, 0]), float(pose[-1, 1]))}
    return dataclasses.replace(
        made_up_drive(drive_id, FRAMES, layout_seed=layout_seed, **{**goal, **about}),
        pose=pose,
        pose_odom=np.column_stack([1.01 * pose[:, :2] + (7.0, -3.0), pose[:, 2]]),
        state=np.stack([speed, np.zeros(FRAMES), turning], axis=1).astype(np.float32),
        future=future.astype(np.float32),
        future_steps=steps.astype(np.int16),
        plan_xy=plan.astype(np.float32),
    )


def side_dataset(folder: Path) -> Dataset:
    """Two drives to learn from, and two in a layout that is held out."""
    drives = [side_drive("left-a"), side_drive("right-a", 101)]
    drives += [side_drive("left-v", VAL_LAYOUT), side_drive("right-v", VAL_LAYOUT)]
    dataset = write_dataset(folder, drives)
    assert dataset.train == ("left-a", "right-a") and dataset.val == ("left-v", "right-v")
    return dataset


class SideStates:
    """States of 6 to 8 tokens a second: what they say is the side, in their first number; in the second, the frame."""

    draws = 1

    def __init__(self, dataset: Dataset, width: int = 32) -> None:
        self._drives = {drive.id: drive for drive in dataset.drives(pictures=False)}
        self._width = width

    def anchors(self, drive_id: str) -> tuple[int, ...]:
        """Every second."""
        return tuple(range(0, len(self._drives[drive_id]), TRACE_EVERY))

    def at(self, drive_id: str, k: int, draw: int = 0) -> CachedState:
        """Seeded by drive and frame, with a text of waypoints."""
        rng = np.random.default_rng((crc32(drive_id.encode()), k, draw))
        kv = 0.1 * rng.standard_normal((6 + k // TRACE_EVERY % 3, self._width))
        kv[:, 0], kv[:, 1] = 2 * side_of(drive_id), k / 100
        points = tuple((float(x), float(y)) for x, y in self._drives[drive_id].plan_xy[k])
        return CachedState(kv.astype(np.float16), 3, format_waypoints(points), own=False)


def imitate_job(
    out: Path, config: ImitateConfig = CONFIG, model: TicVlaConfig | None = None, **options: Any
) -> StageJob:
    """A job of this stage alone."""
    out.mkdir(parents=True, exist_ok=True)
    return StageJob(Recipe("test", 1, model or tiny_model(), imitate=config), RunDir(out), seed=5, **options)


def trained(dataset: Dataset, job: StageJob) -> tuple[TicVla, dict[str, Any]]:
    """The network after `fit`, and its result."""
    network = build(job.recipe.model, 1)
    policy = ActionExpertPolicy(network.action, job.recipe.imitate.loss)
    return network, fit(job, policy, dataset, MadeUpTokens(), SideStates(dataset), of="test")


def main() -> None:
    """One rank, told by the environment as torchrun does."""
    folder, out = map(Path, sys.argv[1:])
    torch.set_num_threads(1)
    with ranks_of_environment() as ranks:
        job = dataclasses.replace(imitate_job(out), ranks=ranks)
        trained(Dataset.open(folder), job)


if __name__ == "__main__":
    main()
    leave(0)
