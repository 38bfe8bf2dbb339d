"""Stage 1: the language model learns reasoning text with waypoints, and waypoints alone; the encoder is frozen (eq. 3).

All random choices (wording, previous progress, kind of answer, order) are functions of seed and epoch. An interrupted
run resumes exactly, and the number of ranks does not change the batches.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch
from tokenizers import Tokenizer

from edge.state.reasoning_text import format_text
from export.checkpoint.tokenizer import tokenizer_for
from export.model.network import TicVla
from tools.train.collect.collection import build_tours, of_tour, tour_anchors
from tools.train.config.checks import OptimConfig, TrainError
from tools.train.config.sft import DrawConfig, SftConfig, ShowConfig
from tools.train.drives.drive import Dataset
from tools.train.run.distributed import autocast
from tools.train.run.job import StageJob
from tools.train.run.loop import Optimiser, TrainingLoop
from tools.train.run.network_file import finish_network, read_network, stage_weights, start_network
from tools.train.run.run_dir import drives_after
from tools.train.samples.anchors import Anchor, Prompts, anchors_of, draw, waiting
from tools.train.samples.augment import disturbed, shifted
from tools.train.samples.kv_cache import parts_sha256
from tools.train.samples.language_batch import Halves, LanguageBatch, Row, buckets, collate, row_losses
from tools.train.samples.mirror import FOLDER as MIRRORED
from tools.train.samples.mirror import Joined, SecondsDataset, Views, mirrored
from tools.train.samples.tokens import TokenCache
from tools.train.sft.language_eval import GreedyDecoder, evaluate, evaluate_epoch
from tools.train.sft.relabel import InstructionRelabels

STAGE: Final = "sft"
_DRAWS, _ORDER, _HELD, _NOISE, _AGAIN = 0x5F71, 0x5F72, 0x5F73, 0x5F74, 0x5F75


@dataclass(frozen=True)
class Sample:
    """One drawn prompt and answer as token ids, int32, with its anchor, which may be mirrored."""

    anchor: int
    in_mirror: bool
    prompt: npt.NDArray[np.int32]
    answer: npt.NDArray[np.int32]
    frames: tuple[int, ...]
    noise_seed: int | None = None
    """Seed of the noise on visual tokens; None: no noise."""

    def __len__(self) -> int:
        return len(self.prompt) + len(self.answer)


class Samples:
    """Draws samples from anchors."""

    def __init__(
        self, anchors: Sequence[Anchor], prompts: Prompts, views: Views, words: DrawConfig, mirrored: float = 0.0,
        deciding: int = 1, shown: ShowConfig | None = None,
    ) -> None:  # fmt: skip
        """`mirrored`: share of mirrored samples; `deciding`: repetitions of a deciding anchor; `shown`: augmentation of
        frames (None: none)."""
        self.anchors = tuple(anchors)
        self._shown = [i for i, each in enumerate(self.anchors) for _ in range(deciding if each.decides else 1)]
        self._prompts = prompts
        self._views = views
        self._words = words
        self._mirrored = mirrored
        self._show = shown

    def __len__(self) -> int:
        return len(self._shown)

    def draw(self, rng: np.random.Generator) -> list[Sample]:
        """Draw one sample of every anchor, and `deciding` samples of deciding anchors."""
        drawn: list[Sample] = []
        for index in self._shown:
            anchor = self.anchors[index]
            in_mirror = bool(rng.uniform() < self._mirrored)
            seed = None
            if self._show is not None:
                near, seed = shifted(anchor, self._show, rng), int(rng.integers(2**31))
                # Mirrored drives have tokens at whole seconds alone.
                anchor = anchor if in_mirror else near
            view = mirrored(anchor) if in_mirror else anchor
            prompt, answer = self._prompts.of(view, draw(view, self._words, rng))
            ids = np.array(prompt, np.int32), np.array(answer, np.int32)
            drawn.append(Sample(index, in_mirror, *ids, anchor.frames, seed))
        return drawn

    def rows(self, samples: Sequence[Sample]) -> list[Row]:
        """Add the frames' visual tokens to samples."""
        return [
            Row(
                tuple(each.prompt.tolist()),
                tuple(each.answer.tolist()),
                self._frames(each),
            )
            for each in samples
        ]

    def _frames(self, sample: Sample) -> tuple[Halves, ...]:
        anchor = replace(self.anchors[sample.anchor], frames=sample.frames)
        frames = self._views.of(anchor, in_mirror=sample.in_mirror)
        if self._show is None or sample.noise_seed is None:
            return frames
        return disturbed(frames, self._show, np.random.default_rng((_NOISE, sample.noise_seed)))


def run(job: StageJob) -> dict[str, Any]:
    """Train on the run's data set and write the network with its new language model. Raises TrainError."""
    config = job.recipe.sft
    dataset = drives_after(job.run_dir, job.recipe, STAGE)
    network, epochs, optim = _start(job, config)
    plain = TokenCache(dataset, network.vision)
    mirror: TokenCache | None = None
    _encode(job, plain, dataset.ids)
    if config.mirrored > 0:
        mirror = TokenCache(SecondsDataset.of(dataset, mirrored=True), network.vision, dataset.folder / MIRRORED)
        _encode(job, mirror, dataset.train)
    job = replace(job, recipe=replace(job.recipe, sft=replace(config, epochs=epochs, optim=optim)))
    more = _relabelled(job, dataset, dataset.train, config.retold.ways)
    views = Views(plain, mirror)
    if config.tours.count:
        tours = _tours(job, dataset)
        views = _with_tours(job, network, views, tours)
        more += tour_anchors(tours, tours.ids)
        more += map(of_tour, _relabelled(job, tours, tours.ids, config.retold.tour_ways))
    result = fit(job, network.to(job.device), dataset, views, more)
    if job.ranks.first:
        finish_network(job, STAGE, network.cpu())
    job.ranks.barrier()
    return result


def _start(job: StageJob, config: SftConfig) -> tuple[TicVla, int, OptimConfig]:
    """Return the initial network, the number of epochs and the optimiser's configuration."""
    rounds = job.run_dir.retired(STAGE)
    if not rounds or not config.go_on_share:
        return start_network(job, STAGE), config.epochs, config.optim
    path = stage_weights(job.run_dir.out, f"{STAGE}-{rounds - 1}")
    optim = replace(config.optim, lr=config.optim.lr * config.go_on_lr_share)
    epochs = max(1, round(config.epochs * config.go_on_share))
    return read_network(path, job.recipe.model, job.recipe.seed), epochs, optim


def _encode(job: StageJob, tokens: TokenCache, ids: Sequence[str]) -> None:
    if tokens.missing(ids):
        job.progress.log("encoding frames")
    tokens.build(ids, device=job.device, ranks=job.ranks, progress=job.progress)


def fit(
    job: StageJob, network: TicVla, dataset: Dataset, views: Views, more: Sequence[Anchor] = ()
) -> dict[str, Any]:  # fmt: skip
    """Train `network.language` in place and return its scores; the other parts are not changed.

    `more`: additional anchors, from relabelled drives and tours.
    """
    config, language = job.recipe.sft, network.language
    tokenizer = tokenizer_for(network.config, None)
    prompts = Prompts(Tokenizer.from_buffer(tokenizer), network.config)
    anchors = [*_anchors(dataset, dataset.train), *_waiting(dataset, dataset.train), *more]
    data = Samples(anchors, prompts, views, config.words, config.mirrored, config.deciding, config.shown)
    held = Samples(list(_anchors(dataset, dataset.val)), prompts, views, config.words)
    if not data.anchors:
        raise TrainError(f"{dataset.folder}: no anchors with reasoning text; collect drives, or import them with texts")
    per_epoch = -(-len(data) // config.batch)
    total = per_epoch * config.epochs
    job.ranks.copy_parameters(language.parameters())
    optimiser = Optimiser(language.parameters(), config.optim, total, job.ranks)
    content = _content(job, dataset, tokenizer, network, more)
    loop = TrainingLoop(job, STAGE, {"language": language}, optimiser, content, config.checkpoint_steps)
    questions = _held(held, config, job.seed)
    decoder = GreedyDecoder(language, prompts, views.plain, config.evaluate)

    def losses(samples: Sequence[Sample]) -> torch.Tensor:
        batch = _batch(job, network, data, samples)
        with autocast(job.device, config.optim.bf16):
            return row_losses(language, batch)

    def scores(step: int) -> dict[str, float]:
        if step % per_epoch:
            return {}
        found = {"held_loss": mean_loss(job, network, held, questions)} if questions else {}
        if job.ranks.first:
            found |= evaluate_epoch(decoder, held.anchors, config.evaluate, seed=job.seed)
        return found

    numbers = loop.run(_shares(job, data, optimiser.step_count, per_epoch), losses, scores)
    result: dict[str, Any] = {
        "steps": total,
        "anchors": len(data.anchors),
        "more_anchors": len(more),
        "held_anchors": len(held.anchors),
        **numbers,
    }
    if job.ranks.first and held.anchors:
        result["held_out"] = evaluate(decoder, held.anchors, config.evaluate, seed=job.seed)
    return result


def mean_loss(job: StageJob, network: TicVla, data: Samples, questions: Sequence[Sample]) -> float:
    """Compute the mean of equation 3 over one or more samples, in batches shared by the ranks."""
    config = job.recipe.sft
    order = sorted(range(len(questions)), key=lambda i: (len(questions[i]), i))
    batches = [order[at : at + config.batch] for at in range(0, len(order), config.batch)]
    total = 0.0
    with torch.no_grad(), autocast(job.device, config.optim.bf16):
        for chosen in batches[job.ranks.rank :: job.ranks.world]:
            batch = _batch(job, network, data, [questions[i] for i in chosen])
            total += float(row_losses(network.language, batch).sum())
    return job.ranks.sum(total) / len(questions)


def _shares(job: StageJob, data: Samples, first: int, per_epoch: int) -> Iterator[Sequence[Sample]]:
    """Yield this rank's share of the batches from step `first` on."""
    config, ranks = job.recipe.sft, job.ranks
    for epoch in range(first // per_epoch, config.epochs):
        samples = data.draw(np.random.default_rng((job.seed, _DRAWS, epoch)))
        order = buckets([len(each) for each in samples], config.batch, np.random.default_rng((job.seed, _ORDER, epoch)))
        for chosen in order[max(0, first - epoch * per_epoch) :]:
            yield [samples[i] for i in chosen[ranks.rank :: ranks.world]]


def _batch(job: StageJob, network: TicVla, data: Samples, samples: Sequence[Sample]) -> LanguageBatch:
    image_id = network.config.language.img_context_id
    return collate(data.rows(samples), img_context_id=image_id, device=torch.device(job.device))


def _held(held: Samples, config: SftConfig, seed: int) -> list[Sample]:
    """Choose fixed samples of held-out layouts, spread over all drives."""
    rng = np.random.default_rng((seed, _HELD))
    samples = held.draw(rng)
    chosen = rng.permutation(len(samples))[: config.held_anchors]
    return [samples[int(i)] for i in sorted(chosen)]


def _anchors(dataset: Dataset, ids: Sequence[str]) -> Iterator[Anchor]:
    for drive in dataset.drives(ids, pictures=False):
        yield from anchors_of(drive)


def _tours(job: StageJob, dataset: Dataset) -> Dataset:
    """Return the tours to train on; missing ones are recorded."""
    config, rounds = job.recipe.sft, job.run_dir.retired(STAGE)
    job.progress.log("recording tours")
    tours = build_tours(
        dataset, config.tours, job.recipe.collect, job.recipe.seed, ranks=job.ranks, progress=job.progress,
        stopped=lambda: job.stop.requested,
    )  # fmt: skip
    if not rounds or not config.go_on_share:
        return tours
    chosen = np.random.default_rng((job.recipe.seed, _AGAIN, rounds)).permutation(len(tours))
    entries = (tours.entries[int(i)] for i in sorted(chosen[: round(config.tours_again * len(tours))]))
    return Dataset(tours.folder, tuple(entries))


def _with_tours(job: StageJob, network: TicVla, views: Views, tours: Dataset) -> Views:
    """Add the tokens of tours to those of the drives."""
    seconds = TokenCache(SecondsDataset.of(tours), network.vision)
    _encode(job, seconds, tours.ids)
    mirror = views.mirror
    if mirror is not None:
        other = TokenCache(SecondsDataset.of(tours, mirrored=True), network.vision, tours.folder / MIRRORED)
        _encode(job, other, tours.ids)
        mirror = Joined(mirror, other, frozenset(tours.ids))
    return Views(views.plain, mirror, seconds)


def _relabelled(job: StageJob, dataset: Dataset, ids: tuple[str, ...], ways: int) -> list[Anchor]:
    """Return the anchors of these drives under other instructions; missing relabels are computed."""
    if not ways:
        return []
    recipe = job.recipe
    config = replace(recipe.sft.retold, ways=ways)
    relabels = InstructionRelabels(dataset, config, recipe.seed, recipe.collect.speed_mps)
    job.progress.log("relabelling drives")
    relabels.build(ids, ranks=job.ranks, progress=job.progress, stopped=lambda: job.stop.requested)
    return [anchor for drive in dataset.drives(ids, pictures=False) for anchor in relabels.anchors(drive)]


def _waiting(dataset: Dataset, ids: Sequence[str]) -> Iterator[Anchor]:
    """Yield one anchor per drive of a robot that has waited at its start for one to three generations."""
    for number, drive in enumerate(dataset.drives(ids, pictures=False)):
        for anchor in anchors_of(drive)[:1]:
            yield waiting(anchor, 1 + number % 3)


def _content(
    job: StageJob, dataset: Dataset, tokenizer: bytes, network: TicVla, more: Sequence[Anchor]
) -> dict[str, object]:
    """Return what a checkpoint depends on."""
    return {
        "seed": job.seed,
        "config": asdict(job.recipe.sft),
        "dataset": dataset.sha256,
        "tokenizer": hashlib.sha256(tokenizer).hexdigest(),
        "sizes": asdict(network.config.language),
        "vision": parts_sha256(network, ("vision",)),
        "more": hashlib.sha256("\n".join(format_text(each.reasoning) for each in more).encode()).hexdigest(),
    }
