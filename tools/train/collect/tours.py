"""Tours of a data set, which train the language model alone.

They lie in `tours/` of the data set's folder: separate data sets with one image per second, each in a folder named by
the hash of its configuration.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from typing import Final

from edge.state.reasoning_text import AHEAD, SeenPerson, parse_people
from tools.train.collect.collection import Collection, fill, job_count
from tools.train.config.collect import CollectConfig, TourConfig
from tools.train.drives.dataset import DatasetWriter
from tools.train.drives.drive import Dataset
from tools.train.run.distributed import Ranks
from tools.train.run.job import StageProgress
from tools.train.samples.anchors import Anchor, anchors_of

FOLDER: Final = "tours"
FORMAT: Final = 3
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
                yield replace(anchor, around=(), by_seconds=True)


def _is_blocked(people: Sequence[SeenPerson]) -> bool:
    return any(person.side == AHEAD and person.distance_m <= _IN_THE_WAY_M for person in people)
