"""The steps of a run in order, each run once: a stage, a DAgger round, or a stage that continues after a round.

The work of the steps is estimated before a run from measured throughputs.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any, Final

from firmware_bridge.system.input_file import read_toml
from reporting.progress import duration
from tools.train.collect.collection import collect, run_round
from tools.train.config.checks import TrainError
from tools.train.config.collect import RATE_HZ
from tools.train.config.imitate import TIC_VLA
from tools.train.config.recipe import ALL, Recipe
from tools.train.drives.drive import file_sha256
from tools.train.encoder import encoder
from tools.train.imitate import imitate
from tools.train.pipeline import evaluate
from tools.train.rl import rl
from tools.train.run.distributed import computes_bf16
from tools.train.run.job import StageJob
from tools.train.run.network_file import (
    ORDER,
    START,
    export_artifacts,
    import_start,
    stage_weights,
    started_with,
    weights_before,
)
from tools.train.run.run_dir import RunDir, read_record
from tools.train.sft import sft

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


def take_start(run_dir: RunDir, recipe: Recipe, checkpoints: Sequence[Path], before: Sequence[Step]) -> None:
    """Take given weights as the run's first, and as the result of the steps `before`; again after an interruption.

    Raises CheckpointError, or TrainError for a run that was started otherwise: it would go on without these weights.
    """
    advice = "name another --out, or leave the option out to continue that run"
    own = next((stage for stage in ORDER[1:] if run_dir.begun(stage)), None)
    if not stage_weights(run_dir.out, START).is_file():
        if own is not None:
            raise TrainError(f"--checkpoint: {run_dir.out} was started without it (it has the stage {own}); {advice}")
        import_start(run_dir.out, recipe.model, checkpoints, recipe.seed)
    elif not started_with(run_dir.out, checkpoints):
        raise TrainError(f"--checkpoint {checkpoints[0]}: {run_dir.out} was started with other weights; {advice}")
    if not before:
        return
    after = _adopted_after(run_dir)
    if after not in (None, before[-1].name) or (after is None and own is not None):
        began = "without --after" if after is None else f"with --after {after}"
        raise TrainError(f"--after {before[-1].name}: {run_dir.out} was started {began}; {advice}")
    if after is None or not run_dir.model_path.is_file():  # the copy there is the last thing that `adopt` makes
        adopt(run_dir, before)


def _adopted_after(run_dir: RunDir) -> str | None:
    """Return the step whose result the start weights were taken for; None if they were taken for none."""
    results = (read_record(path) for path in sorted(run_dir.out.glob("*/result.json")))
    return next((str(result["after"]) for result in results if ADOPTED in result), None)


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
    artifacts = export_artifacts(weights, job.recipe.model, folder / "artifacts", job.progress.log)
    return run_round(job, artifacts, step.round)


Work = list[tuple[str, int, str]]
"""(description, number of samples, key in the throughput table) of each kind of work."""

FILE: Final = Path(__file__).with_name("throughput.toml")
_DRIVE_S, _TOUR_S, _EPISODE_STEPS = 30.0, 45.0, 300  # typical lengths; an episode's are of 0.1 s
_OF_TOURS: Final = "tours: "  # prefix of the lines that concern tours
_DECIDE: Final = 0.3  # share of deciding anchors, measured in `nano`'s 328 drives
_RELABELLED: Final = 0.2  # share of a drive's anchors that each other instruction adds, measured in 16 drives


@dataclass(frozen=True)
class Line:
    """One kind of work of a step; `rate` in samples per second, None if it was not measured."""

    step: str
    what: str
    samples: int
    rate: float | None

    @property
    def seconds(self) -> float | None:
        """Estimated duration, s; None without a measured rate."""
        return None if self.rate is None else self.samples / self.rate


def throughputs(model: str, device: str) -> Mapping[str, float]:
    """Return measured samples per second by key for a network and a device; empty if none were measured."""
    tables = read_toml(FILE)
    kind = device.partition(":")[0]
    if kind == "cpu" and not computes_bf16(kind):
        kind = "cpu-float32"
    found: Mapping[str, float] = tables.get(model, {}).get(kind, {}).get("rates", {})
    return found


def budget_of(recipe: Recipe, steps: Sequence[Step], device: str) -> list[Line]:
    """Return the work of every step."""
    rates = throughputs(recipe.model.name, device)
    lines: list[Line] = []
    for step in steps:
        lines += [Line(step.name, what, count, rates.get(key)) for what, count, key in _work(recipe, step) if count > 0]
    return lines


def _work(recipe: Recipe, step: Step) -> Work:
    """Return a step's work; stages that learn from drives are planned with drives of 30 s."""
    seconds = round(_DRIVE_S * recipe.collect.episodes)
    work: Work = []
    if step.stage == "collect":
        work = [("drives of the expert", recipe.collect.episodes, "drive")]
    elif step.stage == "encoder":
        frames = recipe.encoder.frames
        work = [
            ("pictures with labels", frames.count + frames.held if frames.count else 0, "render"),
            ("pictures learned from", frames.count * recipe.encoder.epochs, "encoder"),
        ]
    elif step.stage == "sft":
        work = _sft(recipe, seconds)
    elif step.stage == "imitate":
        states = [("semantic states", seconds * recipe.imitate.states.draws, "kv")]
        work = states if recipe.imitate.policy == TIC_VLA else []
        work = [*work, ("samples learned", recipe.imitate.samples, "imitate")]
    elif step.stage == "dagger":
        expert = [("drives of the expert", recipe.dagger.expert_episodes, "drive")]
        work = expert if recipe.dagger.expert_episodes else []
        work = [*work, ("drives of the policy", recipe.dagger.episodes, "policy-drive")]
    elif step.stage == "rl":
        rl = recipe.rl
        evaluations = 1 + -(-rl.iterations // rl.evaluate_every)
        episodes = rl.iterations * rl.episodes + evaluations * rl.evaluate_episodes + 2 * rl.final_episodes
        work = [("steps driven and learned from", episodes * _EPISODE_STEPS, "ppo")]
    elif step.stage == "evaluate":
        work = [("episodes", recipe.evaluate.episodes, "policy-drive")]
    return _after_round(recipe, step.stage, work) if step.round and step.stage in GO_ON else work


def _sft(recipe: Recipe, seconds: int) -> Work:
    config = recipe.sft
    deciding = 1 + _DECIDE * (config.deciding - 1)
    anchors = round(seconds * (deciding * (1 + _RELABELLED * config.retold.ways))) * config.epochs
    drives = [
        ("frames encoded", seconds * RATE_HZ, "encode"),
        ("other instructions", recipe.collect.episodes * config.retold.ways, "relabel"),
        ("anchors learned", anchors, "sft"),
    ]
    if not config.tours.count:
        return drives
    toured = round(_TOUR_S * config.tours.count)
    retoured = round(toured * deciding * (1 + _RELABELLED * config.retold.tour_ways))
    return [
        *drives,
        (f"{_OF_TOURS}made", config.tours.count, "tour"),
        (f"{_OF_TOURS}frames encoded", toured * (2 if config.mirrored > 0 else 1), "encode"),
        (f"{_OF_TOURS}other instructions", config.tours.count * config.retold.tour_ways, "relabel"),
        (f"{_OF_TOURS}anchors learned", retoured * config.epochs, "sft"),
    ]


def _after_round(recipe: Recipe, stage: str, work: Sequence[tuple[str, int, str]]) -> Work:
    """Return the work of a stage that continues after a DAgger round: caching new drives and training for a share."""
    dagger = recipe.dagger
    drives = dagger.episodes + dagger.expert_episodes
    more = drives / recipe.collect.episodes
    config = recipe.imitate if stage == "imitate" else recipe.sft
    share = config.go_on_share or 1.0
    # The length of an SFT epoch grows with the number of drives; imitation has a fixed number of samples.
    shares = {"kv": more, "encode": more, "relabel": more, "sft": share * (more if dagger.newest_only else 1.0)}
    # No new tours; a share of them is trained on again.
    tours = {"tour": 0.0, "encode": 0.0, "relabel": 0.0, "sft": share * recipe.sft.tours_again}
    return [
        (what, round(count * (tours if what.startswith(_OF_TOURS) else shares).get(key, share)), key)
        for what, count, key in work
    ]


def lines_of(recipe: Recipe, steps: Sequence[Step], budget: Sequence[Line], device: str) -> list[str]:
    """Format the estimate as lines of text."""
    lines = [f"{recipe.name}: network {recipe.model.name}, seed {recipe.seed}, {device}"]
    for step in steps:
        own = [line for line in budget if line.step == step.name]
        for line in own:
            took = "not measured" if line.seconds is None else duration(line.seconds)
            lines.append(f"  {step.name:<11}{line.samples:>9,} {line.what:<28} {took}")
        if not own:
            lines.append(f"  {step.name:<11}{'':>9} no estimate")
    known = sum(line.seconds for line in budget if line.seconds is not None)
    open_ends = sum(line.seconds is None for line in budget)
    lines.append(f"  total {duration(known)}{f' plus {open_ends} parts without a measured rate' if open_ends else ''}")
    return lines


def as_json(budget: Sequence[Line]) -> list[dict[str, Any]]:
    """Return the estimate as the value that `--json` writes."""
    keys = ("step", "what", "samples", "rate_per_s", "seconds")
    return [dict(zip(keys, (*astuple(line), line.seconds), strict=True)) for line in budget]
