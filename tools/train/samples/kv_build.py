"""Computation of semantic states: the frozen language model runs on every anchor, with the true or its own text."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final
from zlib import crc32

import numpy as np
import torch
from tokenizers import Tokenizer

from export.model.network import TicVla
from tools.train.config.checks import TrainError
from tools.train.config.imitate import KvConfig
from tools.train.config.sft import DrawConfig
from tools.train.drives.drive import POLICY_DRIVER, Dataset
from tools.train.run.distributed import SINGLE, Ranks
from tools.train.run.job import QuietProgress, StageProgress
from tools.train.samples.anchors import WAYPOINTS_START, Anchor, Drawn, Prompts, anchors_of, draw
from tools.train.samples.greedy import decode
from tools.train.samples.kv_cache import FORMAT, KvCache, Made, begin, write_states
from tools.train.samples.language_batch import FrameTokens, Row, collate, frames_of, run

SEEN_PARTS: Final = ("vision", "language")
"""Parts of the network that a semantic state depends on."""
_TAG: Final = 0x5EE


def parts_sha256(network: TicVla, parts: Iterable[str] = SEEN_PARTS) -> str:
    """Hash the weights of some parts of a network."""
    digest = hashlib.sha256()
    wanted = tuple(parts)
    for name, tensor in sorted(network.state_dict().items()):
        if name.split(".")[0] in wanted:
            digest.update(f"{name}:{tuple(tensor.shape)}:{tensor.dtype}".encode())
            digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


def cache_key(network: TicVla, tokenizer: bytes, config: KvConfig, seed: int) -> str:
    """Hash everything that states depend on, except their drive."""
    settings = {key: value for key, value in asdict(config).items() if key != "batch"}
    sizes = network.config.to_dict()
    made = {
        "format": FORMAT,
        "weights": parts_sha256(network),
        "sizes": {part: sizes[part] for part in SEEN_PARTS},
        "tokenizer": hashlib.sha256(tokenizer).hexdigest(),
        "config": settings,
        "seed": seed,
    }
    return hashlib.sha256(json.dumps(made, sort_keys=True).encode()).hexdigest()


def build_kv_cache(
    folder: Path,
    network: TicVla,
    tokenizer: bytes,
    dataset: Dataset,
    tokens: FrameTokens,
    config: KvConfig,
    *,
    seed: int,
    ids: Sequence[str] | None = None,
    ranks: Ranks = SINGLE,
    progress: StageProgress | None = None,
) -> KvCache:
    """Compute the missing states of all drives (or `ids`) and open the cache, a folder under `folder`.

    The network runs on the device of its weights; ranks share the drives. Raises TrainError for values beyond
    float16, OSError.
    """
    key = cache_key(network, tokenizer, config, seed)
    place = folder / key[:16]
    if ranks.first:
        begin(place, key=key, kv_dim=network.config.kv_dim, draws=config.draws)
    ranks.barrier()
    cache = KvCache(place)
    wanted = set(dataset.ids if ids is None else ids)
    entries = [entry for entry in dataset.entries if entry.id in wanted]
    # Divide the whole list: the list of missing drives changes while other ranks work.
    own = [entry for entry in entries[ranks.rank :: ranks.world] if not cache.has(entry.id, entry.sha256)]
    prompts = Prompts(Tokenizer.from_buffer(tokenizer), network.config)
    for done, entry in enumerate(own, 1):
        anchors = anchors_of(dataset.load(entry.id, pictures=False), config.every)
        share = config.own_share_policy if entry.driver.startswith(POLICY_DRIVER) else config.own_share
        states = _states(network, prompts, tokens, anchors, config, share, seed)
        write_states(place, entry.id, entry.sha256, states, network.config.kv_dim)
        (progress or QuietProgress()).update(done, len(own))
    ranks.barrier()
    return KvCache(place)


@dataclass(frozen=True)
class _Wanted:
    """One state before it is computed."""

    anchor: Anchor
    number: int
    drawn: Drawn
    own: bool
    prompt: tuple[int, ...]
    answer: tuple[int, ...]
    """The true answer; empty if the model decodes its own."""

    @property
    def tokens(self) -> int:
        """Number of tokens that are fed at once."""
        return len(self.prompt) + len(self.answer)


def _states(
    network: TicVla, prompts: Prompts, tokens: FrameTokens, anchors: Sequence[Anchor], config: KvConfig,
    own_share: float, seed: int,
) -> list[Made]:  # fmt: skip
    """Compute all states of one drive, sorted by frame and draw, in batches of similar length."""
    wanted = [
        _wanted(prompts, anchor, n, config.words, own_share, seed) for anchor in anchors for n in range(config.draws)
    ]
    made: list[Made] = []
    for own in (False, True):
        some = sorted((each for each in wanted if each.own is own), key=lambda each: each.tokens)
        for start in range(0, len(some), config.batch):
            made += _batch(network, prompts, tokens, some[start : start + config.batch], config.max_new_tokens)
    return sorted(made, key=lambda state: (state.k, state.draw))


def _wanted(prompts: Prompts, anchor: Anchor, number: int, words: DrawConfig, own_share: float, seed: int) -> _Wanted:
    """Draw a state's text with its own generator: it does not depend on which other states are computed."""
    rng = np.random.default_rng((seed, _TAG, crc32(anchor.drive_id.encode()), anchor.k, number))
    own = bool(rng.uniform() < own_share)
    drawn = draw(anchor, words, rng)
    prompt, answer = prompts.of(anchor, drawn)
    return _Wanted(anchor, number, drawn, own, prompt, () if own else answer)


@torch.no_grad()
def _batch(
    network: TicVla, prompts: Prompts, tokens: FrameTokens, wanted: Sequence[_Wanted], max_new_tokens: int
) -> list[Made]:
    """Compute states that all have true texts, or all have the model's own."""
    language = network.language
    rows = [
        Row(each.prompt, each.answer, frames_of(tokens, each.anchor.drive_id, each.anchor.frames)) for each in wanted
    ]
    image_id, device = language.config.img_context_id, language.embed.weight.device
    batch = collate(rows, img_context_id=image_id, device=device)
    if wanted[0].own:
        decoded = decode(language, batch, max_new_tokens)
        states, texts = [each.last_layer_kv for each in decoded], [each.ids for each in decoded]
    else:
        # The end token of an answer is not fed: a generation stops before it.
        kv = run(language, batch.input_ids, batch.visual_tokens, None).last_layer_kv
        states = [kv[i, :length] for i, length in enumerate(batch.lengths.tolist())]
        texts = [each.answer[:-1] for each in wanted]
    made: list[Made] = []
    for each, state, ids in zip(wanted, states, texts, strict=True):
        half = state.to(torch.float16).cpu().numpy()
        if not np.isfinite(half).all():
            where = f"drive {each.anchor.drive_id}, frame {each.anchor.k}"
            raise TrainError(f"{where}: keys or values exceed float16; train the language model again")
        text = (WAYPOINTS_START if each.drawn.waypoints_only else "") + prompts.text(ids)
        made.append(Made(each.anchor.k, each.number, half, len(each.prompt), each.own, text))
    return made
