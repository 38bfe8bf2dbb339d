"""Driving many episodes at a time in worker processes, whose rollout files are read in a fixed order."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Final

from sim_hil.benchmark.workers.worker_pool import WorkerJob, Workers
from tools.train.rl.rollout import Rollout, read
from tools.train.rl.worker import MODULE, RolloutOrder
from tools.train.run.job import StageFailedError

COMMAND: Final[Sequence[str]] = (sys.executable, "-m", MODULE)


class RolloutFailedError(StageFailedError):
    """A worker process that ended without a rollout; one line."""


def split(order: RolloutOrder, per_job: int) -> list[RolloutOrder]:
    """Split an order into orders of at most `per_job` episodes, each with its own file below `order.out`.

    Each part keeps the position of its episodes in the whole order, so that every episode has its own random seed.
    """
    return [
        replace(
            order,
            numbers=order.numbers[first : first + per_job],
            first=order.first + first,
            out=str(Path(order.out) / f"{first // per_job:03d}.safetensors"),
        )
        for first in range(0, len(order.numbers), per_job)
    ]


def drive(
    order: RolloutOrder,
    *,
    jobs: int,
    per_job: int,
    finished: Callable[[bool], None] = lambda success: None,
    stopped: Callable[[], bool] = lambda: False,
    command: Sequence[str] = COMMAND,
) -> Rollout:
    """Drive an order's episodes; files of jobs that have finished before are reused.

    `finished` takes for each episode whether it succeeded. The number of jobs does not change the result. Raises
    RolloutFailedError, KeyboardInterrupt when `stopped`.
    """
    folder = Path(order.out)
    folder.mkdir(parents=True, exist_ok=True)
    orders = split(order, per_job)
    missing = [part for part in orders if not Path(part.out).is_file()]
    waiting = deque(
        WorkerJob(Path(part.out).stem, part.to_json(), Path(part.out).with_suffix(".log")) for part in missing
    )
    with Workers(command, jobs) as workers:
        for event in chain.from_iterable(workers.run(waiting, stopped)):
            if event.message is not None:
                finished(bool(event.message["success"]))
            elif event.failure:
                raise RolloutFailedError(f"rollout {event.key}: {event.failure}")
    return read([Path(part.out) for part in orders])
