"""The steps of a run in their order, each done once: a stage, a round of DAgger, or a stage again after one."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from tools.train.collect import collect
from tools.train.collect.dagger import run_round
from tools.train.config.recipe import Recipe
from tools.train.drives.drive import file_sha256
from tools.train.encoder import encoder
from tools.train.imitate import imitate
from tools.train.pipeline import evaluate
from tools.train.rl import rl
from tools.train.run.exported import export_artifacts
from tools.train.run.job import StageJob
from tools.train.run.network_file import ORDER, START, stage_weights, weights_before
from tools.train.run.run_dir import RunDir, RunDirError
from tools.train.sft import sft

ALL: Final = ("collect", "encoder", "sft", "imitate", "dagger", "rl", "evaluate")
DISTRIBUTED: Final = ("encoder", "sft", "imitate")
"""Stages whose work torchrun shares out; the others the first of its processes does alone."""

GO_ON: Final = ("sft", "imitate")
"""Stages that go on, over more drives, after a round of DAgger."""

ADOPTED: Final = "adopted"
"""In a stage's result: it was not run here, the run began with weights that it had left."""

StageRun = Callable[[StageJob], dict[str, Any]]
RUNS: Final[Mapping[str, StageRun]] = {
    "collect": collect.run,
    "encoder": encoder.run,
    "sft": sft.run,
    "imitate": imitate.run,
    "rl": rl.run,
    "evaluate": evaluate.run,
}
"""Name of a stage and the function that does it."""


@dataclass(frozen=True)
class Step:
    """A stage, or round number `round` of DAgger; what goes on after that round has its number too."""

    stage: str
    round: int = 0

    @property
    def name(self) -> str:
        """For people, and for a round's folder."""
        return f"{self.stage}-{self.round}" if self.round else self.stage


def steps_of(command: str, recipe: Recipe) -> list[Step]:
    """What a command does, in order."""
    rounds: list[Step] = []
    for number in range(1, recipe.dagger.rounds + 1):
        spoken = [Step("sft", number)] if number <= recipe.dagger.sft_rounds else []
        rounds += [Step("dagger", number), *spoken, Step("imitate", number)]
    if command == "dagger":
        return rounds
    if command != "all":
        return [Step(command)]
    steps: list[Step] = []
    for stage in ALL:
        steps += rounds if stage == "dagger" else [Step(stage)]
    return steps


def is_done(run_dir: RunDir, step: Step) -> bool:
    """Whether a step has finished."""
    if step.stage == "dagger":
        return run_dir.result(step.name) is not None
    if step.stage in GO_ON and step.round != (now := run_dir.retired(step.stage)):
        return step.round < now
    return run_dir.result(step.stage) is not None


def may_begin(run_dir: RunDir, step: Step, resume: bool) -> None:
    """Raise RunDirError where a step would write over what is there."""
    where = step.name if step.stage == "dagger" else step.stage
    if step.stage in ("collect", "dagger") and run_dir.borrowed("collect"):
        raise RunDirError(f"{run_dir.out}: its drives are another run's (--from); set dagger.rounds=0")
    again = step.stage in GO_ON and step.round > run_dir.retired(step.stage)
    if run_dir.begun(where) and not resume and not again:
        raise RunDirError(f"{run_dir.out / where}: was begun; go on with --resume, or delete it to begin anew")


def steps_until(name: str, recipe: Recipe, wanted: Sequence[Step]) -> list[Step]:
    """The steps up to that one; raises RunDirError for one that the recipe does not have, or that leaves no policy.

    `wanted`: what is to be done after them.
    """
    steps = steps_of("all", recipe)
    policies = [step.name for step in steps if step.stage in ("imitate", "rl")]
    if name not in policies:
        raise RunDirError(f"--after {name}: expected one of {', '.join(policies)}")
    before = steps[: [step.name for step in steps].index(name) + 1]
    if not recipe.dagger.newest_only and any(step.stage == "dagger" and step not in before for step in wanted):
        raise RunDirError(f"--after {name}: the drives before it are not here; set dagger.newest_only=true")
    return before


def adopt(run_dir: RunDir, steps: Sequence[Step]) -> None:
    """Take the weights that the run began with for what these steps have left: what follows them is next."""
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


def run_step(job: StageJob, step: Step, stage_run: Callable[[str], StageRun] | None = None) -> dict[str, Any]:
    """Do one step and record its result; raises what its stage raises."""
    if step.stage == "dagger":
        result = _round(job, step)
        if job.ranks.first:
            job.run_dir.finish(step.name, result)
        return result
    if step.stage in GO_ON and step.round > job.run_dir.retired(step.stage):
        # The drives have become more: the stage goes on over all of them, and what it was is kept.
        job.ranks.barrier()  # all ranks have looked
        if job.ranks.first:
            job.run_dir.retire(step.stage, f"{step.stage}-{step.round - 1}")
        job.ranks.barrier()
        job = replace(job, resume=False)
    result = (stage_run or module_run)(step.stage)(job)
    if job.ranks.first:
        job.run_dir.finish(step.stage, result)
    return result


def module_run(stage: str) -> StageRun:
    """The function of a stage's module."""
    return RUNS[stage]


def _round(job: StageJob, step: Step) -> dict[str, Any]:
    weights = weights_before(job.run_dir.out, "rl")
    if weights is None or weights.parent.name != "imitate":
        raise RunDirError(f"{job.run_dir.out}: {step.name} needs a policy; run imitate first")
    folder = job.run_dir.stage(step.name)
    artifacts = export_artifacts(weights, job.recipe.model, folder / "artifacts", job.progress.say)
    return run_round(job, artifacts, step.round)
