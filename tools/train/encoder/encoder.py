"""Stage 0: the vision encoder learns features for navigation from rendered images with the simulator's labels.

Linear heads on its tokens predict class, distance, colour and heading of each cell's content, the free distance in each
direction and the area that it leads into. The heads are discarded; later stages keep the encoder frozen.

Batches and augmentation are functions of seed, epoch and image number. An interrupted run resumes exactly, and the
number of ranks does not change the batches.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import isqrt
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edge.state.frame import fit_frame
from export.model.network import TicVla
from export.model.vision import TORCH_ATTENTION
from tools.train.config.checks import TrainError
from tools.train.config.encoder import EncoderConfig
from tools.train.encoder.data import FrameSet, fill, frames_sha256, plan
from tools.train.encoder.heads import Balance, EncoderHeads, Fixed, Score, as_tensors, decide, losses, total
from tools.train.encoder.labels import COLUMNS, PIXELS, mirrored_label
from tools.train.run.distributed import BatchOrder, autocast
from tools.train.run.job import StageJob
from tools.train.run.loop import Ahead, Optimiser, TrainingLoop
from tools.train.run.network_file import finish_network, start_network
from tools.train.samples.augment import augmented
from tools.train.samples.language_batch import PLAIN_TOKENS
from tools.train.samples.tokens import encoder_sha256

STAGE: Final = "encoder"
_HEADS, _AUGMENT, _LOOK = 0xE0C2, 0xE0C3, 0xE0C4


def run(job: StageJob) -> dict[str, Any]:
    """Render, train, evaluate, and write the network with its new encoder. Raises TrainError, OSError."""
    config = job.recipe.encoder
    network = start_network(job, STAGE)
    result: dict[str, Any] = {"steps": 0}
    if config.frames.count:
        result = _train(job, config, network)
    else:
        job.progress.log("frames.count is 0: the encoder is not trained")
    if job.ranks.first:
        finish_network(job, STAGE, network)
    job.ranks.barrier()
    return {**result, "encoder_sha256": encoder_sha256(network.vision)}


def _train(job: StageJob, config: EncoderConfig, network: TicVla) -> dict[str, Any]:
    side = token_side(network)
    shards = plan(config.frames, job.seed, side)
    folder = job.run_dir.stage(STAGE) / "frames"
    with job.ranks.by_first() as here:
        if here:
            fill(folder, shards, config.frames.jobs, job.progress, lambda: job.stop.requested)
    data = FrameSet(folder, [shard for shard in shards if not shard.held])
    held = FrameSet(folder, [shard for shard in shards if shard.held])
    network.to(job.device)
    heads = EncoderHeads(network.config.vision.token_dim, side)
    heads.initialise(job.generator(_HEADS))
    trainer = _Trainer(job, config, network, heads.to(job.device), Balance.of(data.labels))
    frames = frames_sha256(folder, shards)
    result: dict[str, Any] = {"pictures": len(data), "frames_sha256": frames, **trainer.train(data, held, frames)}
    if job.ranks.first and len(held):
        loss, score = trainer.evaluate(held, range(len(held)))
        fixed = Score()
        fixed.add(Fixed(data.labels).of(len(held)), held.labels)
        result |= {"held_loss": loss, "held_out": score.result(), "fixed_answer": fixed.result()}
    network.cpu()
    return result


def token_side(network: TicVla) -> int:
    """Return the number of tokens along one side of an image. Raises TrainError if labels cannot be made for it."""
    side = isqrt(network.config.vision.tokens)
    if PIXELS % side or COLUMNS % side:
        raise TrainError(f"the encoder has {side} x {side} tokens; expected 1, 2, 4, 8, 16 or 32 tokens a side")
    return side


def plain_attention(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """Compute attention [n, heads, t, d], with plain products for few tokens.

    For nano's 65 tokens on a CPU, these take a fifth of the time of torch's attention, with gradients. The rounding
    error of bfloat16 gradients is 0.8 instead of 0.3 %.
    """
    if q.shape[-2] > PLAIN_TOKENS:
        return TORCH_ATTENTION(q, k, v)
    weights: Tensor = ((q * q.shape[-1] ** -0.5) @ k.transpose(-1, -2)).softmax(-1)
    return weights.to(v.dtype) @ v


@dataclass(frozen=True)
class _Batch:
    """Images uint8 [n, px, px, 3] and their labels, [n, ...] each."""

    pictures: NDArray[np.uint8]
    labels: Mapping[str, NDArray[Any]]

    def __len__(self) -> int:
        return len(self.pictures)


class _Trainer:
    """Trains encoder and heads."""

    def __init__(
        self, job: StageJob, config: EncoderConfig, network: TicVla, heads: EncoderHeads, balance: Balance
    ) -> None:
        self._job, self._config, self._balance = job, config, balance
        self._network, self._heads = network, heads
        self._px = network.config.vision.image_px

    def train(self, data: FrameSet, held: FrameSet, frames: str) -> dict[str, Any]:
        """Run all remaining steps and return the last losses. `frames`: hash of the images."""
        job, config, vision = self._job, self._config, self._network.vision
        order = BatchOrder(len(data), config.batch, config.epochs, job.seed)
        parameters = [*vision.parameters(), *self._heads.parameters()]
        job.ranks.copy_parameters(parameters)
        optimiser = Optimiser(parameters, config.optim, order.steps, job.ranks)
        numbers = asdict(config)
        del numbers["frames"]["jobs"]
        sizes = asdict(self._network.config.vision)
        content = {"config": numbers, "frames": frames, "vision": sizes, "seed": job.seed}
        modules = {"vision": vision, "heads": self._heads}
        loop = TrainingLoop(job, STAGE, modules, optimiser, content, config.checkpoint_steps)
        look = np.sort(job.rng(_LOOK).permutation(len(held))[: config.look_frames])

        def evaluate(step: int) -> dict[str, float]:
            due = step % config.look_steps == 0 or step == order.steps
            if not (due and len(look) and job.ranks.first):
                return {}
            held_loss, score = self.evaluate(held, look)
            return {"held_loss": held_loss, **_watched(score)}

        with Ahead(lambda step: self._batch(data, order, step)) as ahead:
            last = loop.run(ahead.steps(optimiser.step_count, order.steps), self._losses, evaluate)
        return {"steps": order.steps, **last}

    @torch.no_grad()
    def evaluate(self, frames: FrameSet, which: Sequence[int] | NDArray[np.int64]) -> tuple[float, Score]:
        """Compute loss and score of some images without augmentation, in float32."""
        chosen, cost, score = np.asarray(which, np.int64), 0.0, Score()
        for start in range(0, len(chosen), self._config.batch):
            part = chosen[start : start + self._config.batch]
            labels = {name: array[part] for name, array in frames.labels.items()}
            pictures = np.concatenate([fit_frame(frames.picture(int(i)), self._px) for i in part])
            predicted = self._heads(self._network.vision(torch.from_numpy(pictures).to(self._job.device)))
            cost += float(total(losses(predicted, as_tensors(labels, self._job.device), self._balance)).sum())
            score.add(decide(predicted), labels)
        return cost / max(len(chosen), 1), score

    def _losses(self, batch: _Batch) -> Tensor:
        device = self._job.device
        attention = plain_attention if device == "cpu" else TORCH_ATTENTION
        with autocast(device, self._config.optim.bf16):
            predicted = self._heads(self._network.vision(torch.from_numpy(batch.pictures).to(device), attention))
        return total(losses(predicted, as_tensors(batch.labels, device), self._balance))

    def _batch(self, data: FrameSet, order: BatchOrder, step: int) -> _Batch:
        """Read and augment this rank's share of a step's images."""
        own = self._job.ranks.share(order.indices(step))
        epoch = step // order.steps_per_epoch
        pictures = np.zeros((len(own), self._px, self._px, 3), np.uint8)
        labels = {name: array[own] for name, array in data.labels.items()}
        for row, index in enumerate(own.tolist()):
            rng = np.random.default_rng((self._job.seed, _AUGMENT, epoch, index))
            pictures[row] = fit_frame(augmented(data.picture(index), self._config.augment, rng), self._px)[0]
            if rng.uniform() < self._config.mirrored:
                pictures[row] = pictures[row, :, ::-1].copy()
                for name, array in labels.items():
                    array[row] = mirrored_label(name, array[row])
        return _Batch(pictures, labels)


def _watched(score: Score) -> dict[str, float]:
    """Select the scores that are plotted as curves."""
    names = ("landmark_bearing", "landmark_recall", "person_recall", "opening_recall", "free_relative_error")
    found = score.result()
    return {name: float(found[name]) for name in names if found[name] is not None}
