"""The training loop of imitation: reproducible batches, losses over all ranks, exact checkpoints."""

from __future__ import annotations

from typing import Final

import numpy as np
import torch

from tools.train.config.imitate import ImitateConfig
from tools.train.imitate.data import Samples
from tools.train.imitate.trainable_policies import TrainablePolicy
from tools.train.run import checkpoint
from tools.train.run.job import StageJob
from tools.train.run.optim import Optimiser, autocast
from tools.train.run.prefetch import Ahead
from tools.train.samples.action_batch import ActionBatch, Group, collate

_DRAWS, _HELD, _NOISE = 0x1A11, 0x1A12, 0x1A13
FILE: Final = "checkpoint.safetensors"


class ImitateError(ValueError):
    """Unusable data, or a checkpoint of another run; one line."""


class Training:
    """The training loop of one stage; a checkpoint can only be resumed with the same `key`."""

    def __init__(
        self,
        stage: str,
        job: StageJob,
        config: ImitateConfig,
        policy: TrainablePolicy,
        data: Samples,
        held: Samples | None,
        total: int,
        key: str,
    ) -> None:
        self._stage, self._job, self._config, self._policy = stage, job, config, policy
        self._data, self._held, self._total, self._key = data, held, total, key
        self._optimiser = Optimiser(policy.module.parameters(), config.optim, total, job.ranks)
        self._path = job.run_dir.stage(stage) / FILE
        self._device = torch.device(job.device)

    def run(self) -> dict[str, float]:
        """Run all remaining steps and return the last losses. Raises ImitateError, KeyboardInterrupt if interrupted."""
        job, config, optimiser = self._job, self._config, self._optimiser
        numbers = self._load()
        with Ahead(self._groups) as ahead:
            while optimiser.step_count < self._total:
                lr = optimiser.lr
                numbers["loss"] = self._learn(ahead.at(optimiser.step_count, self._total))
                step = optimiser.step_count
                line = {"loss": numbers["loss"], "lr": lr}
                if self._held is not None and (step % config.held_steps == 0 or step == self._total):
                    ahead.rest()
                    line["held_loss"] = numbers["held_loss"] = self._held_loss(self._held)
                if job.ranks.first:
                    job.run_dir.log(self._stage, step, **line)
                job.progress.update(step, self._total, **numbers)
                stopping = job.should_stop()
                if stopping or step % config.checkpoint_steps == 0 or step == self._total:
                    self._save(numbers)
                if stopping and step < self._total:
                    raise KeyboardInterrupt
        return numbers

    def _groups(self, step: int) -> list[Group]:
        """Draw this rank's share of a step's groups, each from its own generator."""
        count = self._config.batch // self._data.group
        own = range(count)[self._job.ranks.rank :: self._job.ranks.world]
        return [self._data.draw(np.random.default_rng((self._job.seed, _DRAWS, step, number))) for number in own]

    def _learn(self, groups: list[Group]) -> float:
        """Run one step and return the mean loss over all ranks."""
        value, weight = 0.0, float(len(groups))
        if groups:
            batch = collate(groups, self._device)
            loss = self._errors(batch, self._optimiser.step_count).mean()
            loss.backward()
            value = float(loss.detach())
        self._optimiser.step(weight)
        return self._job.ranks.mean(value, weight)

    def _errors(self, batch: ActionBatch, step: int) -> torch.Tensor:
        generator = self._job.generator(_NOISE, step, self._job.ranks.rank)
        with autocast(self._job.device, self._config.optim.bf16):
            return self._policy.errors(batch, generator)

    def _held_loss(self, held: Samples) -> float:
        """Compute the loss over the fixed held-out samples, distributed over the ranks."""
        ranks, seed = self._job.ranks, self._job.seed
        count = -(-self._config.held_samples // held.group)
        each = self._config.batch // held.group
        total, seen = 0.0, 0
        for start in range(ranks.rank * each, count, ranks.world * each):
            rngs = [np.random.default_rng((seed, _HELD, number)) for number in range(start, min(start + each, count))]
            batch = collate([held.draw(rng) for rng in rngs], self._device)
            with torch.no_grad():
                total += float(self._errors(batch, start).sum())
            seen += len(batch)
        whole = ranks.sum(seen)
        return ranks.sum(total) / whole if whole else float("nan")

    def _save(self, numbers: dict[str, float]) -> None:
        """Write the checkpoint, in the first rank alone: all ranks have equal weights."""
        if self._job.ranks.first:
            weights = checkpoint.with_prefix("pupil", self._policy.module.state_dict())
            meta = {"key": self._key, "step": self._optimiser.step_count, "numbers": numbers}
            checkpoint.save(self._path, {**weights, **self._optimiser.tensors()}, meta)

    def _load(self) -> dict[str, float]:
        """Resume if requested and possible; return the last losses. Raises ImitateError for another checkpoint."""
        step, numbers = -1, {}
        if self._job.resume and self._path.exists():
            tensors, meta = checkpoint.load(self._path)
            if meta["key"] != self._key:
                raise ImitateError(
                    f"{self._path}: checkpoint of other drives, states or another recipe; delete it to start again"
                )
            self._policy.module.load_state_dict(checkpoint.under("pupil", tensors))
            self._optimiser.restore(tensors)
            step, numbers = int(meta["step"]), dict(meta["numbers"])
        if self._job.ranks.first:
            self._job.run_dir.rewind(self._stage, step)
        return numbers
