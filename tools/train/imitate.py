"""Stage 2: the action expert learns to drive by what a frozen language model said seconds ago (Algorithm 1, eq. 4).

Frames' tokens and generations' states come from caches, so that only the action expert computes. Every batch is a pure
function of seed and step: a run that was ended goes on exactly, and any number of processes learns from the same ones.
After a round of DAgger imitation goes on, over all drives, from what it was.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import torch

from export.checkpoint import tokenizer_for
from export.model.network import TicVla
from tools.train import checkpoint
from tools.train.action_batch import ActionBatch, Group, collate
from tools.train.chain import retired
from tools.train.delays import DelayConfig, Delays
from tools.train.drive import Dataset
from tools.train.drive_frames import DriveFrames
from tools.train.imitate_eval import ImitateEvalConfig, draw_errors, evaluate
from tools.train.imitation_data import NoStates, SampleConfig, SampleError, Samples, States
from tools.train.imitation_pupils import ExpertPupil, LossConfig, PointGoalPupil, Pupil
from tools.train.job import StageJob
from tools.train.kv_build import KvConfig, build_kv_cache, parts_sha256
from tools.train.language_batch import FrameTokens
from tools.train.network_file import finish_network, read_network, stage_weights, start_network
from tools.train.optim import OptimConfig, Optimiser, autocast
from tools.train.point_goal_net import PointGoalNet, build_point_goal, save_point_goal
from tools.train.prefetch import Ahead
from tools.train.tokens import TokenCache

if TYPE_CHECKING:
    from tools.train.recipe import Recipe

STAGE: Final = "imitate"
TIC_VLA, POINT_GOAL = "tic-vla", "point-goal"
STATES: Final = "kv"
"""Folder of the semantic states, beside the drives."""
POINT_GOAL_FILE: Final = "point_goal.safetensors"
_DRAWS, _HELD, _NOISE, _START = 0x1A11, 0x1A12, 0x1A13, 0x1A14


class ImitateError(ValueError):
    """Data or a checkpoint that cannot be learned from; one line."""


@dataclass(frozen=True)
class ImitateConfig:
    """Imitation learning with delayed inference."""

    policy: str = TIC_VLA
    """Or point-goal: the paper's behaviour cloning baseline, from picture, state and goal, told nothing."""
    samples: int = 384_000
    """Samples in all (the paper: 10 epochs of frames 3 s apart)."""
    batch: int = 64
    """Samples of one step, of all ranks together (the paper: 16 on each of 8)."""
    go_on_share: float = 0.5
    """Of `samples` after a round of DAgger, from the weights before it; 0: from the beginning with all of them."""
    inject_delay: bool = True
    """False: states are always those of now (the crosses in the paper's Table 2)."""
    delays: DelayConfig = field(default_factory=DelayConfig)
    sample: SampleConfig = field(default_factory=SampleConfig)
    states: KvConfig = field(default_factory=KvConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    held_samples: int = 1024
    """Of held-out layouts, whose loss is looked at every `held_steps` steps and at the end."""
    held_steps: int = 500
    checkpoint_steps: int = 500
    evaluate: ImitateEvalConfig = field(default_factory=ImitateEvalConfig)

    def __post_init__(self) -> None:
        if self.policy not in (TIC_VLA, POINT_GOAL):
            raise ValueError(f"policy: expected {TIC_VLA} or {POINT_GOAL}, found {self.policy!r}")
        if min(self.samples, self.batch, self.held_steps, self.checkpoint_steps) < 1 or self.held_samples < 0:
            raise ValueError("expected samples, batch, held_steps and checkpoint_steps from 1, held_samples from 0 on")
        if self.batch % self.sample.group:
            raise ValueError(f"batch: expected a multiple of sample.group ({self.sample.group}), found {self.batch}")
        if not 0 <= self.go_on_share <= 1:
            raise ValueError(f"go_on_share: expected 0 to 1, found {self.go_on_share}")


def budget(recipe: Recipe) -> list[tuple[str, int, str]]:
    """(what, how many, which measured rate) before there are drives: they are planned as for fine-tuning."""
    from tools.train.sft import PLANNED_DRIVE_S

    config = recipe.imitate or ImitateConfig()
    seconds = round(PLANNED_DRIVE_S * recipe.collect.episodes) if recipe.collect is not None else 0
    states = [("semantic states", seconds * config.states.draws, "kv")] if config.policy == TIC_VLA else []
    return [*states, ("samples learned", config.samples, "imitate")]


def run(job: StageJob) -> dict[str, Any]:
    """Train on the run's drives; leaves the network with its new action expert, or the point-goal network.

    Raises ImitateError, SampleError, LatencyError, DriveError, TokenCacheError, KvCacheError, NetworkFileError.
    """
    config = _config(job)
    dataset = Dataset.open(job.run_dir.stage("collect"))
    network, share = _start(job, config)
    tokens = TokenCache(dataset, network.vision)
    if tokens.missing():
        job.progress.say("encoding the drives' frames")
    tokens.build(device=job.device, ranks=job.ranks, progress=job.progress)
    network.to(job.device)
    if config.policy == POINT_GOAL:
        return _point_goal(job, network, dataset, tokens)
    job.progress.say("what the language model says along the drives")
    states = build_kv_cache(
        dataset.folder / STATES,
        network,
        tokenizer_for(network.config, None),
        dataset,
        tokens,
        config.states,
        seed=job.recipe.seed,
        ranks=job.ranks,
        progress=job.progress,
    )
    pupil = ExpertPupil(network.action, config.loss)
    result = fit(job, pupil, dataset, tokens, states, of=f"{states.key} {parts_sha256(network)}", share=share)
    if job.ranks.first:
        finish_network(job, STAGE, network.cpu())
    job.ranks.barrier()
    return result


def _point_goal(job: StageJob, network: TicVla, dataset: Dataset, tokens: TokenCache) -> dict[str, Any]:
    student: PointGoalNet = build_point_goal(network.config, job.generator(_START)).to(job.device)
    states = NoStates({entry.id: entry.frames for entry in dataset.entries}, network.config.kv_dim)
    pupil = PointGoalPupil(student, _config(job).loss)
    result = fit(job, pupil, dataset, tokens, states, of=parts_sha256(network, ("vision",)))
    if job.ranks.first:
        path = job.run_dir.stage(STAGE) / POINT_GOAL_FILE
        save_point_goal(student, path, f"edge-train {job.recipe.name}, seed {job.recipe.seed}, after {STAGE}")
    job.ranks.barrier()
    return result


def _start(job: StageJob, config: ImitateConfig) -> tuple[TicVla, float]:
    """The network to begin with, and the share of `samples` that it is trained for."""
    rounds = retired(job.run_dir)
    if not rounds or not config.go_on_share or config.policy == POINT_GOAL:
        return start_network(job, STAGE), 1.0
    path = stage_weights(job.run_dir.out, f"{STAGE}-{rounds - 1}")
    return read_network(path, job.recipe.model, job.recipe.seed), config.go_on_share


def fit(
    job: StageJob,
    pupil: Pupil,
    dataset: Dataset,
    tokens: FrameTokens,
    states: States,
    *,
    of: str,
    share: float = 1.0,
) -> dict[str, Any]:
    """Train a pupil in place and say how far its plans are from the expert's; raises ImitateError, SampleError.

    `of`: what frames and states were made with; `share` of the recipe's samples.
    """
    config = _config(job)
    delays = config.delays.load() if config.inject_delay and pupil.hears else Delays.none()
    data = _samples(job, _frames(job, dataset, dataset.train, config.sample), tokens, states, delays, pupil)
    unseen = _frames(job, dataset, dataset.val, config.sample.undisturbed())
    held = _held(job, unseen, tokens, states, delays, pupil)
    pupil.begin(data.drives)
    total = max(1, round(config.samples * share) // config.batch)
    job.ranks.copy_parameters(pupil.module.parameters())
    training = _Training(job, config, pupil, data, held, total, _key(config, dataset, pupil, of, total))
    numbers = training.run()
    result = {
        "steps": total,
        "drives": len(data.drives),
        "frames": sum(len(drive) for drive in data.drives),
        "mean_age_s": delays.mean_s,
        **numbers,
    }
    # Of every age, whatever was trained under.
    looked = _held(job, unseen, tokens, states, Delays.uniform(DelayConfig()), pupil) if pupil.hears else held
    if job.ranks.first and looked is not None:
        result["held_out"] = evaluate(
            pupil.plan, looked, config.evaluate, seed=job.seed, device=torch.device(job.device), words=pupil.hears
        )
        draw_errors(result["held_out"], job.run_dir.curves / f"{STAGE}_errors.png")
    return result


def _frames(job: StageJob, dataset: Dataset, ids: Sequence[str], config: SampleConfig) -> list[DriveFrames]:
    steps = job.recipe.model.action.steps
    return [DriveFrames.of(drive, steps, config.weights) for drive in dataset.drives(ids, pictures=False)]


def _samples(
    job: StageJob,
    drives: Sequence[DriveFrames],
    tokens: FrameTokens,
    states: States,
    delays: Delays,
    pupil: Pupil,
    *,
    held: bool = False,
) -> Samples:
    config, model = _config(job).sample, job.recipe.model
    if not pupil.hears:
        # What the state is made of is of no interest to who does not look at it.
        model = replace(model, action=replace(model.action, semantic_interface="kv"))
    return Samples(drives, tokens, states, delays, config.undisturbed() if held else config, model, drop=not held)


def _held(
    job: StageJob, drives: Sequence[DriveFrames], tokens: FrameTokens, states: States, delays: Delays, pupil: Pupil
) -> Samples | None:
    """Samples of held-out layouts as they are; None where there are none."""
    try:
        return _samples(job, drives, tokens, states, delays, pupil, held=True)
    except SampleError:
        return None


class _Training:
    """The steps of one run."""

    def __init__(
        self,
        job: StageJob,
        config: ImitateConfig,
        pupil: Pupil,
        data: Samples,
        held: Samples | None,
        total: int,
        key: str,
    ) -> None:
        self._job, self._config, self._pupil = job, config, pupil
        self._data, self._held, self._total, self._key = data, held, total, key
        self._optimiser = Optimiser(pupil.module.parameters(), config.optim, total, job.ranks)
        self._path = job.run_dir.stage(STAGE) / "checkpoint.safetensors"
        self._device = torch.device(job.device)

    def run(self) -> dict[str, float]:
        """All steps that are left; the newest numbers. Raises ImitateError, and KeyboardInterrupt when told to end."""
        job, config, optimiser = self._job, self._config, self._optimiser
        numbers = self._load()
        with Ahead(self._groups) as ahead:
            while optimiser.step_count < self._total:
                lr = optimiser.lr
                numbers["loss"] = self._learn(ahead.at(optimiser.step_count, self._total))
                step = optimiser.step_count
                line = {"loss": numbers["loss"], "lr": lr}
                if self._held is not None and (step % config.held_steps == 0 or step == self._total):
                    ahead.rest()
                    line["held_loss"] = numbers["held_loss"] = self._look(self._held)
                if job.ranks.first:
                    job.run_dir.log(STAGE, step, **line)
                job.progress.update(step, self._total, **numbers)
                stopping = job.should_stop()
                if stopping or step % config.checkpoint_steps == 0 or step == self._total:
                    self._save(numbers)
                if stopping and step < self._total:
                    raise KeyboardInterrupt
        return numbers

    def _groups(self, step: int) -> list[Group]:
        """This rank's share of a step's groups, each drawn from a generator of its own."""
        count = self._config.batch // self._data.group
        own = range(count)[self._job.ranks.rank :: self._job.ranks.world]
        return [self._data.draw(np.random.default_rng((self._job.seed, _DRAWS, step, number))) for number in own]

    def _learn(self, groups: list[Group]) -> float:
        """One step; the mean loss over all ranks."""
        value, weight = 0.0, float(len(groups))
        if groups:
            batch = collate(groups, self._device)
            loss = self._errors(batch, self._optimiser.step_count).mean()
            loss.backward()
            value = float(loss.detach())
        self._optimiser.step(weight)
        return self._job.ranks.mean(value, weight)

    def _errors(self, batch: ActionBatch, step: int) -> torch.Tensor:
        generator = self._job.generator(_NOISE, step, self._job.ranks.rank)
        with autocast(self._job.device, self._config.optim.bf16):
            return self._pupil.errors(batch, generator)

    def _look(self, held: Samples) -> float:
        """The loss over held-out samples, always the same ones, shared by the ranks."""
        ranks, seed = self._job.ranks, self._job.seed
        count = -(-self._config.held_samples // held.group)
        each = self._config.batch // held.group
        total, seen = 0.0, 0
        for start in range(ranks.rank * each, count, ranks.world * each):
            rngs = [np.random.default_rng((seed, _HELD, number)) for number in range(start, min(start + each, count))]
            batch = collate([held.draw(rng) for rng in rngs], self._device)
            with torch.no_grad():
                total += float(self._errors(batch, start).sum())
            seen += len(batch)
        whole = ranks.sum(seen)
        return ranks.sum(total) / whole if whole else float("nan")

    def _save(self, numbers: dict[str, float]) -> None:
        """Written by the first rank alone: all have the same."""
        if self._job.ranks.first:
            weights = checkpoint.with_prefix("pupil", self._pupil.module.state_dict())
            meta = {"key": self._key, "step": self._optimiser.step_count, "numbers": numbers}
            checkpoint.save(self._path, {**weights, **self._optimiser.tensors()}, meta)

    def _load(self) -> dict[str, float]:
        """Go on if asked to and able to; gives the last numbers. Raises ImitateError for another run's checkpoint."""
        step, numbers = -1, {}
        if self._job.resume and self._path.exists():
            tensors, meta = checkpoint.load(self._path)
            if meta["key"] != self._key:
                raise ImitateError(
                    f"{self._path}: of other drives, other states or another recipe; delete it to begin anew"
                )
            self._pupil.module.load_state_dict(checkpoint.under("pupil", tensors))
            self._optimiser.restore(tensors)
            step, numbers = int(meta["step"]), dict(meta["numbers"])
        if self._job.ranks.first:
            self._job.run_dir.rewind(STAGE, step)
        return numbers


def _config(job: StageJob) -> ImitateConfig:
    if job.recipe.imitate is None:
        raise ImitateError("the recipe has no table [imitate]")
    return job.recipe.imitate


def _key(config: ImitateConfig, dataset: Dataset, pupil: Pupil, of: str, total: int) -> str:
    """What a checkpoint must have been made with to be gone on from."""
    made = {
        "config": asdict(config),
        "dataset": dataset.sha256,
        "of": of,
        "total": total,
        "pupil": {name: list(tensor.shape) for name, tensor in pupil.module.state_dict().items()},
    }
    return hashlib.sha256(json.dumps(made, sort_keys=True).encode()).hexdigest()
