"""DAgger rounds (Ross et al. 2011): the policy drives, and the expert labels every frame with its own action.

The exported artifacts drive through the robot's code, with latencies drawn for each drive, so that the labelled states
are those that the deployed policy reaches. New drives of the expert can be added.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from edge.artifacts.manifest import load_artifacts
from tools.train.collect.collection import Collection, fill, job_count, result_of
from tools.train.collect.dagger_driver import PolicyOptions
from tools.train.config.checks import TrainError
from tools.train.drives.dataset import DatasetWriter
from tools.train.drives.drive import POLICY_DRIVER
from tools.train.run.job import StageJob
from tools.train.run.own_drives import prefixes_of

BETA: Final = 0.5
"""Share of the expert's commands in round 1; each later round has half of the previous one's."""
_EXPERT_TURNS: Final = 1_000
"""First collection number of the expert's drives; rounds, at most 100, use the numbers from 1 on."""


def run_round(job: StageJob, artifacts: Path, round_number: int) -> dict[str, Any]:
    """Record round `round_number` (1, 2, …) into `collect/`, or continue an interrupted recording.

    Raises ArtifactError for artifacts that cannot drive, TrainError.
    """
    if round_number < 1:
        raise ValueError(f"dagger: rounds count from 1, found {round_number}")
    if job.ranks.world > 1:
        raise TrainError("dagger starts its own processes (collect.jobs): run it without torchrun")
    config, numbers = job.recipe.collect, job.recipe.dagger
    sha256 = load_artifacts(artifacts).manifest_sha256
    beta, mean_s = BETA / 2 ** (round_number - 1), numbers.latency_mean_s
    policy = PolicyOptions(str(artifacts.absolute()), sha256, beta, mean_s)
    prefix, beside = prefixes_of(round_number)
    driven = Collection(prefix, numbers.episodes, job.seed, round_number, config, policy)
    expert = Collection(beside, numbers.expert_episodes, job.seed, _EXPERT_TURNS + round_number, config)
    with DatasetWriter(job.run_dir.stage("collect")) as writer:
        if others := sorted({entry.driver for entry in writer.entries(prefix)} - {f"{POLICY_DRIVER}{sha256[:12]}"}):
            raise TrainError(f"dagger round {round_number}: started with {others[0]}; continue with the same artifacts")
        for collection in (expert, driven) if expert.count else (driven,):
            fill(writer, collection, job_count(config.jobs), update=job.progress.update, stopped=job.should_stop)
        result: dict[str, Any] = {**result_of(writer, prefix), "beta": beta, "policy": sha256}
        if numbers.expert_episodes:
            result["expert"] = writer.summary(beside)
        return result
