"""Recording of many drives by worker processes into one data set: the stage `collect`, DAgger rounds, and tours.

In a DAgger round (Ross et al. 2011) the exported policy drives through the robot's code, with latencies drawn for each
drive, and the expert labels every frame with its own action.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from edge.artifacts.manifest import load_artifacts
from edge.state.reasoning_text import AHEAD, SeenPerson, parse_people
from export.core.typed import plain
from sim_hil.benchmark.workers.worker_pool import WorkerEvent, WorkerJob, Workers
from tools.train.collect.steering import PolicyOptions
from tools.train.collect.worker import MODULE, Order
from tools.train.config.checks import TrainError
from tools.train.config.collect import CollectConfig, TourConfig
from tools.train.drives.dataset import DatasetWriter
from tools.train.drives.drive import POLICY_DRIVER, Dataset, Entry
from tools.train.drives.scenarios import KEPT_SEEDS, MAX_SEED
from tools.train.run.distributed import Ranks
from tools.train.run.job import StageFailedError, StageJob, StageProgress
from tools.train.run.run_dir import prefixes_of
from tools.train.samples.anchors import Anchor, anchors_of

WORKER: Final[Sequence[str]] = (sys.executable, "-m", MODULE)
EXPERT_PREFIX: Final = "e"
_TAG: Final = 0xC0
_MOST_DROPPED: Final = 0.5
"""Share of unusable drives above which the recording fails: the cause lies outside single drives."""
_PER_PROCESS: Final = 8
"""Drives of small layouts that one process records: its start costs as much processor time as half a tour."""
BETA: Final = 0.5
"""Share of the expert's commands in round 1; each later round has half of the previous one's."""
_EXPERT_TURNS: Final = 1_000
"""First collection number of the expert's drives; rounds, at most 100, use the numbers from 1 on."""


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
        """Return orders of whole layouts for all missing drives; `has` tells which drives are done."""
        rng = np.random.default_rng((self.seed, self.turn, _TAG))
        scenario_seed, draw_seed = int(rng.integers(MAX_SEED + 1)), int(rng.integers(2**31))
        if scenario_seed in KEPT_SEEDS:
            scenario_seed -= len(KEPT_SEEDS)
        # An order does not contain `jobs`: their number must not change the drives.
        config = replace(self.config, jobs=0)
        orders, layout = [], config.drives_per_layout if self.tour is None else self.tour.per_layout
        size = layout * max(1, _PER_PROCESS // layout)
        for start in range(0, self.count, size):
            # Always whole layouts, so that their tasks do not depend on the count.
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
    """Record what the data set lacks. Raises StageFailedError, OSError, and KeyboardInterrupt when `stopped`."""
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
                raise StageFailedError(f"{dropped} of {done + dropped} drives gave nothing to learn, the last: {last}")


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
        self.waiting.append(WorkerJob(key, plain(order), self._logs / f"{key}.log"))

    def take(self, event: WorkerEvent) -> None:
        """Add a finished drive to the data set, or repeat what a dead process has left. Raises StageFailedError."""
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
            raise StageFailedError(str(message.get("refused", f"a worker sent {message}")))

    def _repeat(self, order: Order, begun: str, failure: str) -> None:
        """A process has died: drop the drive that it had begun and order the rest again."""
        if not begun:
            raise StageFailedError(f"the process of drive {order.id(order.start)} and those after it {failure}")
        if not self._writer.has(begun):
            self._writer.drop(begun, f"its process {failure.split(':')[0]}")
        ids = [order.id(number) for number in range(order.start, order.start + order.count)]
        skip = tuple(drive_id for drive_id in ids if drive_id in order.skip or self._writer.has(drive_id))
        if len(skip) < len(ids):
            self.add(replace(order, skip=skip))


def job_count(asked: int) -> int:
    """Return the number of parallel processes: `asked`, or one per available core if it is 0."""
    return asked or len(os.sched_getaffinity(0))


def collect(job: StageJob) -> dict[str, Any]:
    """Record the recipe's drives into `collect/`, or continue an interrupted recording. Raises TrainError."""
    config = _config(job)
    with DatasetWriter(job.run_dir.stage("collect")) as writer:
        _record(job, writer, Collection(EXPERT_PREFIX, config.episodes, job.seed, 0, config))
        return {**writer.summary(EXPERT_PREFIX), "sha256": writer.finish().sha256}


def run_round(job: StageJob, artifacts: Path, round_number: int) -> dict[str, Any]:
    """Record round `round_number` (1, 2, …) into `collect/`, or continue an interrupted recording.

    Raises ArtifactError for artifacts that cannot drive, TrainError.
    """
    if round_number < 1:
        raise ValueError(f"dagger: rounds count from 1, found {round_number}")
    config, numbers = _config(job), job.recipe.dagger
    sha256 = load_artifacts(artifacts).manifest_sha256
    beta = BETA / 2 ** (round_number - 1)
    policy = PolicyOptions(str(artifacts.absolute()), sha256, beta, numbers.latency_mean_s)
    prefix, beside = prefixes_of(round_number)
    driven = Collection(prefix, numbers.episodes, job.seed, round_number, config, policy)
    expert = Collection(beside, numbers.expert_episodes, job.seed, _EXPERT_TURNS + round_number, config)
    with DatasetWriter(job.run_dir.stage("collect")) as writer:
        if others := sorted({entry.driver for entry in writer.entries(prefix)} - {f"{POLICY_DRIVER}{sha256[:12]}"}):
            raise TrainError(f"dagger round {round_number}: started with {others[0]}; continue with the same artifacts")
        for collection in (expert, driven) if expert.count else (driven,):
            _record(job, writer, collection)
        result = {**writer.summary(prefix), "sha256": writer.finish().sha256, "beta": beta, "policy": sha256}
        return result | ({"expert": writer.summary(beside)} if expert.count else {})


def _config(job: StageJob) -> CollectConfig:
    if job.ranks.world > 1:
        raise TrainError("collect starts its own processes (collect.jobs): run it without torchrun")
    return job.recipe.collect


def _record(job: StageJob, writer: DatasetWriter, collection: Collection) -> None:
    jobs = job_count(collection.config.jobs)
    fill(writer, collection, jobs, update=job.progress.update, stopped=job.should_stop)


FOLDER: Final = "tours"
FORMAT: Final = 7
PREFIX: Final = "w"
_TURN: Final = 500
"""Collection number of tours: DAgger rounds use those from 0 on, their experts those from 1000 on."""
_OF_DRIVES: Final = frozenset(  # fields of CollectConfig that tours use too
    (
        "kinds", "sharp_share", "jpeg_quality_min", "jpeg_quality_max", "typical_drift_share", "severe_drift_share",
        "speed_mps", "arrive_share",
    )
)  # fmt: skip
# Waiting for a person and passing around one are the driver's choices, which a tour does not model.
_IN_THE_WAY_M: Final = 2
"""Distance of a person ahead up to which an anchor is left out, m."""


def build_tours(
    dataset: Dataset, config: TourConfig, collect: CollectConfig, seed: int, *, ranks: Ranks,
    progress: StageProgress, stopped: Callable[[], bool] = lambda: False,
) -> Dataset:  # fmt: skip
    """Record missing tours in the first rank's processes and return all; every rank must call this function.

    Tours in a layout that the data set holds out are left out. Raises TrainError, OSError, and
    KeyboardInterrupt if `stopped`.
    """
    folder = dataset.folder / FOLDER / _key(config, collect, seed)
    with ranks.by_first() as here:
        if here:
            tours = Collection(PREFIX, config.count, seed, _TURN, collect, tour=config)
            with DatasetWriter(folder) as writer:
                fill(writer, tours, job_count(collect.jobs), update=progress.update, stopped=stopped)
                writer.finish()
    held = {(entry.kind, entry.layout_seed) for entry in dataset.entries if entry.val}
    entries = (entry for entry in Dataset.open(folder).entries if (entry.kind, entry.layout_seed) not in held)
    return Dataset(folder, tuple(entry for entry in entries if int(entry.id[len(PREFIX) :]) < config.count))


def _key(config: TourConfig, collect: CollectConfig, seed: int) -> str:
    """Hash what a tour depends on; the numbers of tours and processes are not part of it."""
    shared = {name: value for name, value in asdict(collect).items() if name in _OF_DRIVES}
    numbers = {"format": FORMAT, "seed": seed, **asdict(replace(config, count=0)), "collect": shared}
    return hashlib.sha256(json.dumps(numbers, sort_keys=True).encode()).hexdigest()[:16]


def tour_anchors(tours: Dataset, ids: tuple[str, ...]) -> Iterator[Anchor]:
    """Yield the tours' anchors without a person in the way; only frames at whole seconds have images and text."""
    for drive in tours.drives(ids, pictures=False):
        clear = {int(trace["k"]) for trace in drive.traces if not _is_blocked(parse_people(str(trace["motion"])))}
        for anchor in anchors_of(drive):
            if anchor.k in clear:
                yield of_tour(anchor)


def of_tour(anchor: Anchor) -> Anchor:
    """Return an anchor whose drive is a tour, which has images at whole seconds alone."""
    return replace(anchor, around=(), by_seconds=True)


def _is_blocked(people: Sequence[SeenPerson]) -> bool:
    return any(person.side == AHEAD and person.distance_m <= _IN_THE_WAY_M for person in people)
