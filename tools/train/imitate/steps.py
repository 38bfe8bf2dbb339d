"""The steps of imitation: batches that are a function of seed and step, losses over all ranks, exact checkpoints."""

from __future__ import annotations

from typing import Final

import numpy as np
import torch

from tools.train.config.imitate import ImitateConfig
from tools.train.imitate.data import Samples
from tools.train.imitate.trainable_policies import Pupil
from tools.train.run import checkpoint
from tools.train.run.job import StageJob
from tools.train.run.optim import Optimiser, autocast
from tools.train.run.prefetch import Ahead
from tools.train.samples.action_batch import ActionBatch, Group, collate

_DRAWS, _HELD, _NOISE = 0x1A11, 0x1A12, 0x1A13
FILE: Final = "checkpoint.safetensors"


class ImitateError(ValueError):
    """Data or a checkpoint that cannot be learned from; one line."""


class Training:
    """The steps of one run of a stage; `key`: what a checkpoint must have been made with to be gone on from."""

    def __init__(
        self,
        stage: str,
        job: StageJob,
        config: ImitateConfig,
        pupil: Pupil,
        data: Samples,
        held: Samples | None,
        total: int,
        key: str,
    ) -> None:
        self._stage, self._job, self._config, self._pupil = stage, job, config, pupil
        self._data, self._held, self._total, self._key = data, held, total, key
        self._optimiser = Optimiser(pupil.module.parameters(), config.optim, total, job.ranks)
        self._path = job.run_dir.stage(stage) / FILE
        self._device = torch.device(job.device)

    def run(self) -> dict[str, float]:
        """All steps that are left; the newest numbers. Raises ImitateError, and KeyboardInterrupt when told to end."""
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
                    line["held_loss"] = numbers["held_loss"] = self._look(self._held)
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
        """This rank's share of a step's groups, each drawn from a generator of its own."""
        count = self._config.batch // self._data.group
        own = range(count)[self._job.ranks.rank :: self._job.ranks.world]
        return [self._data.draw(np.random.default_rng((self._job.seed, _DRAWS, step, number))) for number in own]

    def _learn(self, groups: list[Group]) -> float:
        """One step; the mean loss over all ranks."""
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
            return self._pupil.errors(batch, generator)

    def _look(self, held: Samples) -> float:
        """The loss over held-out samples, always the same ones, shared by the ranks."""
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
        """Written by the first rank alone: all have the same."""
        if self._job.ranks.first:
            weights = checkpoint.with_prefix("pupil", self._pupil.module.state_dict())
            meta = {"key": self._key, "step": self._optimiser.step_count, "numbers": numbers}
            checkpoint.save(self._path, {**weights, **self._optimiser.tensors()}, meta)

    def _load(self) -> dict[str, float]:
        """Go on if asked to and able to; gives the last numbers. Raises ImitateError for another run's checkpoint."""
        step, numbers = -1, {}
        if self._job.resume and self._path.exists():
            tensors, meta = checkpoint.load(self._path)
            if meta["key"] != self._key:
                raise ImitateError(
                    f"{self._path}: of other drives, other states or another recipe; delete it to begin anew"
                )
            self._pupil.module.load_state_dict(checkpoint.under("pupil", tensors))
            self._optimiser.restore(tensors)
            step, numbers = int(meta["step"]), dict(meta["numbers"])
        if self._job.ranks.first:
            self._job.run_dir.rewind(self._stage, step)
        return numbers
