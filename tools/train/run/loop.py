"""The training loop of a stage: exact checkpoints, evaluations in between, and batches that are prepared in advance."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sized
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Final, Generic, TypeVar

from torch import Tensor, nn

from tools.train.config.checks import TrainError
from tools.train.run import checkpoint
from tools.train.run.job import StageJob
from tools.train.run.optim import Optimiser

Made = TypeVar("Made")
Batch = TypeVar("Batch", bound=Sized)

DEPTH: Final = 2
"""Batches prepared in advance; more would only take memory, because a step computes longer than its batch takes."""


class TrainingLoop:
    """Trains `modules` (by their prefix in the checkpoint) in place.

    `content`: JSON values of everything that the result depends on; only a checkpoint with equal content is resumed.
    """

    def __init__(
        self, job: StageJob, stage: str, modules: Mapping[str, nn.Module], optimiser: Optimiser,
        content: Mapping[str, object], checkpoint_steps: int,
    ) -> None:  # fmt: skip
        """Resume from the stage's checkpoint if requested and possible. Raises TrainError for another run's."""
        self._job, self._stage, self._modules, self._optimiser = job, stage, modules, optimiser
        self._checkpoint_steps = checkpoint_steps
        self._key = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
        self._path = job.run_dir.stage(stage) / "checkpoint.safetensors"
        self._numbers: dict[str, float] = {}
        if job.resume and self._path.exists():
            self._load()
        if job.ranks.first:
            job.run_dir.rewind(stage, optimiser.step_count)
        job.ranks.barrier()

    def run(
        self,
        batches: Iterator[Batch],
        losses: Callable[[Batch], Tensor],
        evaluate: Callable[[int], Mapping[str, float]],
    ) -> dict[str, float]:
        """Run all remaining steps and return the last losses. Raises KeyboardInterrupt if interrupted.

        `batches`: this rank's share of each remaining step; `losses`: the loss of each sample [n] of a share that is
        not empty; `evaluate`: values to log after a step, by name, such as `held_loss`. Every rank calls them.
        """
        job, optimiser = self._job, self._optimiser
        for batch in batches:
            lr = optimiser.lr
            line = {"loss": self._learn(batch, losses), "lr": lr}
            step = optimiser.step_count
            line |= evaluate(step)
            self._numbers |= {name: line[name] for name in ("loss", "held_loss") if name in line}
            if job.ranks.first:
                job.run_dir.log(self._stage, step, **line)
            job.progress.update(step, optimiser.total_steps, **self._numbers)
            stopping = job.should_stop()
            if stopping or step % self._checkpoint_steps == 0 or step == optimiser.total_steps:
                self._save()
            if stopping:
                raise KeyboardInterrupt
        return dict(self._numbers)

    def _learn(self, batch: Batch, losses: Callable[[Batch], Tensor]) -> float:
        """Update once and return the mean loss over all ranks."""
        value, count = 0.0, len(batch)
        if count:
            loss = losses(batch).mean()
            loss.backward()
            value = float(loss.detach())
        self._optimiser.step(count)
        return self._job.ranks.mean(value, count)

    def _save(self) -> None:
        if self._job.ranks.first:  # all ranks have equal weights
            tensors = self._optimiser.tensors()
            for prefix, module in self._modules.items():
                tensors |= checkpoint.with_prefix(prefix, module.state_dict())
            meta = {"key": self._key, "step": self._optimiser.step_count, "numbers": self._numbers}
            checkpoint.save(self._path, tensors, meta)

    def _load(self) -> None:
        tensors, meta = checkpoint.load(self._path)
        if meta["key"] != self._key:
            raise TrainError(f"{self._path}: checkpoint of other data or another recipe; delete it to start again")
        for prefix, module in self._modules.items():
            module.load_state_dict(checkpoint.under(prefix, tensors))
        self._optimiser.restore(tensors)
        self._numbers = dict(meta.get("numbers", {}))


class Ahead(Generic[Made]):
    """Runs `make(step)` in advance for consecutive steps."""

    def __init__(self, make: Callable[[int], Made]) -> None:
        self._make = make
        self._pool = ThreadPoolExecutor(1, "prefetch")
        self._coming: dict[int, Future[Made]] = {}

    def steps(self, first: int, total: int) -> Iterator[Made]:
        """Yield the results of steps `first` to `total - 1`. Raises the errors of `make`."""
        for step in range(first, total):
            for number in range(step, min(step + 1 + DEPTH, total)):
                if number not in self._coming:
                    self._coming[number] = self._pool.submit(self._make, number)
            yield self._coming.pop(step).result()

    def rest(self) -> None:
        """Wait until no call of `make` is running, because its inputs are not thread-safe."""
        wait(self._coming.values())

    def __enter__(self) -> Ahead[Made]:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)
