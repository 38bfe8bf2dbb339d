"""Driving many episodes at a time in worker processes, whose rollout files are read in a fixed order."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from sim_hil.benchmark.workers.worker_pool import Workers
from tools.train.rl.rollout import Rollout, read
from tools.train.rl.worker import MODULE, RolloutOrder
from tools.train.run.job import StageFailedError

COMMAND: Final[Sequence[str]] = (sys.executable, "-m", MODULE)
_POLL_S: Final = 0.5


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
    StageFailedError, KeyboardInterrupt when `stopped`.
    """
    folder = Path(order.out)
    folder.mkdir(parents=True, exist_ok=True)
    orders = split(order, per_job)
    waiting = [part for part in orders if not Path(part.out).is_file()]
    workers = Workers(command, jobs or len(os.sched_getaffinity(0)))
    try:
        while waiting or workers.running():
            if stopped():
                raise KeyboardInterrupt
            while waiting and workers.free():
                part = waiting.pop(0)
                stem = Path(part.out).stem
                workers.start(stem, part.to_json(), folder / f"{stem}.log")
            for line in workers.wait(_POLL_S):
                if line.message is not None:
                    finished(bool(line.message["success"]))
                elif line.why:
                    raise StageFailedError(f"rollout {line.key}: {line.why}")
    finally:
        workers.close()
    return read([Path(part.out) for part in orders])
