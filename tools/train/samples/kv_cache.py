"""Cache of semantic states: the frozen language model's last-layer K‖V at every anchor (paper, Algorithm 1, line 5).

A folder contains `kv.json` (its key) and, for each drive, `ID.npy` f16 [tokens, kv_dim] with all states in sequence and
`ID.json` with their positions. Both are written atomically, so that an interrupted run continues with the next drive;
for drives that are added later (DAgger), only their states are computed.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final
from zlib import crc32

import numpy as np
import torch
from tokenizers import Tokenizer

from edge.core.cli import write_whole
from edge.state.reasoning_text import Waypoints, parse_waypoints
from export.model.network import TicVla
from firmware_bridge.system.input_file import read_json
from tools.train.config.checks import TrainError
from tools.train.config.imitate import KvConfig
from tools.train.config.sft import DrawConfig
from tools.train.drives.drive import POLICY_DRIVER, Dataset
from tools.train.run.distributed import SINGLE, Ranks
from tools.train.run.job import QuietProgress, StageProgress
from tools.train.samples.anchors import WAYPOINTS_START, Anchor, Drawn, Prompts, anchors_of, draw
from tools.train.samples.language_batch import FrameTokens, Halves, Row, collate, decode, frames_of, run
from tools.train.samples.tokens import tensors_sha256

FORMAT: Final = 1
INDEX: Final = "kv.json"
_MAX_OPEN: Final = 256  # open mapped files; a process may have 1024 file descriptors


@dataclass(frozen=True)
class CachedState:
    """State of one generation: K‖V of prompt and text, read-only and mapped from the file."""

    kv: Halves
    """[T, kv_dim]; the first `prompt_tokens` rows belong to the prompt."""
    prompt_tokens: int
    text: str
    own: bool
    """Whether the model decoded the text; else it is the true text."""

    @property
    def waypoints(self) -> Waypoints | None:
        """(x m, y m) at 3, 6, 9 s in the robot frame at the anchor; None if the text has no valid waypoints."""
        return parse_waypoints(self.text)


Made = tuple[int, int, CachedState]
"""Frame, number of the draw, and the state."""


@dataclass(frozen=True)
class _Place:
    k: int
    draw: int
    start: int
    tokens: int
    prompt_tokens: int
    own: bool
    text: str


class KvCache:
    """Read access to a cache; arrays are mapped from the files, not copied."""

    def __init__(self, folder: Path) -> None:
        """Open a folder that `build_kv_cache` wrote. Raises TrainError."""
        self.folder = folder
        try:
            content = read_json(folder / INDEX)
            if content["format"] != FORMAT:
                raise TrainError(f"{folder}: expected a cache of format {FORMAT}; delete it and build it again")
            self.key: str = content["key"]
            self.kv_dim: int = content["kv_dim"]
            self.draws: int = content["draws"]
            """Number of states of each anchor, with different wordings and previous progress."""
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise TrainError(f"{folder}: no cache of keys and values ({error!r}); build it first") from error
        self._indices: dict[str, dict[tuple[int, int], _Place]] = {}
        self._maps: OrderedDict[str, Halves] = OrderedDict()

    def has(self, drive_id: str, sha256: str) -> bool:
        """Return whether the cache contains a drive with this hash of its file."""
        try:
            return bool(_read(self.folder, drive_id)["drive_sha256"] == sha256) and _npy(self.folder, drive_id).exists()
        except TrainError:
            return False

    def anchors(self, drive_id: str) -> tuple[int, ...]:
        """Return the frames of a drive that have a state, ascending. Raises TrainError for a missing drive."""
        return tuple(sorted({k for k, _ in self._index(drive_id)}))

    def at(self, drive_id: str, k: int, draw: int = 0) -> CachedState:
        """Return state number `draw` of the generation whose newest frame is k. Raises TrainError if missing."""
        place = self._index(drive_id).get((k, draw))
        if place is None:
            raise TrainError(f"drive {drive_id}: no state of frame {k}, draw {draw}")
        rows = self._map(drive_id)[place.start : place.start + place.tokens]
        return CachedState(rows, place.prompt_tokens, place.text, place.own)

    def _index(self, drive_id: str) -> dict[tuple[int, int], _Place]:
        if drive_id not in self._indices:
            places = [_Place(**place) for place in _read(self.folder, drive_id)["states"]]
            self._indices[drive_id] = {(place.k, place.draw): place for place in places}
        return self._indices[drive_id]

    def _map(self, drive_id: str) -> Halves:
        if drive_id not in self._maps:
            path, wanted = _npy(self.folder, drive_id), sum(each.tokens for each in self._index(drive_id).values())
            try:
                rows: Halves = np.load(path, mmap_mode="r", allow_pickle=False)
            except (OSError, ValueError) as error:
                raise TrainError(f"{path}: not readable ({error}); delete it and build it again") from error
            if rows.dtype != np.float16 or rows.shape != (wanted, self.kv_dim):
                raise TrainError(f"{path}: expected f16 {(wanted, self.kv_dim)}, found {rows.dtype} {rows.shape}")
            self._maps[drive_id] = rows
            if len(self._maps) > _MAX_OPEN:
                self._maps.popitem(last=False)
        self._maps.move_to_end(drive_id)
        return self._maps[drive_id]


def begin(folder: Path, *, key: str, kv_dim: int, draws: int) -> None:
    """Create a cache folder. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    index = {"format": FORMAT, "key": key, "kv_dim": kv_dim, "draws": draws}
    write_whole(folder / INDEX, json.dumps(index) + "\n")


def _npy(folder: Path, drive_id: str) -> Path:
    return folder / f"{drive_id}.npy"


def _read(folder: Path, drive_id: str) -> Mapping[str, Any]:
    path = folder / f"{drive_id}.json"
    try:
        content = read_json(path)
        return {"drive_sha256": content["drive_sha256"], "states": content["states"]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TrainError(f"{path}: no states of this drive ({error!r}); build the cache for it") from error


def write_states(folder: Path, drive_id: str, sha256: str, states: Sequence[Made], kv_dim: int) -> None:
    """Write a drive's states: first the array, then the JSON file that marks it as complete."""
    rows = np.concatenate([state.kv for _, _, state in states] or [np.zeros((0, kv_dim), np.float16)])
    partial = folder / f"{drive_id}.{os.getpid()}.partial"
    with partial.open("wb") as file:
        np.save(file, rows, allow_pickle=False)
    partial.replace(_npy(folder, drive_id))
    places: list[dict[str, Any]] = []
    start = 0
    for k, number, state in states:
        place = _Place(k, number, start, len(state.kv), state.prompt_tokens, state.own, state.text)
        places.append(asdict(place))
        start += len(state.kv)
    write_whole(
        folder / f"{drive_id}.json", json.dumps({"drive_sha256": sha256, "states": places}, separators=(",", ":"))
    )


SEEN_PARTS: Final = ("vision", "language")
"""Parts of the network that a semantic state depends on."""
_TAG: Final = 0x5EE


def parts_sha256(network: TicVla, parts: Iterable[str] = SEEN_PARTS) -> str:
    """Hash the weights of some parts of a network."""
    wanted = tuple(parts)
    return tensors_sha256({name: each for name, each in network.state_dict().items() if name.split(".")[0] in wanted})


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
    return sorted(made, key=lambda state: state[:2])


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
        made.append((each.anchor.k, each.number, CachedState(half, len(each.prompt), text, each.own)))
    return made
