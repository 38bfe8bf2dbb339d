"""Stage 0: the vision encoder learns features for navigation from rendered images with the simulator's labels.

Linear heads on its tokens predict class, distance, colour and heading of each cell's content, the free distance in each
direction and the area that it leads into. The heads are discarded; later stages keep the encoder frozen.

Batches and augmentation are functions of seed, epoch and image number. An interrupted run resumes exactly, and the
number of ranks does not change the batches.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict
from math import isqrt
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from edge.state.frame import fit_frame
from export.model.network import TicVla
from tools.train.config.encoder import EncoderConfig
from tools.train.config.recipe import Recipe
from tools.train.encoder.data import FrameSet, Shard, fill, frames_sha256, plan
from tools.train.encoder.heads import Balance, EncoderHeads, as_tensors, losses, total
from tools.train.encoder.labels import COLUMNS, PIXELS, mirrored_label
from tools.train.encoder.score import Fixed, Score, decide
from tools.train.run import checkpoint
from tools.train.run.distributed import BatchOrder
from tools.train.run.job import StageJob
from tools.train.run.network_file import finish_network, start_network
from tools.train.run.optim import Optimiser, autocast
from tools.train.samples.augment import augmented
from tools.train.samples.tokens import encoder_sha256

STAGE: Final = "encoder"
_HEADS, _AUGMENT, _LOOK = 0xE0C2, 0xE0C3, 0xE0C4


class EncoderError(ValueError):
    """An unsuitable network, unusable images, or a checkpoint of another run; one line."""


def budget(recipe: Recipe) -> list[tuple[str, int, str]]:
    """Return (description, number of samples, key of the throughput) of this stage's work."""
    if recipe.encoder is None:
        return []
    frames = recipe.encoder.frames
    rendered = frames.count + frames.held if frames.count else 0
    return [
        ("pictures with labels", rendered, "render"),
        ("pictures learned from", frames.count * recipe.encoder.epochs, "encoder"),
    ]


def run(job: StageJob) -> dict[str, Any]:
    """Render, train, evaluate, and write the network with its new encoder.

    Raises EncoderError, FramesError, OSError.
    """
    config = _config(job)
    network = start_network(job, STAGE)
    result: dict[str, Any] = {"steps": 0}
    if config.frames.count:
        result = _train(job, config, network)
    else:
        job.progress.say("frames.count is 0: the encoder is not trained")
    if job.ranks.first:
        finish_network(job, STAGE, network)
    job.ranks.barrier()
    return {**result, "encoder_sha256": encoder_sha256(network.vision)}


def _train(job: StageJob, config: EncoderConfig, network: TicVla) -> dict[str, Any]:
    side = token_side(network)
    shards = plan(config.frames, job.seed, side)
    folder = job.run_dir.stage(STAGE) / "frames"
    _render(job, config, folder, shards)
    data = FrameSet(folder, [shard for shard in shards if not shard.held])
    held = FrameSet(folder, [shard for shard in shards if shard.held])
    balance = Balance.of(data.labels)
    network.to(job.device)
    heads = EncoderHeads(network.config.vision.token_dim, side)
    heads.initialise(job.generator(_HEADS))
    heads.to(job.device)
    trainer = _Trainer(job, config, network, heads, balance, frames_sha256(folder, shards))
    numbers = trainer.train(data, held)
    result: dict[str, Any] = {"pictures": len(data), "frames_sha256": trainer.frames, **numbers}
    if job.ranks.first and len(held):
        loss, score = trainer.evaluate(held, range(len(held)))
        fixed = Score()
        fixed.add(Fixed(data.labels).of(len(held)), held.labels)
        result |= {"held_loss": loss, "held_out": score.result(), "fixed_answer": fixed.result()}
    network.cpu()
    return result


def token_side(network: TicVla) -> int:
    """Return the number of tokens along one side of an image. Raises EncoderError if labels cannot be made for it."""
    side = isqrt(network.config.vision.tokens)
    if PIXELS % side or COLUMNS % side:
        raise EncoderError(f"the encoder has {side} x {side} tokens; expected 1, 2, 4, 8, 16 or 32 tokens a side")
    return side


def _render(job: StageJob, config: EncoderConfig, folder: Path, shards: Sequence[Shard]) -> None:
    """Render missing images in the first rank; the others wait."""
    with job.ranks.by_first() as here:
        if here:
            fill(folder, shards, config.frames.jobs, job.progress, lambda: job.stop.asked)


class _Trainer:
    """Trains encoder and heads."""

    def __init__(
        self, job: StageJob, config: EncoderConfig, network: TicVla, heads: EncoderHeads, balance: Balance, frames: str
    ) -> None:
        self._job, self._config, self._balance = job, config, balance
        self._vision, self._heads = network.vision, heads
        self._px = network.config.vision.image_px
        self.frames = frames
        """Hash of the images."""
        self._parameters = [*self._vision.parameters(), *heads.parameters()]
        self._path = job.run_dir.stage(STAGE) / "checkpoint.safetensors"
        numbers = asdict(config)
        del numbers["frames"]["jobs"]
        made_with = {"config": numbers, "frames": frames, "vision": asdict(network.config.vision), "seed": job.seed}
        self._key = hashlib.sha256(json.dumps(made_with, sort_keys=True).encode()).hexdigest()

    def train(self, data: FrameSet, held: FrameSet) -> dict[str, Any]:
        """Run all remaining steps and return the last loss."""
        job, config = self._job, self._config
        order = BatchOrder(len(data), config.batch, config.epochs, job.seed)
        job.ranks.copy_parameters(self._parameters)
        optimiser = Optimiser(self._parameters, config.optim, order.steps, job.ranks)
        loss, held_loss = self._load(optimiser)
        look = np.sort(job.rng(_LOOK).permutation(len(held))[: config.look_frames])
        with _Batches(job, data, order, config, self._px) as batches:
            while optimiser.step_count < order.steps:
                lr = optimiser.lr
                loss = self._step(optimiser, *batches.at(optimiser.step_count))
                step = optimiser.step_count
                if job.ranks.first:
                    job.run_dir.log(STAGE, step, loss=loss, lr=lr)
                if (step % config.look_steps == 0 or step == order.steps) and len(look) and job.ranks.first:
                    held_loss, score = self.evaluate(held, look)
                    job.run_dir.log(STAGE, step, held_loss=held_loss, **_watched(score))
                job.progress.update(step, order.steps, loss=loss, held_loss=held_loss)
                if job.should_stop():
                    self._save(optimiser, loss, held_loss)
                    raise KeyboardInterrupt
                if step % config.checkpoint_steps == 0 or step == order.steps:
                    self._save(optimiser, loss, held_loss)
        return {"steps": order.steps, "loss": loss}

    @torch.no_grad()
    def evaluate(self, frames: FrameSet, which: Sequence[int] | NDArray[np.int64]) -> tuple[float, Score]:
        """Compute loss and score of some images without augmentation, in float32."""
        chosen, cost, score = np.asarray(which, np.int64), 0.0, Score()
        for start in range(0, len(chosen), self._config.batch):
            part = chosen[start : start + self._config.batch]
            labels = {name: array[part] for name, array in frames.labels.items()}
            pictures = np.concatenate([fit_frame(frames.picture(int(i)), self._px) for i in part])
            predicted = self._heads(self._vision(torch.from_numpy(pictures).to(self._job.device)))
            cost += float(total(losses(predicted, as_tensors(labels, self._job.device), self._balance)).sum())
            score.add(decide(predicted), labels)
        return cost / max(len(chosen), 1), score

    def _step(self, optimiser: Optimiser, pictures: NDArray[np.uint8], labels: Mapping[str, Any]) -> float:
        """Update once with this rank's share of a batch and return the mean loss over all ranks."""
        job, count, value = self._job, len(pictures), 0.0
        if count:
            with autocast(job.device, self._config.optim.bf16):
                predicted = self._heads(self._vision(torch.from_numpy(pictures).to(job.device)))
            loss = total(losses(predicted, as_tensors(labels, job.device), self._balance)).mean()
            loss.backward()
            value = float(loss.detach())
        optimiser.step(count)
        return job.ranks.mean(value, count)

    def _save(self, optimiser: Optimiser, loss: float, held_loss: float) -> None:
        if self._job.ranks.first:
            weights = {
                **checkpoint.with_prefix("vision", self._vision.state_dict()),
                **checkpoint.with_prefix("heads", self._heads.state_dict()),
            }
            meta = {"key": self._key, "step": optimiser.step_count, "loss": loss, "held_loss": held_loss}
            checkpoint.save(self._path, {**weights, **optimiser.tensors()}, meta)

    def _load(self, optimiser: Optimiser) -> tuple[float, float]:
        """Resume if requested and possible; return the last training and held-out losses. Raises EncoderError."""
        job = self._job
        if not (job.resume and self._path.exists()):
            if job.ranks.first:
                job.run_dir.rewind(STAGE, -1)
            return float("nan"), float("nan")
        tensors, meta = checkpoint.load(self._path)
        if meta["key"] != self._key:
            raise EncoderError(f"{self._path}: checkpoint of other images or another recipe; delete it to start again")
        self._vision.load_state_dict(checkpoint.under("vision", tensors))
        self._heads.load_state_dict(checkpoint.under("heads", tensors))
        optimiser.restore(tensors)
        if job.ranks.first:
            job.run_dir.rewind(STAGE, int(meta["step"]))
        return float(meta["loss"]), float(meta["held_loss"])


class _Batches:
    """This rank's shares of the batches; the next one is prepared while the network trains."""

    def __init__(self, job: StageJob, data: FrameSet, order: BatchOrder, config: EncoderConfig, px: int) -> None:
        self._job, self._data, self._order, self._px = job, data, order, px
        self._augment, self._mirrored = config.augment, config.mirrored
        self._pool = ThreadPoolExecutor(1)
        self._ahead: tuple[int, Future[tuple[NDArray[np.uint8], Mapping[str, Any]]]] | None = None

    def __enter__(self) -> _Batches:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def at(self, step: int) -> tuple[NDArray[np.uint8], Mapping[str, Any]]:
        """Return the images uint8 [n, px, px, 3] of a step and their labels, [n, ...] each."""
        ahead, self._ahead = self._ahead, None
        batch = ahead[1].result() if ahead is not None and ahead[0] == step else self._make(step)
        if step + 1 < self._order.steps:
            self._ahead = (step + 1, self._pool.submit(self._make, step + 1))
        return batch

    def _make(self, step: int) -> tuple[NDArray[np.uint8], Mapping[str, Any]]:
        own = self._job.ranks.share(self._order.indices(step))
        epoch = step // self._order.steps_per_epoch
        pictures = np.zeros((len(own), self._px, self._px, 3), np.uint8)
        labels = {name: array[own] for name, array in self._data.labels.items()}
        for row, index in enumerate(own.tolist()):
            rng = np.random.default_rng((self._job.seed, _AUGMENT, epoch, index))
            pictures[row] = fit_frame(augmented(self._data.picture(index), self._augment, rng), self._px)[0]
            if rng.uniform() < self._mirrored:
                pictures[row] = pictures[row, :, ::-1].copy()
                for name, array in labels.items():
                    array[row] = mirrored_label(name, array[row])
        return pictures, labels


def _watched(score: Score) -> dict[str, float]:
    """Select the scores that are plotted as curves."""
    names = ("landmark_bearing", "landmark_recall", "person_recall", "opening_recall", "free_relative_error")
    found = score.result()
    return {name: float(found[name]) for name in names if found[name] is not None}


def _config(job: StageJob) -> EncoderConfig:
    if job.recipe.encoder is None:
        raise EncoderError("the recipe has no table [encoder]")
    return job.recipe.encoder
