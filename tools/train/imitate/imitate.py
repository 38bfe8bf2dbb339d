"""Stage 2: the action expert learns to drive with delayed states of a frozen language model (Algorithm 1, eq. 4).

Visual tokens and semantic states come from caches, so that only the action expert computes. Every batch is a function
of seed and step: an interrupted run resumes exactly, and the number of processes does not change the batches. After a
DAgger round imitation continues from its weights on all drives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any, Final

import numpy as np
import torch

from export.checkpoint.tokenizer import tokenizer_for
from export.model.network import TicVla
from tools.train.config.imitate import POINT_GOAL, DelayConfig, ImitateConfig, SampleConfig
from tools.train.drives.drive import Dataset
from tools.train.drives.walls import Scenes
from tools.train.imitate.data import Delays, NoStates, SampleError, Samples, Source, States
from tools.train.imitate.evaluation import evaluate
from tools.train.imitate.trainable_policies import (
    ActionExpertPolicy,
    PointGoalNet,
    PointGoalNetPolicy,
    TrainablePolicy,
    build_point_goal,
    save_point_goal,
)
from tools.train.run.distributed import autocast
from tools.train.run.job import StageJob
from tools.train.run.loop import Ahead, Optimiser, TrainingLoop
from tools.train.run.network_file import finish_network, read_network, stage_weights, start_network
from tools.train.run.run_dir import drives_after
from tools.train.samples.action_batch import Group, collate
from tools.train.samples.drive_frames import DriveFrames
from tools.train.samples.kv_cache import SEEN_PARTS, KvCache, build_kv_cache, parts_sha256
from tools.train.samples.language_batch import FrameTokens
from tools.train.samples.mirror import FOLDER as MIRRORED
from tools.train.samples.mirror import STATES as MIRRORED_STATES
from tools.train.samples.mirror import MirroredDrives, MirrorTokens, SecondsDataset, balanced, mirrored_frames
from tools.train.samples.tokens import TokenCache

STAGE: Final = "imitate"
STATES: Final = "kv"
"""Folder of the semantic states, in the data set."""
POINT_GOAL_FILE: Final = "point_goal.safetensors"
_DRAWS, _HELD, _NOISE, _START = 0x1A11, 0x1A12, 0x1A13, 0x1A14


def run(job: StageJob) -> dict[str, Any]:
    """Train on the run's drives and write the network with its new action expert, or the point-goal network.

    Raises TrainError, SampleError, LatencyError.
    """
    config = job.recipe.imitate
    dataset = drives_after(job.run_dir, job.recipe, STAGE)
    network, share = _start(job, config)
    tokens = _encoded(job, TokenCache(dataset, network.vision), dataset.ids)
    seconds: TokenCache | None = None
    if config.mirrored:
        seconds = TokenCache(SecondsDataset.of(dataset, mirrored=True), network.vision, dataset.folder / MIRRORED)
        _encoded(job, seconds, dataset.train)
    network.to(job.device)
    if config.policy == POINT_GOAL:
        return _point_goal(job, network, dataset, tokens, seconds)
    states = _states(job, network, dataset, tokens, STATES, dataset.ids)
    mirror = None
    if seconds is not None:
        mirror_tokens, mirrored = MirrorTokens(seconds), MirroredDrives.of(dataset)
        mirror = Source(mirror_tokens, _states(job, network, mirrored, mirror_tokens, MIRRORED_STATES, dataset.train))
    own = None
    if config.evaluate.own_words and dataset.val:
        own = _states(job, network, dataset, tokens, STATES, dataset.val, own=True)
    policy = ActionExpertPolicy(network.action, config.loss)
    of = f"{states.key} {parts_sha256(network, (*SEEN_PARTS, 'action'))}"
    result = fit(job, policy, dataset, tokens, states, of=of, share=share, mirror=mirror, own=own)
    if job.ranks.first:
        finish_network(job, STAGE, network.cpu())
    job.ranks.barrier()
    return result


def _encoded(job: StageJob, tokens: TokenCache, ids: Sequence[str]) -> TokenCache:
    if tokens.missing(ids):
        job.progress.log("encoding frames")
    tokens.build(ids, device=job.device, ranks=job.ranks, progress=job.progress)
    return tokens


def _states(
    job: StageJob,
    network: TicVla,
    dataset: Dataset,
    tokens: FrameTokens,
    folder: str,
    ids: Sequence[str],
    *,
    own: bool = False,
) -> KvCache:
    """Build the semantic states of drives with the true text, or (`own`) with text that the language model decodes."""
    config = job.recipe.imitate.states
    job.progress.log("semantic states")
    return build_kv_cache(
        dataset.folder / folder,
        network,
        tokenizer_for(network.config, None),
        dataset,
        tokens,
        replace(config, draws=1, own_share=1.0, own_share_policy=1.0) if own else config,
        # The run's seed, not the stage's: ablations of one seed share their states.
        seed=job.recipe.seed,
        ids=ids,
        ranks=job.ranks,
        progress=job.progress,
    )


def _point_goal(
    job: StageJob, network: TicVla, dataset: Dataset, tokens: TokenCache, seconds: TokenCache | None
) -> dict[str, Any]:
    student: PointGoalNet = build_point_goal(network.config, job.generator(_START)).to(job.device)
    states = NoStates({entry.id: entry.frames for entry in dataset.entries}, network.config.kv_dim)
    mirror = None if seconds is None else Source(MirrorTokens(seconds), states)
    policy = PointGoalNetPolicy(student, job.recipe.imitate.loss)
    result = fit(job, policy, dataset, tokens, states, of=parts_sha256(network, ("vision",)), mirror=mirror)
    if job.ranks.first:
        path = job.run_dir.stage(STAGE) / POINT_GOAL_FILE
        save_point_goal(student, path, f"edge-train {job.recipe.name}, seed {job.recipe.seed}, after {STAGE}")
    job.ranks.barrier()
    return result


def _start(job: StageJob, config: ImitateConfig) -> tuple[TicVla, float]:
    """Return the initial network and the share of `samples` that it is trained on."""
    network, rounds = start_network(job, STAGE), job.run_dir.retired(STAGE)
    if not rounds or not config.go_on_share or config.policy == POINT_GOAL:
        return network, 1.0
    path = stage_weights(job.run_dir.out, f"{STAGE}-{rounds - 1}")
    # The action expert alone: the language model may have been trained further since.
    network.action.load_state_dict(read_network(path, job.recipe.model, job.recipe.seed).action.state_dict())
    return network, config.go_on_share


def fit(
    job: StageJob,
    policy: TrainablePolicy,
    dataset: Dataset,
    tokens: FrameTokens,
    states: States,
    *,
    of: str,
    share: float = 1.0,
    mirror: Source | None = None,
    own: States | None = None,
) -> dict[str, Any]:
    """Train a policy in place and return its errors against the expert. Raises TrainError, SampleError.

    `of`: hash of what tokens and states were computed with; `share` of the recipe's samples; `mirror`: mirrored
    training drives; `own`: states of the held-out drives with text that the language model decoded.
    """
    config = job.recipe.imitate
    delays = Delays.of(config.delays) if config.inject_delay and policy.uses_semantics else Delays.none()
    scenes = Scenes() if config.loss.walls else None
    drives = _frames(job, dataset, dataset.train, config.sample, scenes)
    if mirror is not None:
        reflected = _frames(job, MirroredDrives.of(dataset), dataset.train, config.sample, scenes)
        drives = balanced(drives, [mirrored_frames(drive) for drive in reflected], config.mirrored)
    data = _samples(job, drives, tokens, states, delays, policy, mirror)
    unseen = _frames(job, dataset, dataset.val, config.sample.undisturbed(), scenes)
    held = _held_out(job, unseen, tokens, states, delays, policy)
    policy.begin(data.drives)
    total = max(1, round(config.samples * share) // config.batch)
    job.ranks.copy_parameters(policy.module.parameters())
    optimiser = Optimiser(policy.module.parameters(), config.optim, total, job.ranks)
    shapes = {name: list(tensor.shape) for name, tensor in policy.module.state_dict().items()}
    content = {"config": asdict(config), "dataset": dataset.sha256, "of": of, "total": total, "pupil": shapes}
    loop = TrainingLoop(job, STAGE, {"pupil": policy.module}, optimiser, content, config.checkpoint_steps)
    with Ahead(lambda step: _share(job, data, step)) as ahead:

        def evaluate_loss(step: int) -> dict[str, float]:
            if held is None or (step % config.held_steps and step != total):
                return {}
            ahead.rest()
            return {"held_loss": _held_loss(job, policy, held)}

        numbers = loop.run(
            ahead.steps(optimiser.step_count, total),
            lambda groups: _losses(job, policy, groups, optimiser.step_count),
            evaluate_loss,
        )
    result: dict[str, Any] = {
        "steps": total,
        "drives": len(dataset.train),
        "frames": sum(len(drive) for drive in drives if not drive.in_mirror),
        "mean_age_s": delays.mean_s,
        **numbers,
    }
    for name, given in (("held_out", states), ("held_out_own", own)):
        # Evaluate at all delays, whatever the delays in training.
        every = Delays.uniform(DelayConfig()) if policy.uses_semantics else delays
        samples = _held_out(job, unseen, tokens, given, every, policy) if given is not None else None
        if job.ranks.first and samples is not None:
            result[name] = evaluate(
                policy.plan, samples, config.evaluate, seed=job.seed, device=torch.device(job.device),
                semantics=policy.uses_semantics,
            )  # fmt: skip
    return result


def _share(job: StageJob, data: Samples, step: int) -> list[Group]:
    """Draw this rank's share of a step's groups, each from its own generator."""
    own = range(job.recipe.imitate.batch // data.group)[job.ranks.rank :: job.ranks.world]
    return [data.draw(np.random.default_rng((job.seed, _DRAWS, step, number))) for number in own]


def _losses(job: StageJob, policy: TrainablePolicy, groups: Sequence[Group], step: int) -> torch.Tensor:
    generator = job.generator(_NOISE, step, job.ranks.rank)
    batch = collate(groups, torch.device(job.device))
    with autocast(job.device, job.recipe.imitate.optim.bf16):
        return policy.errors(batch, generator)


def _held_loss(job: StageJob, policy: TrainablePolicy, held: Samples) -> float:
    """Compute the loss over the fixed held-out samples, distributed over the ranks."""
    config, ranks = job.recipe.imitate, job.ranks
    count, each = -(-config.held_samples // held.group), config.batch // held.group
    total, seen = 0.0, 0
    for start in range(ranks.rank * each, count, ranks.world * each):
        numbers = range(start, min(start + each, count))
        groups = [held.draw(np.random.default_rng((job.seed, _HELD, number))) for number in numbers]
        with torch.no_grad():
            errors = _losses(job, policy, groups, start)
        total += float(errors.sum())
        seen += len(errors)
    whole = ranks.sum(seen)
    return ranks.sum(total) / whole if whole else float("nan")


def _frames(
    job: StageJob, dataset: Dataset, ids: Sequence[str], config: SampleConfig, scenes: Scenes | None
) -> list[DriveFrames]:
    """Load the drives' frames; with `scenes` also the walls around them."""
    steps, in_mirror = job.recipe.model.action.steps, isinstance(dataset, MirroredDrives)
    return [
        DriveFrames.of(
            drive, steps, config.weights, None if scenes is None else scenes.along(drive, in_mirror=in_mirror)
        )
        for drive in dataset.drives(ids, pictures=False)
    ]


def _samples(
    job: StageJob,
    drives: Sequence[DriveFrames],
    tokens: FrameTokens,
    states: States,
    delays: Delays,
    policy: TrainablePolicy,
    mirror: Source | None = None,
    *,
    held: bool = False,
) -> Samples:
    config, model = job.recipe.imitate.sample, job.recipe.model
    if not policy.uses_semantics:
        # Such a policy works with any semantic interface.
        model = replace(model, action=replace(model.action, semantic_interface="kv"))
    used = config.undisturbed() if held else config
    return Samples(drives, tokens, states, delays, used, model, mirror=mirror, drop=not held)


def _held_out(
    job: StageJob, drives: Sequence[DriveFrames], tokens: FrameTokens, states: States, delays: Delays,
    policy: TrainablePolicy,
) -> Samples | None:  # fmt: skip
    """Return undisturbed samples of held-out layouts; None if there are none."""
    try:
        return _samples(job, drives, tokens, states, delays, policy, held=True)
    except SampleError:
        return None
