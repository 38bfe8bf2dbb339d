"""An imported InternVL computes what Hugging Face `transformers`, which nobody here wrote, makes of the same file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from export.checkpoint.hf_config import read_hf_config
from export.checkpoint.load import load_checkpoint
from export.model.config import PRESETS, LanguageConfig
from export.model.network import TicVla
from tests.support.export.internvl import CONFIG, hf_model, original_tensors, write_directory

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]
FRAMES = 3
LAYOUTS = ("original", "hf", "hf shards", "lightning", "hf tied")


@pytest.fixture(scope="module", params=LAYOUTS)
def pair(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, TicVla]:
    """The network by transformers and ours, imported from the file in one of the layouts."""
    hf = hf_model(tied=request.param == "hf tied")
    path = tmp_path_factory.mktemp("internvl") / "checkpoint"
    if request.param == "original":
        write_directory(path, original_tensors(hf))
    elif request.param == "lightning":
        path = path.with_suffix(".ckpt")
        torch.save({"epoch": 1, "state_dict": {f"vlm.{k}": v for k, v in hf.state_dict().items()}}, path)
    else:
        hf.save_pretrained(path, max_shard_size="60KB" if request.param == "hf shards" else "5GB")
    return hf, load_checkpoint([Path(path)], CONFIG, fill_seed=0).model


@pytest.fixture(scope="module")
def frames() -> Tensor:
    px = CONFIG.vision.image_px
    return torch.randint(0, 256, (FRAMES, px, px, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(1))


@pytest.fixture(scope="module")
def ids() -> Tensor:
    """A prompt with text before, between and behind the frames."""
    c, generator = CONFIG.language, torch.Generator().manual_seed(2)
    image = [c.img_start_id, *[c.img_context_id] * CONFIG.vision.tokens, c.img_end_id]
    parts: list[int] = []
    for length in (7, 3, 5):
        parts += [*torch.randint(11, c.vocab, (length,), generator=generator).tolist(), *image]
    return torch.tensor([[*parts, *torch.randint(11, c.vocab, (12,), generator=generator).tolist()]])


def pixels(frames: Tensor) -> Tensor:
    """What transformers' image processor makes of frames of the right size."""
    scaled = (frames.float() / 255 - torch.tensor(CONFIG.vision.mean)) / torch.tensor(CONFIG.vision.std)
    return scaled.permute(0, 3, 1, 2)


def no_past() -> list[Tensor]:
    c = CONFIG.language
    return [torch.zeros(1, c.kv_heads, 0, c.head_dim) for _ in range(2 * c.layers)]


@torch.no_grad()
def test_visual_tokens_are_the_same(pair: tuple[Any, TicVla], frames: Tensor) -> None:
    hf, ours = pair
    theirs = hf.get_image_features(pixel_values=pixels(frames)).pooler_output
    assert torch.allclose(ours.vision(frames), theirs, atol=1e-5)


@torch.no_grad()
def test_logits_of_a_prompt_with_frames_are_the_same(pair: tuple[Any, TicVla], frames: Tensor, ids: Tensor) -> None:
    hf, ours = pair
    theirs = hf(input_ids=ids, pixel_values=pixels(frames)).logits
    x, _, _ = ours.language.hidden_states(ids, ours.vision(frames), no_past())
    assert torch.allclose(ours.language.lm_head(x), theirs, atol=1e-4)
    assert theirs.std() > 0.1


@torch.no_grad()
def test_the_semantic_state_is_the_last_layers_keys_and_values(
    pair: tuple[Any, TicVla], frames: Tensor, ids: Tensor
) -> None:
    hf, ours = pair
    layer = hf(input_ids=ids, pixel_values=pixels(frames), use_cache=True).past_key_values.layers[-1]
    theirs = torch.cat([x.transpose(1, 2).flatten(2) for x in (layer.keys, layer.values)], dim=-1)
    _, _, last_layer_kv = ours.language.hidden_states(ids, ours.vision(frames), no_past())
    assert torch.allclose(last_layer_kv, theirs, atol=1e-4)


@torch.no_grad()
def test_greedy_text_is_the_same(pair: tuple[Any, TicVla], frames: Tensor, ids: Tensor) -> None:
    hf, ours = pair
    count = 24
    theirs = hf.generate(
        input_ids=ids,
        attention_mask=torch.ones_like(ids),
        pixel_values=pixels(frames),
        do_sample=False,
        max_new_tokens=count,
        pad_token_id=0,
    )[0, ids.shape[1] :]
    visual, feed, past = ours.vision(frames), ids, no_past()
    text: list[int] = []
    for _ in range(count):
        next_token, _, _, *past = ours.language(feed, visual, past)
        feed = next_token[:, -1:]
        text.append(int(feed))
    assert text == theirs.tolist()
    assert len(set(text)) > 3


def test_a_directory_gives_its_own_numbers(tmp_path: Path) -> None:
    """Both config.json layouts, at the size of the paper."""
    from transformers import InternVLConfig

    vision = {"attention_bias": True, "use_absolute_position_embeddings": True}
    text = {"model_type": "qwen2", "hidden_size": 896, "num_hidden_layers": 24, "num_attention_heads": 14}
    text |= {"num_key_value_heads": 2, "intermediate_size": 4864, "vocab_size": 151674, "rope_theta": 1e6}
    InternVLConfig(vision_config=vision, text_config=text).save_pretrained(tmp_path)
    found = read_hf_config(tmp_path, LanguageConfig())
    assert (found.vision, found.language) == (PRESETS["1b"].vision, PRESETS["1b"].language)
