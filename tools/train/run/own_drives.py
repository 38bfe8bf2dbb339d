"""Selection of a run's drives: all of its own, those of the newest DAgger round, or an imported data set."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any, Final

from tools.train.config.checks import TrainError
from tools.train.drives.dataset import DatasetWriter
from tools.train.drives.drive import Dataset
from tools.train.run.job import StageJob
from tools.train.run.run_dir import RunDir

_PARTIAL: Final = "collect.partial"
IMPORTED: Final = "imported"
"""Key in the result of `collect`: the drives were imported."""


def prefixes_of(round_number: int) -> tuple[str, str]:
    """Return the id prefixes of a round's drives, the policy's and the expert's; rounds count from 1."""
    return f"d{round_number}-", f"n{round_number}-"


def drives_after(job: StageJob, stage: str) -> Dataset:
    """Return the drives that a stage trains on: all, or those of the newest round (`dagger.newest_only`).

    Raises TrainError.
    """
    dataset, rounds = Dataset.open(job.run_dir.stage("collect")), job.run_dir.retired(stage)
    if rounds and job.recipe.dagger.newest_only:
        return dataset.of(*prefixes_of(rounds))
    return dataset


def take_drives(run_dir: RunDir, folder: Path) -> dict[str, Any]:
    """Import the data set in `folder` as the result of the run's stage `collect`; files are hard-linked if possible.

    An interrupted call leaves no drives. Returns the stage's result. Raises TrainError for a damaged data set,
    TrainError if the run has other drives.
    """
    dataset = Dataset.open(folder)
    done = run_dir.result("collect")
    if done is not None and done.get(IMPORTED) is True and done["sha256"] == dataset.sha256:
        return done
    if run_dir.begun("collect"):
        raise TrainError(f"--drives {folder}: {run_dir.out} has other drives; name another --out")
    Dataset.open(folder, verify=True)
    partial = run_dir.out / _PARTIAL
    shutil.rmtree(partial, ignore_errors=True)
    with DatasetWriter(partial) as writer:
        for entry in dataset.entries:
            _link_or_copy(dataset.path(entry.id).resolve(), writer.path(entry.id))
            writer.add(entry)
        result = {IMPORTED: True, **writer.summary(""), "sha256": writer.finish().sha256}
    run_dir.finish(_PARTIAL, result)
    partial.replace(run_dir.out / "collect")
    return result


def _link_or_copy(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # another file system, or one without hard links
        shutil.copyfile(source, target)
