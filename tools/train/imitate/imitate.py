"""Stage 2: the action expert learns to drive by what a frozen language model said seconds ago (Algorithm 1, eq. 4).

Frames' tokens and generations' states come from caches, so that only the action expert computes. Every batch is a pure
function of seed and step: a run that was ended goes on exactly, and any number of processes learns from the same ones.
After a round of DAgger imitation goes on, over all drives, from what it was.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any, Final

import torch

from export.checkpoint import tokenizer_for
from export.model.network import TicVla
from tools.train.config.collect import PLANNED_DRIVE_S
from tools.train.config.imitate import POINT_GOAL, TIC_VLA, DelayConfig, ImitateConfig, SampleConfig
from tools.train.config.recipe import Recipe
from tools.train.drives.drive import Dataset
from tools.train.imitate.data import NoStates, SampleError, Samples, States
from tools.train.imitate.evaluation import draw_errors, evaluate
from tools.train.imitate.mirror_drives import (
    MIRROR,
    BothStates,
    BothTokens,
    Mirror,
    MirroredDrives,
    MirrorTokens,
    balanced,
    mirrored_frames,
)
from tools.train.imitate.mirror_drives import STATES as MIRRORED_STATES
from tools.train.imitate.point_goal_net import PointGoalNet, build_point_goal, save_point_goal
from tools.train.imitate.steps import ImitateError, Training
from tools.train.imitate.trainable_policies import ExpertPupil, PointGoalPupil, Pupil
from tools.train.run.job import StageJob
from tools.train.run.network_file import finish_network, read_network, stage_weights, start_network
from tools.train.run.own_drives import drives_after
from tools.train.samples.delays import Delays
from tools.train.samples.drive_frames import DriveFrames
from tools.train.samples.kv_build import SEEN_PARTS, build_kv_cache, parts_sha256
from tools.train.samples.kv_cache import KvCache
from tools.train.samples.language_batch import FrameTokens
from tools.train.samples.mirror import FOLDER as MIRRORED
from tools.train.samples.mirror import SecondsDataset
from tools.train.samples.tokens import TokenCache
from tools.train.scenes.walls import Scenes

STAGE: Final = "imitate"
STATES: Final = "kv"
"""Folder of the semantic states, beside the drives."""
POINT_GOAL_FILE: Final = "point_goal.safetensors"
_START: Final = 0x1A14


def budget(recipe: Recipe) -> list[tuple[str, int, str]]:
    """(what, how many, which measured rate) before there are drives: they are planned as for fine-tuning."""
    config = recipe.imitate or ImitateConfig()
    seconds = round(PLANNED_DRIVE_S * recipe.collect.episodes) if recipe.collect is not None else 0
    states = [("semantic states", seconds * config.states.draws, "kv")] if config.policy == TIC_VLA else []
    return [*states, ("samples learned", config.samples, "imitate")]


def run(job: StageJob) -> dict[str, Any]:
    """Train on the run's drives; leaves the network with its new action expert, or the point-goal network.

    Raises ImitateError, SampleError, LatencyError, DriveError, TokenCacheError, KvCacheError, NetworkFileError.
    """
    config = _config(job)
    dataset = drives_after(job, STAGE)
    network, share = _start(job, config)
    tokens = _encoded(job, TokenCache(dataset, network.vision), dataset.ids)
    seconds: TokenCache | None = None
    if config.mirrored:
        seconds = TokenCache(SecondsDataset.of(dataset, mirrored=True), network.vision, dataset.folder / MIRRORED)
        _encoded(job, seconds, dataset.train)
    network.to(job.device)
    if config.policy == POINT_GOAL:
        return _point_goal(job, network, dataset, tokens, seconds)
    states = _said(job, network, dataset, tokens, STATES, dataset.ids)
    mirror = None
    if seconds is not None:
        seen = MirrorTokens(seconds)
        mirror = Mirror(seen, _said(job, network, MirroredDrives.of(dataset), seen, MIRRORED_STATES, dataset.train))
    own = None
    if config.evaluate.own_words and dataset.val:
        own = _said(job, network, dataset, tokens, STATES, dataset.val, own=True)
    pupil = ExpertPupil(network.action, config.loss)
    of = f"{states.key} {parts_sha256(network, (*SEEN_PARTS, 'action'))}"
    result = fit(job, pupil, dataset, tokens, states, of=of, share=share, mirror=mirror, own=own)
    if job.ranks.first:
        finish_network(job, STAGE, network.cpu())
    job.ranks.barrier()
    return result


def _encoded(job: StageJob, tokens: TokenCache, ids: Sequence[str]) -> TokenCache:
    if tokens.missing(ids):
        job.progress.say("encoding frames")
    tokens.build(ids, device=job.device, ranks=job.ranks, progress=job.progress)
    return tokens


def _said(
    job: StageJob,
    network: TicVla,
    dataset: Dataset,
    tokens: FrameTokens,
    folder: str,
    ids: Sequence[str],
    *,
    own: bool = False,
) -> KvCache:
    """States along drives: of what is true there, or (`own`) of what the language model says itself."""
    config = _config(job).states
    job.progress.say("semantic states")
    return build_kv_cache(
        dataset.folder / folder,
        network,
        tokenizer_for(network.config, None),
        dataset,
        tokens,
        replace(config, draws=1, own_share=1.0, own_share_policy=1.0) if own else config,
        # Of the run, not of the stage: ablations of one seed share their states.
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
    mirror = None if seconds is None else Mirror(MirrorTokens(seconds), states)
    pupil = PointGoalPupil(student, _config(job).loss)
    result = fit(job, pupil, dataset, tokens, states, of=parts_sha256(network, ("vision",)), mirror=mirror)
    if job.ranks.first:
        path = job.run_dir.stage(STAGE) / POINT_GOAL_FILE
        save_point_goal(student, path, f"edge-train {job.recipe.name}, seed {job.recipe.seed}, after {STAGE}")
    job.ranks.barrier()
    return result


def _start(job: StageJob, config: ImitateConfig) -> tuple[TicVla, float]:
    """The network to begin with, and the share of `samples` that it is trained for."""
    network, rounds = start_network(job, STAGE), job.run_dir.retired(STAGE)
    if not rounds or not config.go_on_share or config.policy == POINT_GOAL:
        return network, 1.0
    path = stage_weights(job.run_dir.out, f"{STAGE}-{rounds - 1}")
    # The action expert alone: the language model may have gone on since.
    network.action.load_state_dict(read_network(path, job.recipe.model, job.recipe.seed).action.state_dict())
    return network, config.go_on_share


def fit(
    job: StageJob,
    pupil: Pupil,
    dataset: Dataset,
    tokens: FrameTokens,
    states: States,
    *,
    of: str,
    share: float = 1.0,
    mirror: Mirror | None = None,
    own: States | None = None,
) -> dict[str, Any]:
    """Train a pupil in place and say how far its plans are from the expert's; raises ImitateError, SampleError.

    `of`: what frames and states were made with; `share` of the recipe's samples; `mirror`: of the drives to learn from;
    `own`: states of the held-out drives with what the language model says itself.
    """
    config = _config(job)
    delays = Delays.of(config.delays) if config.inject_delay and pupil.hears else Delays.none()
    scenes = Scenes() if config.loss.walls else None
    drives = _frames(job, dataset, dataset.train, config.sample, scenes)
    if mirror is not None:
        reflected = _frames(job, MirroredDrives.of(dataset), dataset.train, config.sample, scenes)
        drives = balanced(drives, [mirrored_frames(drive) for drive in reflected], config.mirrored)
        tokens, states = BothTokens(tokens, mirror.tokens), BothStates(states, mirror.states)
    data = _samples(job, drives, tokens, states, delays, pupil)
    unseen = _frames(job, dataset, dataset.val, config.sample.undisturbed(), scenes)
    held = _held(job, unseen, tokens, states, delays, pupil)
    pupil.begin(data.drives)
    total = max(1, round(config.samples * share) // config.batch)
    job.ranks.copy_parameters(pupil.module.parameters())
    training = Training(STAGE, job, config, pupil, data, held, total, _key(config, dataset, pupil, of, total))
    numbers = training.run()
    result: dict[str, Any] = {
        "steps": total,
        "drives": len(dataset.train),
        "frames": sum(len(drive) for drive in drives if not drive.id.startswith(MIRROR)),
        "mean_age_s": delays.mean_s,
        **numbers,
    }
    for name, told in (("held_out", states), ("held_out_own", own)):
        # Of every age, whatever was trained under.
        every = Delays.uniform(DelayConfig()) if pupil.hears else delays
        looked = _held(job, unseen, tokens, told, every, pupil) if told is not None else None
        if job.ranks.first and looked is not None:
            result[name] = evaluate(
                pupil.plan, looked, config.evaluate, seed=job.seed, device=torch.device(job.device), words=pupil.hears
            )
            draw_errors(result[name], job.run_dir.curves / f"{STAGE}_{name}.png")
    return result


def _frames(
    job: StageJob, dataset: Dataset, ids: Sequence[str], config: SampleConfig, scenes: Scenes | None
) -> list[DriveFrames]:
    """`scenes`: where walls are looked at."""
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
