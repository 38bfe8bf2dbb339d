"""One process of several under torchrun: its share of a global batch, and gradients weighted by what was in it.

A stage that draws its batches from `BatchOrder` and averages through `Ranks` gives the same losses on any number of
processes: the order of samples is one global permutation, and a mean is taken over the whole batch, not of means.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, Final, NoReturn

import numpy as np
import torch
import torch.distributed as dist
from numpy.typing import NDArray

_PATIENCE: Final = timedelta(days=7)
"""How long ranks wait for one another: one may record drives for hours. torchrun ends them all when one dies."""


class EndedEarlyError(RuntimeError):
    """The first rank has not finished what the others waited for; its own line says why."""


@dataclass(frozen=True)
class Ranks:
    """This process (`rank`) among `world`; with one process nothing is sent anywhere."""

    rank: int = 0
    world: int = 1

    @property
    def first(self) -> bool:
        """Whether this process writes files, logs and pictures."""
        return self.rank == 0

    def share(self, batch: NDArray[np.int64]) -> NDArray[np.int64]:
        """This rank's part of a global batch of indices, every `world`-th from `rank` on."""
        return batch[self.rank :: self.world]

    def average_gradients(self, parameters: Iterable[torch.nn.Parameter], weight: float = 1.0) -> float:
        """Replace gradients of this rank's *mean* loss over `weight` samples by those of the whole batch's mean.

        Returns the weight of all ranks together. A rank whose share is empty takes part with weight 0.
        """
        parameters = list(parameters)
        if self.world == 1:
            return weight
        total = self.sum(weight)
        flat = torch.cat([_gradient(each).reshape(-1).float() for each in parameters]) * (weight / max(total, 1e-12))
        dist.all_reduce(flat)
        start = 0
        for each in parameters:
            each.grad = flat[start : start + each.numel()].view_as(each).to(each.dtype)
            start += each.numel()
        return total

    def sum(self, value: float) -> float:
        """A number added over ranks."""
        if self.world == 1:
            return value
        whole = torch.tensor([value], dtype=torch.float64, device=_device())
        dist.all_reduce(whole)
        return float(whole.item())

    def mean(self, value: float, weight: float = 1.0) -> float:
        """A number averaged over ranks by weight."""
        if self.world == 1:
            return value
        return self.sum(value * weight) / max(self.sum(weight), 1e-12)

    def any(self, flag: bool) -> bool:
        """Whether it is so on any rank."""
        return flag if self.world == 1 else self.sum(float(flag)) > 0

    def barrier(self) -> None:
        """Wait for all ranks."""
        if self.world > 1:
            dist.barrier()

    @contextmanager
    def by_first(self) -> Iterator[bool]:
        """True where the work is to be done, on the first rank; the others wait at the end of the block.

        Raises EndedEarlyError on those where the first one's work has raised.
        """
        if not self.first:
            yield False
            if self.any(False):
                raise EndedEarlyError("the first process has ended early")
            return
        try:
            yield True
        except BaseException:
            with suppress(RuntimeError):  # the others may be gone; what has happened here is what counts
                self.any(True)
            raise
        self.any(False)

    def copy_parameters(self, parameters: Iterable[torch.Tensor]) -> None:
        """Give every rank the first one's values."""
        if self.world > 1:
            for each in parameters:
                dist.broadcast(each.detach(), src=0)


SINGLE = Ranks()


@contextmanager
def ranks_of_environment(device: str = "cpu") -> Iterator[Ranks]:
    """Join the processes that torchrun has started (gloo; NCCL for cuda); alone without torchrun."""
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
    # Not after an error: NCCL would wait here for those who wait for this process, which is about to end.
    dist.destroy_process_group()


def leave(code: int) -> NoReturn:
    """End this process, whose work is done, without Python's own ending.

    There, a thread of gloo's that still lets go of a tensor aborts the process now and then ("terminate called without
    an active exception"), and torchrun takes a finished run for a failed one.
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
        """Batches of one pass over the samples."""
        return -(-self.count // self.batch)

    @property
    def steps(self) -> int:
        """Batches in all."""
        return self.steps_per_epoch * self.epochs

    def indices(self, step: int) -> NDArray[np.int64]:
        """int64 sample indices of the global batch of `step`, from 0; any step without the ones before it."""
        epoch, within = divmod(step, self.steps_per_epoch)
        order = np.random.default_rng((self.seed, 0xBA7C, epoch)).permutation(self.count)
        return order[within * self.batch : (within + 1) * self.batch].astype(np.int64)


def _gradient(parameter: torch.nn.Parameter) -> torch.Tensor:
    return parameter.grad if parameter.grad is not None else torch.zeros_like(parameter)


def _device() -> str:
    return "cuda" if dist.get_backend() == "nccl" else "cpu"
