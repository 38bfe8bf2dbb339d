"""The first stage: the expert drives through training scenes; every frame is recorded with the expert's next motion."""

from __future__ import annotations

from typing import Any

from tools.train.collect.collection import Collection, fill, job_count, result_of
from tools.train.config.checks import TrainError
from tools.train.config.recipe import Recipe
from tools.train.drives.dataset import DatasetWriter
from tools.train.run.job import StageJob

PREFIX = "e"


def budget(recipe: Recipe) -> list[tuple[str, int, str]]:
    """Return (description, number, key of the throughput of all processes together) of this stage's work."""
    return [("drives of the expert", recipe.collect.episodes, "drive")]


def run(job: StageJob) -> dict[str, Any]:
    """Record the recipe's drives into `collect/`, or continue an interrupted recording. Raises TrainError."""
    config = job.recipe.collect
    if job.ranks.world > 1:
        raise TrainError("collect starts its own processes (collect.jobs): run it without torchrun")
    collection = Collection(PREFIX, config.episodes, job.seed, 0, config)
    with DatasetWriter(job.run_dir.stage("collect")) as writer:
        fill(writer, collection, job_count(config.jobs), update=job.progress.update, stopped=job.should_stop)
        return result_of(writer, PREFIX)
