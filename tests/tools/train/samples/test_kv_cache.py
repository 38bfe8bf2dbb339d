"""Semantic states on disk are those that the runner's generation would leave, and are made once."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from tokenizers import Tokenizer

from edge.state.reasoning_text import format_text
from export.model.network import TicVla, build
from export.model.tokenizers.nano import NANO_TOKENIZER
from tests.support.train.train_drives import MadeUpTokens, made_up_drive, tiny_model, write_dataset
from tools.train.config.checks import TrainError
from tools.train.config.imitate import KvConfig
from tools.train.config.sft import DrawConfig
from tools.train.drives.drive import Dataset
from tools.train.samples.anchors import Drawn, Prompts, anchors_of
from tools.train.samples.kv_cache import KvCache, build_kv_cache, cache_key

CONTENT = NANO_TOKENIZER.read_bytes()
TOKENS = MadeUpTokens()
RIGHT = DrawConfig(
    waypoints_only=0.0, before_wrong=0.0, before_min_s=1.0, before_max_s=1.0, before_late=0.0,
    way_turn_rad=0.0, way_scale=0.0, way_point_m=0.0,
)  # fmt: skip
CONFIG = KvConfig(batch=3, max_new_tokens=4, words=RIGHT)
ROUNDING = 4e-3


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def network() -> TicVla:
    return build(tiny_model(), 1)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Four anchors in the one drive, two in the other."""
    one_wording = ("Turn left, then stop at the desk.",)
    drives = [made_up_drive("a", 40, wordings=one_wording), made_up_drive("b", 20, wordings=one_wording)]
    return write_dataset(tmp_path_factory.mktemp("drives"), drives)


def made(folder: Path, network: TicVla, dataset: Dataset, config: KvConfig = CONFIG) -> KvCache:
    return build_kv_cache(folder, network, CONTENT, dataset, TOKENS, config, seed=3)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory, network: TicVla, dataset: Dataset) -> KvCache:
    return made(tmp_path_factory.mktemp("kv"), network, dataset)


def left_by(network: TicVla, frames: tuple[int, ...], ids: list[int]) -> np.ndarray:
    """K‖V that `LanguageModel.forward` itself leaves, f32 [T, kv_dim]."""
    c = network.config.language
    past = [torch.zeros(1, c.kv_heads, 0, c.head_dim)] * (2 * c.layers)
    pictures = torch.from_numpy(TOKENS.frames("a")[list(frames)].astype(np.float32))
    with torch.no_grad():
        return network.language(torch.tensor([ids]), pictures, past)[2][0].numpy()


def test_a_state_is_what_the_language_model_leaves_of_prompt_and_true_text(
    cache: KvCache, network: TicVla, dataset: Dataset
) -> None:
    prompts = Prompts(Tokenizer.from_buffer(CONTENT), network.config)
    anchors = anchors_of(dataset.load("a", pictures=False))
    assert cache.anchors("a") == tuple(anchor.k for anchor in anchors) == (0, 10, 20, 30)
    for anchor in anchors:
        state = cache.at("a", anchor.k)
        assert state.text == format_text(anchor.reasoning) and not state.own
        assert state.waypoints == pytest.approx(np.round(anchor.points, 1))
        prompt, answer = prompts.of(anchor, Drawn(anchor.wordings[0], anchor.before(1.0)))
        assert state.prompt_tokens == len(prompt)
        expected = left_by(network, anchor.frames, [*prompt, *answer[:-1]])
        np.testing.assert_allclose(state.kv, expected, atol=ROUNDING)


def test_a_state_with_its_own_text_is_of_that_text(
    tmp_path: Path, cache: KvCache, network: TicVla, dataset: Dataset
) -> None:
    own = made(tmp_path, network, dataset, dataclasses.replace(CONFIG, own_share=1.0))
    for k in own.anchors("a"):
        state, truth = own.at("a", k), cache.at("a", k)
        assert state.own and len(state.kv) - state.prompt_tokens <= 4
        upto = state.prompt_tokens
        assert upto == truth.prompt_tokens
        np.testing.assert_allclose(state.kv[:upto], truth.kv[:upto], atol=ROUNDING)


def test_a_policys_drive_has_a_share_of_its_own_texts(tmp_path: Path, network: TicVla) -> None:
    drives = [made_up_drive("a", 40), made_up_drive("b", 40, driver="policy:0123")]
    theirs = dataclasses.replace(CONFIG, own_share=0.0, own_share_policy=1.0)
    dataset = write_dataset(tmp_path / "drives", drives)
    states = made(tmp_path, network, dataset, theirs)
    assert not any(states.at("a", k).own for k in states.anchors("a"))
    assert all(states.at("b", k).own for k in states.anchors("b"))


def test_draws_of_an_anchor_differ_and_none_depends_on_how_many_there_are(
    tmp_path: Path, network: TicVla, dataset: Dataset
) -> None:
    varied = dataclasses.replace(CONFIG, words=dataclasses.replace(RIGHT, before_wrong=0.9))
    one = made(tmp_path, network, dataset, varied)
    three = made(tmp_path, network, dataset, dataclasses.replace(varied, draws=3))
    assert one.folder != three.folder and three.draws == 3
    for k in one.anchors("a"):
        np.testing.assert_allclose(one.at("a", k).kv, three.at("a", k).kv, atol=ROUNDING)
    pairs = [(three.at("a", k, 1).kv, three.at("a", k, 2).kv) for k in three.anchors("a")]
    assert any(a.shape != b.shape or not np.allclose(a, b, atol=ROUNDING) for a, b in pairs)


def test_existing_states_are_kept_and_missing_ones_are_made(
    tmp_path: Path, cache: KvCache, network: TicVla, dataset: Dataset
) -> None:
    shutil.copytree(cache.folder, tmp_path / cache.folder.name)
    copied = KvCache(tmp_path / cache.folder.name)
    before = (copied.folder / "a.npy").stat()
    (copied.folder / "b.json").unlink()
    again = made(tmp_path, network, dataset)
    assert again.folder == copied.folder
    after = (copied.folder / "a.npy").stat()
    assert (after.st_ino, after.st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    np.testing.assert_array_equal(again.at("b", 10).kv, cache.at("b", 10).kv)


def test_other_weights_texts_or_drives_need_another_cache(cache: KvCache, network: TicVla, dataset: Dataset) -> None:
    key = cache_key(network, CONTENT, CONFIG, 3)
    assert cache.key == key
    assert cache_key(build(tiny_model(), 2), CONTENT, CONFIG, 3) != key
    assert cache_key(network, CONTENT, dataclasses.replace(CONFIG, own_share=0.5), 3) != key
    assert cache_key(network, CONTENT, CONFIG, 4) != key
    assert cache_key(network, CONTENT, dataclasses.replace(CONFIG, batch=9), 3) == key
    assert cache.has("a", dataset.entries[0].sha256) and not cache.has("a", "0" * 64)


def test_a_cache_that_is_not_whole_is_refused(tmp_path: Path, cache: KvCache) -> None:
    with pytest.raises(TrainError, match="no state of frame 7"):
        cache.at("a", 7)
    with pytest.raises(TrainError, match="build it first"):
        KvCache(tmp_path / "nowhere")
    shutil.copytree(cache.folder, tmp_path / "copy")
    np.save(tmp_path / "copy" / "b.npy", np.zeros((3, 32), np.float16))
    with pytest.raises(TrainError, match="expected f16"):
        KvCache(tmp_path / "copy").at("b", 0)
    index = json.loads((tmp_path / "copy" / "kv.json").read_text())
    (tmp_path / "copy" / "kv.json").write_text(json.dumps({**index, "format": 9}))
    with pytest.raises(TrainError, match="format 1"):
        KvCache(tmp_path / "copy")
