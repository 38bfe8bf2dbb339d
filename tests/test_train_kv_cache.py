"""Semantic states on disk are those that the runner's generation would leave, and are made once."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from export.model.config import PRESETS, TicVlaConfig
from export.model.network import TicVla, build
from export.model.tokenizer import NANO_TOKENIZER
from tests.train_drives import MadeUpTokens, made_up_drive, write_dataset
from tools.train.anchors import DrawConfig, anchors_of
from tools.train.distributed import Ranks
from tools.train.drive import Dataset
from tools.train.kv_build import KvConfig, build_kv_cache, cache_key
from tools.train.kv_cache import KvCache, KvCacheError

CONTENT = NANO_TOKENIZER.read_bytes()
TOKENS = MadeUpTokens(4, 32)
FOUR = KvConfig(batch=5, max_new_tokens=6)


def tiny() -> TicVlaConfig:
    """`nano` with narrow layers and one language token a frame; its own vocabulary and special tokens."""
    nano = PRESETS["nano"]
    vision = dataclasses.replace(nano.vision, image_px=32, hidden=24, layers=1, mlp=32, token_dim=32)
    language = dataclasses.replace(nano.language, hidden=32, layers=2, head_dim=8, mlp=48)
    return dataclasses.replace(
        nano, vision=vision, language=language, action=dataclasses.replace(nano.action, hidden=32, layers=1, ffn=32)
    )


@pytest.fixture(scope="module")
def network() -> TicVla:
    return build(tiny(), 1)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_dataset(tmp_path_factory.mktemp("drives"), [made_up_drive("a"), made_up_drive("b", 45)])


def made(folder: Path, network: TicVla, dataset: Dataset, config: KvConfig = FOUR) -> KvCache:
    return build_kv_cache(folder, network, CONTENT, dataset, TOKENS, config, seed=3)


def runners_own(network: TicVla, drive_id: str, frames: tuple[int, ...], ids: list[int]) -> torch.Tensor:
    c = network.config.language
    past = [torch.zeros(1, c.kv_heads, 0, c.head_dim)] * (2 * c.layers)
    pictures = torch.from_numpy(TOKENS.frames(drive_id)[list(frames)].astype(np.float32))
    with torch.no_grad():
        return network.language(torch.tensor([ids]), pictures, past)[2][0]


def test_a_state_is_what_the_language_model_leaves_of_prompt_and_true_text(
    tmp_path: Path, network: TicVla, dataset: Dataset
) -> None:
    from tokenizers import Tokenizer

    from tools.train.anchors import Drawn, Prompts

    words = DrawConfig(waypoints_only=0.0, before_wrong=0.0, before_min_s=1.0, before_max_s=1.0)
    cache = made(tmp_path, network, dataset, dataclasses.replace(FOUR, words=words))
    prompts = Prompts(Tokenizer.from_buffer(CONTENT), network.config)
    for anchor in anchors_of(dataset.load("a", pictures=False)):
        state = cache.at("a", anchor.k)
        assert state.text == anchor.reasoning and not state.own
        assert state.waypoints == pytest.approx(np.round(anchor.points, 1))
        expected = []
        for wording in anchor.wordings:
            prompt, answer = prompts.of(anchor, Drawn(wording, anchor.before(1.0)))
            if len(prompt) == state.prompt_tokens and len(prompt) + len(answer) - 1 == len(state.kv):
                ids = [*prompt, *answer[:-1]]
                expected.append(runners_own(network, "a", anchor.frames, ids).numpy())
        assert any(np.allclose(state.kv, kv, atol=4e-3) for kv in expected)


def test_a_state_with_its_own_text_is_of_that_text(tmp_path: Path, network: TicVla, dataset: Dataset) -> None:
    cache = made(tmp_path, network, dataset, dataclasses.replace(FOUR, own_share=1.0))
    for k in cache.anchors("b"):
        state = cache.at("b", k)
        assert state.own and len(state.kv) - state.prompt_tokens <= 6
        assert np.isfinite(state.kv).all() and state.kv.dtype == np.float16
    truth = made(tmp_path, network, dataset)
    same = cache.at("b", 40), truth.at("b", 40)
    assert same[0].prompt_tokens == same[1].prompt_tokens
    upto = same[0].prompt_tokens
    np.testing.assert_allclose(same[0].kv[:upto], same[1].kv[:upto], atol=4e-3)


def test_draws_of_an_anchor_differ_and_none_depends_on_how_many_there_are(
    tmp_path: Path, network: TicVla, dataset: Dataset
) -> None:
    one = made(tmp_path, network, dataset)
    three = made(tmp_path, network, dataset, dataclasses.replace(FOUR, draws=3))
    assert three.draws == 3 and one.folder != three.folder
    for k in one.anchors("a"):
        np.testing.assert_allclose(one.at("a", k).kv, three.at("a", k).kv, atol=4e-3)
    assert any(three.at("a", k, 1).kv.shape != three.at("a", k, 2).kv.shape for k in three.anchors("a"))


def test_what_is_there_is_not_made_again_and_what_is_missing_is(
    tmp_path: Path, network: TicVla, dataset: Dataset
) -> None:
    cache = made(tmp_path, network, dataset)
    before = {path.name: path.stat().st_mtime_ns for path in cache.folder.iterdir() if path.stem == "a"}
    whole = cache.at("b", 40).kv.copy()
    (cache.folder / "b.json").unlink()
    again = made(tmp_path, network, dataset)
    assert {path.name: path.stat().st_mtime_ns for path in cache.folder.iterdir() if path.stem == "a"} == before
    np.testing.assert_array_equal(again.at("b", 40).kv, whole)


def test_other_weights_other_words_and_another_drive_are_another_cache(
    tmp_path: Path, network: TicVla, dataset: Dataset
) -> None:
    key = cache_key(network, CONTENT, FOUR, 3)
    assert cache_key(build(tiny(), 2), CONTENT, FOUR, 3) != key
    assert cache_key(network, CONTENT, dataclasses.replace(FOUR, own_share=0.5), 3) != key
    assert cache_key(network, CONTENT, FOUR, 4) != key
    assert cache_key(network, CONTENT, dataclasses.replace(FOUR, batch=9), 3) == key
    other = build(tiny(), 1)
    torch.nn.init.zeros_(other.action.out.bias)
    assert cache_key(other, CONTENT, FOUR, 3) == key
    cache = made(tmp_path, network, dataset)
    assert cache.has("a", dataset.entries[0].sha256) and not cache.has("a", "0" * 64)


def test_ranks_share_the_drives(tmp_path: Path, network: TicVla, dataset: Dataset) -> None:
    class Alone(Ranks):
        def barrier(self) -> None:
            """The other rank's turn comes later."""

    alone = made(tmp_path / "one", network, dataset)
    for rank in (0, 1):
        both = build_kv_cache(tmp_path / "two", network, CONTENT, dataset, TOKENS, FOUR, seed=3, ranks=Alone(rank, 2))
    for drive_id in ("a", "b"):
        assert (both.folder / f"{drive_id}.npy").read_bytes() == (alone.folder / f"{drive_id}.npy").read_bytes()


def test_a_cache_that_is_not_whole_is_refused(tmp_path: Path, network: TicVla, dataset: Dataset) -> None:
    cache = made(tmp_path, network, dataset)
    np.save(cache.folder / "b.npy", np.zeros((3, 32), np.float16))
    with pytest.raises(KvCacheError, match="expected f16"):
        KvCache(cache.folder).at("b", 0)
    with pytest.raises(KvCacheError, match="no state of frame 7"):
        cache.at("a", 7)
    with pytest.raises(KvCacheError, match="build it first"):
        KvCache(tmp_path / "nowhere")
    index = json.loads((cache.folder / "kv.json").read_text())
    (cache.folder / "kv.json").write_text(json.dumps({**index, "format": 9}))
    with pytest.raises(KvCacheError, match="format 1"):
        KvCache(cache.folder)
