"""The training loop of a stage: checkpoints, the optimiser (paper Table 8), evaluations, batches prepared in advance.

A checkpoint is one safetensors file: tensors, and JSON in its header. Pickle is never used.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sized
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from export.core.tensor_file import replacing
from tools.train.config.checks import OptimConfig, TrainError
from tools.train.run.distributed import SINGLE, Ranks
from tools.train.run.job import StageJob

FORMAT: Final = "tic-vla-edge-checkpoint/1"
_KEYS: Final = ("format", "meta")


def save_checkpoint(path: Path, tensors: Mapping[str, torch.Tensor], meta: Mapping[str, object]) -> None:
    """Write tensors (any device, dtype kept) and JSON atomically. On OSError the old file remains."""
    # Clone, because safetensors refuses tensors that share memory, such as tied weights.
    whole = {name: tensor.detach().cpu().clone().contiguous() for name, tensor in tensors.items()}
    with replacing(path) as partial:
        save_file(whole, str(partial), metadata={"format": FORMAT, "meta": json.dumps(meta, sort_keys=True)})


def load_checkpoint(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Read the tensors, on the CPU, and the JSON of a checkpoint. Raises TrainError, FileNotFoundError."""
    if not path.is_file():
        raise FileNotFoundError(f"checkpoint {path}: not found")
    try:
        with safe_open(str(path), framework="pt") as file:
            header = file.metadata() or {}
            if header.get("format") != FORMAT:
                raise TrainError(f"checkpoint {path}: expected format {FORMAT}, found {header.get('format')}")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 — not a mapping
        return tensors, json.loads(header["meta"])
    except (SafetensorError, KeyError, ValueError) as error:
        raise TrainError(f"checkpoint {path}: damaged ({error}); delete it to start again") from error


def with_prefix(prefix: str, tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Rename tensors to `prefix.name`."""
    return {f"{prefix}.{name}": tensor for name, tensor in tensors.items()}


def under(prefix: str, tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return the tensors named `prefix.name` as `name`."""
    return {name[len(prefix) + 1 :]: tensor for name, tensor in tensors.items() if name.startswith(prefix + ".")}


def optimiser_tensors(optimiser: torch.optim.Optimizer) -> dict[str, torch.Tensor]:
    """Return an optimiser's moments and step counts as `INDEX.name`; its options come from the recipe."""
    state = optimiser.state_dict()["state"]
    return {
        f"{index}.{name}": value if isinstance(value, torch.Tensor) else torch.tensor(value)
        for index, values in state.items()
        for name, value in values.items()
    }


def restore_optimiser(optimiser: torch.optim.Optimizer, tensors: Mapping[str, torch.Tensor]) -> None:
    """Load what `optimiser_tensors` returned into an optimiser over the same parameters in the same order."""
    state: dict[int, dict[str, torch.Tensor]] = {}
    for key, tensor in tensors.items():
        index, _, name = key.partition(".")
        state.setdefault(int(index), {})[name] = tensor.clone()
    groups = optimiser.state_dict()["param_groups"]
    optimiser.load_state_dict({"state": state, "param_groups": groups})


class Optimiser:
    """AdamW over parameters for a known number of steps; `tensors` and `restore` resume it exactly."""

    def __init__(
        self, parameters: Iterable[torch.nn.Parameter], config: OptimConfig, total_steps: int, ranks: Ranks = SINGLE
    ) -> None:
        self.config = config
        self.total_steps = total_steps
        self.step_count = 0
        self._ranks = ranks
        self.parameters = [each for each in parameters if each.requires_grad]
        # No weight decay for gains and biases.
        decayed = [each for each in self.parameters if each.ndim >= 2]
        others = [each for each in self.parameters if each.ndim < 2]
        groups = [{"params": decayed, "weight_decay": config.weight_decay}, {"params": others, "weight_decay": 0.0}]
        self._adam = torch.optim.AdamW(
            [group for group in groups if group["params"]],
            lr=config.lr,
            betas=(config.beta1, config.beta2),
            fused=True,  # one pass over memory instead of one for each operation
        )

    @property
    def lr(self) -> float:
        """Learning rate of the next step."""
        return learning_rate(self.config, self.step_count, self.total_steps)

    def zero_grad(self) -> None:
        """Reset the gradients."""
        self._adam.zero_grad(set_to_none=True)

    def step(self, weight: float = 1.0) -> float:
        """Update once from the gradients of this rank's mean loss over `weight` samples; return the gradient norm.

        Gradients are averaged over ranks and clipped first; if the norm is not finite, the update is skipped.
        """
        self._ranks.average_gradients(self.parameters, weight)
        norm = float(torch.nn.utils.clip_grad_norm_(self.parameters, self.config.clip))
        for group in self._adam.param_groups:
            group["lr"] = self.lr
        if math.isfinite(norm):
            self._adam.step()
        self.step_count += 1
        self.zero_grad()
        return norm

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return the moments and the step for a checkpoint."""
        count = torch.tensor(self.step_count, dtype=torch.int64)
        return {**with_prefix("adam", optimiser_tensors(self._adam)), "step_count": count}

    def restore(self, tensors: Mapping[str, torch.Tensor]) -> None:
        """Resume from what `tensors` returned."""
        self.step_count = int(tensors["step_count"])
        restore_optimiser(self._adam, under("adam", tensors))


def learning_rate(config: OptimConfig, step: int, total_steps: int) -> float:
    """Return the rate at a step: linear warm-up for at most a tenth of the run, then a cosine to `final_lr_share`."""
    warmup = min(config.warmup_steps, total_steps // 10)
    if step < warmup:
        return config.lr * (step + 1) / warmup
    share = min((step - warmup) / max(total_steps - warmup, 1), 1.0)
    low = config.lr * config.final_lr_share
    return low + (config.lr - low) * (1 + math.cos(math.pi * share)) / 2


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
                tensors |= with_prefix(prefix, module.state_dict())
            meta = {"key": self._key, "step": self._optimiser.step_count, "numbers": self._numbers}
            save_checkpoint(self._path, tensors, meta)

    def _load(self) -> None:
        tensors, meta = load_checkpoint(self._path)
        if meta["key"] != self._key:
            raise TrainError(f"{self._path}: checkpoint of other data or another recipe; delete it to start again")
        for prefix, module in self._modules.items():
            module.load_state_dict(under(prefix, tensors))
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
