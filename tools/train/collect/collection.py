"""Recording of many drives by worker processes into one data set, for `collect`, `dagger` and tours."""

from __future__ import annotations

import os
import sys
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from sim_hil.benchmark.workers.worker_pool import WorkerEvent, WorkerJob, Workers
from tools.train.collect.dagger_driver import PolicyOptions
from tools.train.collect.worker import MODULE, Order
from tools.train.config.collect import CollectConfig, TourConfig
from tools.train.drives.dataset import DatasetWriter
from tools.train.drives.drive import Entry
from tools.train.run.job import StageFailedError
from tools.train.scenes.scenarios import KEPT_SEEDS, MAX_SEED

WORKER: Final[Sequence[str]] = (sys.executable, "-m", MODULE)
_TAG: Final = 0xC0
_MOST_DROPPED: Final = 0.5
"""Share of unusable drives above which the recording fails: the cause lies outside single drives."""


class CollectError(Exception):
    """A collection that cannot start; one line."""


class CollectFailedError(StageFailedError):
    """A collection that cannot continue; one line."""


@dataclass(frozen=True)
class Collection:
    """Description of `count` drives with ids that begin with `prefix`; `turn` separates the collections of one seed."""

    prefix: str
    count: int
    seed: int
    turn: int
    config: CollectConfig
    policy: PolicyOptions | None = None
    tour: TourConfig | None = None

    def orders(self, folder: Path, has: Callable[[str], bool]) -> list[Order]:
        """Return one order for each layout that lacks a drive; `has` tells which drives are done."""
        rng = np.random.default_rng((self.seed, self.turn, _TAG))
        scenario_seed, draw_seed = int(rng.integers(MAX_SEED + 1)), int(rng.integers(2**31))
        if scenario_seed in KEPT_SEEDS:
            scenario_seed -= len(KEPT_SEEDS)
        # An order does not contain `jobs`: their number must not change the drives.
        config = replace(self.config, jobs=0)
        orders, size = [], config.drives_per_layout if self.tour is None else self.tour.per_layout
        for start in range(0, self.count, size):
            # Always a whole layout, so that its tasks do not depend on the count.
            order = Order(
                str(folder), self.prefix, draw_seed, scenario_seed, start, size, (), config, self.policy, self.tour
            )
            ids = [order.id(number) for number in range(start, start + size)]
            wanted = [drive_id for drive_id in ids[: self.count - start] if not has(drive_id)]
            if wanted:
                orders.append(replace(order, skip=tuple(drive_id for drive_id in ids if drive_id not in wanted)))
        return orders


def fill(
    writer: DatasetWriter,
    collection: Collection,
    jobs: int,
    *,
    update: Callable[[int, int], None] = lambda done, total: None,
    stopped: Callable[[], bool] = lambda: False,
    command: Sequence[str] = WORKER,
) -> None:
    """Record what the data set lacks. Raises CollectFailedError, OSError, and KeyboardInterrupt when `stopped`."""
    under_way = _UnderWay(writer)
    for order in collection.orders(writer.folder, writer.has):
        under_way.add(order)
    with Workers(command, jobs) as workers:
        for events in workers.run(under_way.waiting, stopped):
            for event in events:
                under_way.take(event)
            done, dropped = len(writer.entries(collection.prefix)), len(writer.dropped(collection.prefix))
            update(done + dropped, collection.count)
            if dropped > max(16, _MOST_DROPPED * (done + dropped)):
                last = writer.dropped(collection.prefix)[-1].why
                raise CollectFailedError(
                    f"{dropped} of {done + dropped} drives gave nothing to learn, the last: {last}"
                )


class _UnderWay:
    """Orders that wait or run, and the drive that each has begun."""

    def __init__(self, writer: DatasetWriter) -> None:
        self._writer = writer
        self._logs = writer.folder / "logs"
        self._logs.mkdir(exist_ok=True)
        self._orders: dict[str, tuple[Order, str]] = {}
        self.waiting: deque[WorkerJob] = deque()

    def add(self, order: Order) -> None:
        """Let an order wait for a process."""
        key = order.id(order.start)
        self._orders[key] = (order, "")
        self.waiting.append(WorkerJob(key, order.as_json(), self._logs / f"{key}.log"))

    def take(self, event: WorkerEvent) -> None:
        """Add a finished drive to the data set, or repeat what a dead process has left. Raises CollectFailedError."""
        order, begun = self._orders[event.key]
        message = event.message
        if message is None:
            if event.failure:
                self._repeat(order, begun, event.failure)
        elif "begun" in message:
            self._orders[event.key] = (order, str(message["begun"]))
        elif "drive" in message:
            self._writer.add(Entry(**message["drive"]))
        elif "dropped" in message:
            if message["dropped"] not in order.skip:
                self._writer.drop(str(message["dropped"]), str(message["why"]))
        else:
            raise CollectFailedError(str(message.get("refused", f"a worker sent {message}")))

    def _repeat(self, order: Order, begun: str, failure: str) -> None:
        """A process has died: drop the drive that it had begun and order the rest of its layout again."""
        if not begun:
            raise CollectFailedError(f"the process of drive {order.id(order.start)} and those after it {failure}")
        if not self._writer.has(begun):
            self._writer.drop(begun, f"its process {failure.split(':')[0]}")
        ids = [order.id(number) for number in range(order.start, order.start + order.count)]
        skip = tuple(drive_id for drive_id in ids if drive_id in order.skip or self._writer.has(drive_id))
        if len(skip) < len(ids):
            self.add(replace(order, skip=skip))


def job_count(asked: int) -> int:
    """Return the number of parallel processes: `asked`, or one per available core if it is 0."""
    return asked if asked else len(os.sched_getaffinity(0))


def result_of(writer: DatasetWriter, prefix: str) -> dict[str, Any]:
    """Return the counts of a collection and the hash of the whole data set."""
    return {**writer.summary(prefix), "sha256": writer.finish().sha256}
