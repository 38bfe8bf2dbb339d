"""The steps of a run in order, each run once: a stage, a DAgger round, or a stage that continues after a round."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from tools.train.collect.collection import collect, run_round
from tools.train.config.checks import TrainError
from tools.train.config.recipe import Recipe
from tools.train.drives.drive import file_sha256
from tools.train.encoder import encoder
from tools.train.imitate import imitate
from tools.train.pipeline import evaluate
from tools.train.rl import rl
from tools.train.run.job import StageJob
from tools.train.run.network_file import ORDER, START, export_artifacts, stage_weights, weights_before
from tools.train.run.run_dir import RunDir
from tools.train.sft import sft

ALL: Final = ("collect", "encoder", "sft", "imitate", "dagger", "rl", "evaluate")
DISTRIBUTED: Final = ("encoder", "sft", "imitate")
"""Stages that torchrun distributes; the other stages run in its first process alone."""

GO_ON: Final = ("sft", "imitate")
"""Stages that continue after a DAgger round, with its new drives."""

ADOPTED: Final = "adopted"
"""Key in the result of a stage that did not run here because the run started with that stage's weights."""

StageRun = Callable[[StageJob], dict[str, Any]]
RUNS: Final[dict[str, StageRun]] = {
    "collect": collect,
    "encoder": encoder.run,
    "sft": sft.run,
    "imitate": imitate.run,
    "rl": rl.run,
    "evaluate": evaluate.run,
}
"""Function that runs each stage."""


@dataclass(frozen=True)
class Step:
    """One step: a stage, DAgger round `round`, or a stage that continues after that round."""

    stage: str
    round: int = 0

    @property
    def name(self) -> str:
        """Display name, which is also the folder of a DAgger round."""
        return f"{self.stage}-{self.round}" if self.round else self.stage


def steps_of(command: str, recipe: Recipe) -> list[Step]:
    """Return the steps of a command, in order."""
    rounds: list[Step] = []
    for number in range(1, recipe.dagger.rounds + 1):
        sft_step = [Step("sft", number)] if number <= recipe.dagger.sft_rounds else []
        rounds += [Step("dagger", number), *sft_step, Step("imitate", number)]
    if command == "dagger":
        return rounds
    if command != "all":
        return [Step(command)]
    steps: list[Step] = []
    for stage in ALL:
        steps += rounds if stage == "dagger" else [Step(stage)]
    return steps


def is_done(run_dir: RunDir, step: Step) -> bool:
    """Return whether a step has finished."""
    if step.stage == "dagger":
        return run_dir.result(step.name) is not None
    if step.stage in GO_ON and step.round != (now := run_dir.retired(step.stage)):
        return step.round < now
    return run_dir.result(step.stage) is not None


def may_begin(run_dir: RunDir, step: Step, resume: bool) -> None:
    """Raise TrainError if a step would overwrite existing files."""
    where = step.name if step.stage == "dagger" else step.stage
    if step.stage in ("collect", "dagger") and run_dir.borrowed("collect"):
        raise TrainError(f"{run_dir.out}: its drives belong to another run (--from); set dagger.rounds=0")
    again = step.stage in GO_ON and step.round > run_dir.retired(step.stage)
    if run_dir.begun(where) and not resume and not again:
        raise TrainError(f"{run_dir.out / where}: already started; continue with --resume, or delete it to start again")


def steps_until(name: str, recipe: Recipe, wanted: Sequence[Step]) -> list[Step]:
    """Return the steps up to `name`; `wanted` are the steps to run after them.

    Raises TrainError if the recipe has no such step, the step leaves no policy, or a later step needs earlier drives.
    """
    steps = steps_of("all", recipe)
    policies = [step.name for step in steps if step.stage in ("imitate", "rl")]
    if name not in policies:
        raise TrainError(f"--after {name}: expected one of {', '.join(policies)}")
    before = steps[: [step.name for step in steps].index(name) + 1]
    if not recipe.dagger.newest_only and any(step.stage == "dagger" and step not in before for step in wanted):
        raise TrainError(f"--after {name}: the run has no drives from before it; set dagger.newest_only=true")
    return before


def adopt(run_dir: RunDir, steps: Sequence[Step]) -> None:
    """Record the run's start weights as the result of these steps, so that the next step is the one after them."""
    start = stage_weights(run_dir.out, START)
    result = {ADOPTED: file_sha256(start), "after": steps[-1].name}
    for step in steps:
        if step.stage in GO_ON and step.round > run_dir.retired(step.stage):
            run_dir.retire(step.stage, f"{step.stage}-{step.round - 1}")
        name = step.name if step.stage == "dagger" else step.stage
        run_dir.stage(name)
        if step.stage in ORDER:
            shutil.copyfile(start, stage_weights(run_dir.out, name))
        run_dir.finish(name, result)
    shutil.copyfile(start, run_dir.model_path)


def run_step(job: StageJob, step: Step) -> dict[str, Any]:
    """Run one step and record its result. Raises the stage's errors."""
    if step.stage == "dagger":
        result = _round(job, step)
        if job.ranks.first:
            job.run_dir.finish(step.name, result)
        return result
    if step.stage in GO_ON and step.round > job.run_dir.retired(step.stage):
        # The round has added drives: the stage continues on all of them, and its earlier result is kept.
        job.ranks.barrier()  # all ranks have read the old state
        if job.ranks.first:
            job.run_dir.retire(step.stage, f"{step.stage}-{step.round - 1}")
        job.ranks.barrier()
        job = replace(job, resume=False)
    result = RUNS[step.stage](job)
    if job.ranks.first:
        job.run_dir.finish(step.stage, result)
    return result


def _round(job: StageJob, step: Step) -> dict[str, Any]:
    weights = weights_before(job.run_dir.out, "rl")
    if weights is None or weights.parent.name != "imitate":
        raise TrainError(f"{job.run_dir.out}: {step.name} needs a policy; run imitate first")
    folder = job.run_dir.stage(step.name)
    artifacts = export_artifacts(weights, job.recipe.model, folder / "artifacts", job.progress.say)
    return run_round(job, artifacts, step.round)
