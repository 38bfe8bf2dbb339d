"""The tours beside a data set's drives, from which the language model learns and nobody else does.

They lie in `tours/` of the data set's folder: data sets of their own with a picture of one frame a second, each in
a folder whose name begins the hash of the numbers that it was made with.
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
_TURN: Final = 500  # of collections: rounds of DAgger take those from 0 on, their experts those from 1000 on
_OF_DRIVES: Final = frozenset(  # what a tour has in common with the drives beside it
    (
        "kinds", "sharp_share", "jpeg_quality_min", "jpeg_quality_max", "typical_drift_share", "severe_drift_share",
        "speed_mps", "arrive_share",
    )
)  # fmt: skip
# Whether one waits for somebody, and how one goes round, is the driver's choice: of who is carried it is not known.
_IN_THE_WAY_M: Final = 2


def build_tours(
    dataset: Dataset, config: TourConfig, collect: CollectConfig, seed: int, *, ranks: Ranks,
    progress: StageProgress, stopped: Callable[[], bool] = lambda: False,
) -> Dataset:  # fmt: skip
    """The tours, those that are not there yet made by the first rank's processes; all must call.

    They have layouts of their own; those of a layout that the data set holds out are left out. Raises CollectError,
    DriveError, OSError, and KeyboardInterrupt when `stopped`.
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
    """Of what a tour depends on: how many there are is no part of it, nor how many processes make them."""
    looks = {name: value for name, value in asdict(collect).items() if name in _OF_DRIVES}
    numbers = {"format": FORMAT, "seed": seed, **asdict(replace(config, count=0)), "collect": looks}
    return hashlib.sha256(json.dumps(numbers, sort_keys=True).encode()).hexdigest()[:16]


def tour_anchors(tours: Dataset, ids: tuple[str, ...]) -> Iterator[Anchor]:
    """Those of tours at which nobody is in the way; their frames are whole seconds, and words hold for these alone."""
    for drive in tours.drives(ids, pictures=False):
        clear = {int(trace["k"]) for trace in drive.traces if not _is_blocked(parse_people(str(trace["motion"])))}
        for anchor in anchors_of(drive):
            if anchor.k in clear:
                yield replace(anchor, around=(), by_seconds=True)


def _is_blocked(people: Sequence[SeenPerson]) -> bool:
    return any(person.side == AHEAD and person.distance_m <= _IN_THE_WAY_M for person in people)
