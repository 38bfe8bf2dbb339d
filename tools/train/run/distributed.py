"""Distributed training under torchrun: each rank's share of a global batch, and gradients weighted by its size.

A stage that draws batches from `BatchOrder` and averages through `Ranks` has the same losses with any number of
processes: samples are ordered by one global permutation, and means are taken over the whole batch.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from datetime import timedelta
from functools import cache
from typing import Any, Final, NoReturn

import numpy as np
import torch
import torch.distributed as dist
from numpy.typing import NDArray

_PATIENCE: Final = timedelta(days=7)
"""Timeout of collective operations: the first rank may record drives for hours. torchrun ends all ranks if one dies."""


class EndedEarlyError(RuntimeError):
    """The first rank failed while the others waited; its own message says why."""


@dataclass(frozen=True)
class Ranks:
    """This process's `rank` among `world` processes; a single process communicates with no other."""

    rank: int = 0
    world: int = 1

    @property
    def first(self) -> bool:
        """Whether this process writes files, logs and plots."""
        return self.rank == 0

    def share(self, batch: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return this rank's part of a global batch of indices: every `world`-th from `rank` on."""
        return batch[self.rank :: self.world]

    def average_gradients(self, parameters: Iterable[torch.nn.Parameter], weight: float = 1.0) -> float:
        """Replace the gradients of this rank's mean loss over `weight` samples by those of the whole batch's mean.

        Returns the sum of the weights of all ranks. A rank with an empty share takes part with weight 0.
        """
        parameters = list(parameters)
        if self.world == 1:
            return weight
        total = self.sum(weight)
        own = [each.grad if each.grad is not None else torch.zeros_like(each) for each in parameters]
        flat = torch.cat([each.reshape(-1).float() for each in own]) * (weight / max(total, 1e-12))
        dist.all_reduce(flat)
        start = 0
        for each in parameters:
            each.grad = flat[start : start + each.numel()].view_as(each).to(each.dtype)
            start += each.numel()
        return total

    def sum(self, value: float) -> float:
        """Return the sum of a value over the ranks."""
        if self.world == 1:
            return value
        whole = torch.tensor([value], dtype=torch.float64, device="cuda" if dist.get_backend() == "nccl" else "cpu")
        dist.all_reduce(whole)
        return float(whole.item())

    def mean(self, value: float, weight: float = 1.0) -> float:
        """Return the weighted mean of a value over the ranks."""
        if self.world == 1:
            return value
        return self.sum(value * weight) / max(self.sum(weight), 1e-12)

    def any(self, flag: bool) -> bool:
        """Return whether the flag is set on any rank."""
        return flag if self.world == 1 else self.sum(float(flag)) > 0

    def barrier(self) -> None:
        """Wait for all ranks."""
        if self.world > 1:
            dist.barrier()

    @contextmanager
    def by_first(self) -> Iterator[bool]:
        """Yield True on the first rank, which does the work; the others wait at the end of the block.

        Raises EndedEarlyError on the other ranks if the first rank's work raised an error.
        """
        if not self.first:
            yield False
            if self.any(False):
                raise EndedEarlyError("the first process has ended early")
            return
        try:
            yield True
        except BaseException:
            with suppress(RuntimeError):  # the others may have ended; the error raised here matters more
                self.any(True)
            raise
        self.any(False)

    def copy_parameters(self, parameters: Iterable[torch.Tensor]) -> None:
        """Copy the first rank's values to every rank."""
        if self.world > 1:
            for each in parameters:
                dist.broadcast(each.detach(), src=0)


SINGLE = Ranks()


@contextmanager
def ranks_of_environment(device: str = "cpu") -> Iterator[Ranks]:
    """Join the processes that torchrun started (gloo, or NCCL for cuda); yields SINGLE without torchrun."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if world == 1:
        yield SINGLE
        return
    options: dict[str, Any] = {"timeout": _PATIENCE}
    if device.startswith("cuda"):
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
        options["backend"] = "nccl"
    else:
        options["backend"] = "gloo"
    dist.init_process_group(**options)
    yield Ranks(dist.get_rank(), world)
    # Not after an error: NCCL would wait here for ranks that wait for this process.
    dist.destroy_process_group()


def leave(code: int) -> NoReturn:
    """End this process without Python's own shutdown.

    During shutdown, a gloo thread that still releases a tensor sometimes aborts the process ("terminate called without
    an active exception"); torchrun would then report a finished run as failed.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


@dataclass(frozen=True)
class BatchOrder:
    """Batches of `batch` sample indices over `epochs` seeded permutations of `count` samples; the last is smaller."""

    count: int
    batch: int
    epochs: int
    seed: int

    def __post_init__(self) -> None:
        if self.count < 1 or self.batch < 1 or self.epochs < 1:
            raise ValueError(f"expected samples, a batch and epochs, found {self.count}, {self.batch}, {self.epochs}")

    @property
    def steps_per_epoch(self) -> int:
        """Number of batches of one epoch."""
        return -(-self.count // self.batch)

    @property
    def steps(self) -> int:
        """Total number of batches."""
        return self.steps_per_epoch * self.epochs

    def indices(self, step: int) -> NDArray[np.int64]:
        """Return the sample indices, int64, of the global batch of `step`, which counts from 0."""
        epoch, within = divmod(step, self.steps_per_epoch)
        order = np.random.default_rng((self.seed, 0xBA7C, epoch)).permutation(self.count)
        return order[within * self.batch : (within + 1) * self.batch].astype(np.int64)


def autocast(device: str, bf16: bool) -> AbstractContextManager[object]:
    """Return a context for bfloat16 if `bf16` is set and the device supports it, else for float32."""
    kind = torch.device(device).type
    return torch.autocast(kind, dtype=torch.bfloat16) if bf16 and computes_bf16(kind) else nullcontext()


@cache
def computes_bf16(device: str) -> bool:
    """Return whether the device has bfloat16 instructions: emulation takes twelve times as long as float32."""
    if torch.device(device).type != "cpu":
        return True
    found = torch.cpu.get_capabilities()
    return any(found.get(name, False) for name in ("avx512_bf16", "amx_bf16", "bf16"))
