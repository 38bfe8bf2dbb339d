"""The last stage: the exported model drives episodes in training-like scenes that no stage has used."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from edge.core.cli import write_whole
from sim_hil.benchmark.conditions.conditions import Conditions, PolicySpec
from sim_hil.benchmark.conditions.latency import LatencyProfile
from sim_hil.benchmark.results.record import EpisodeResult
from sim_hil.benchmark.results.summary import summarise
from sim_hil.benchmark.runs import run_episodes
from sim_hil.benchmark.suite.episode import load_suite, suite_to_toml
from sim_hil.benchmark.workers.jobs import RunWatcher
from sim_hil.scene.scene import scene_to_toml
from tools.train.config.checks import TrainError
from tools.train.config.collect import SHARES
from tools.train.config.rl import EvaluateConfig
from tools.train.drives.scenarios import training_episodes
from tools.train.run.job import StageJob
from tools.train.run.network_file import export_artifacts, weights_before
from tools.train.run.run_dir import read_record

STAGE: Final = "evaluate"
SUITE: Final = "training.toml"


def run(job: StageJob) -> dict[str, Any]:
    """Export the run's newest weights, drive the episodes and return the benchmark's summary. Resumes automatically.

    Raises TrainError, ExportError, RunsError, ScenarioError, StoreError.
    """
    config = job.recipe.evaluate
    weights = weights_before(job.run_dir.out, STAGE)
    if weights is None or weights.parent.name not in ("imitate", "rl"):
        raise TrainError(f"{job.run_dir.out}: no policy to evaluate; run imitate first")
    folder = job.run_dir.stage(STAGE)
    artifacts = export_artifacts(weights, job.recipe.model, folder / "artifacts", job.progress.log)
    suite = write_suite(folder, config)
    conditions = Conditions(
        PolicySpec("artifacts", str(artifacts.absolute())),
        mode="async",
        latency=LatencyProfile.constant(config.latency_s),
        drift=config.drift,
    )
    reached: list[bool] = []

    def finished(result: EpisodeResult) -> None:
        reached.append(result.success)
        job.progress.update(len(reached), config.episodes, success=sum(reached) / len(reached))

    results = run_episodes(
        str(suite),
        load_suite(suite),
        conditions,
        folder / "run",
        jobs=config.jobs or len(os.sched_getaffinity(0)),
        stopped=job.should_stop,
        watcher=RunWatcher(finished=finished),
    )
    # Summarise by kind of scene, not by layout.
    by_kind = [replace(result, scene=Path(result.scene).stem.split("-")[0]) for result in results]
    return {"weights": weights.parent.name, "latency_s": config.latency_s, "summary": summarise(by_kind)}


def write_suite(folder: Path, config: EvaluateConfig) -> Path:
    """Write the episodes as a suite file with its scenes beside it, or reuse a file of the same configuration.

    Returns its path. Raises TrainError for a file of another configuration, whose results would be mixed in.
    """
    path, mark = folder / SUITE, (folder / SUITE).with_suffix(".json")
    numbers = {"episodes": config.episodes, "scenario_seed": config.scenario_seed, "kinds": dict(config.kinds)}
    if path.exists() and mark.exists():
        if (found := read_record(mark)) != numbers:
            raise TrainError(f"{path}: expected episodes of {numbers}, found {found}; delete {folder} to start again")
        return path
    scenes = folder / "scenes"
    scenes.mkdir(parents=True, exist_ok=True)
    episodes = []
    kinds = config.kinds or SHARES
    for scenario in training_episodes(config.scenario_seed, config.episodes, kinds):
        scene = scenes / f"{scenario.scene.name}.toml"
        if not scene.exists():
            write_whole(scene, scene_to_toml(scenario.scene))
        episodes.append(replace(scenario.episode, scene=str(scene.absolute())))
    write_whole(path, suite_to_toml("training", 1, episodes))
    write_whole(mark, json.dumps(numbers) + "\n")
    return path
