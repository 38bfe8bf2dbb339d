"""A checkpoint is the network asked for, tensor by tensor, or it is refused in one line that says why."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from export.checkpoint.layouts import VLM_LAYOUTS
from export.checkpoint.load import load_checkpoint
from export.checkpoint.tokenizer import tokenizer_for
from export.evaluation import parity
from export.model import weights
from export.model.config import PRESETS
from export.model.network import TicVla, build
from export.model.weights import CheckpointError, WeightsInfo, save_weights, weights_sha256
from export.pipeline.job import WeightSource
from tests.support.export.internvl import CONFIG, hf_model, original_config, refusal, write_directory

NANO = PRESETS["nano"]


@pytest.fixture(scope="module")
def model() -> TicVla:
    """The network that every file below holds."""
    return build(CONFIG, 7)


@pytest.fixture
def expert(model: TicVla, tmp_path: Path) -> Path:
    """Action expert and value network alone."""
    path = tmp_path / "expert.safetensors"
    save_weights(model, path, WeightsInfo(trained=True, origin="run 12"), parts=("action", "value"))
    return path


# Layouts


def test_a_vlm_directory_and_an_action_expert_make_one_network(vlm: Path, expert: Path, model: TicVla) -> None:
    loaded = load_checkpoint([vlm, expert], CONFIG, fill_seed=None)
    ours = loaded.model.state_dict()
    assert all(torch.equal(ours[name], x) for name, x in model.state_dict().items() if name.startswith("action."))
    assert loaded.info.trained
    assert [source.layouts for source in loaded.coverage.sources] == [("internvl",), ("tic-vla-edge action",)]
    assert set(loaded.coverage.loaded) == set(ours)


@pytest.mark.slow
@pytest.mark.parametrize("prefix", ["", "model.", "vlm.", "module."])
@pytest.mark.parametrize("layout", VLM_LAYOUTS, ids=lambda layout: layout.name)
def test_a_lightning_checkpoint_holds_everything_under_its_own_prefix(
    model: TicVla, tmp_path: Path, layout: Any, prefix: str
) -> None:
    state, tensors = model.state_dict(), {}
    for ours, theirs in layout.names(CONFIG).items():
        pieces = state[ours].chunk(len(theirs))
        tensors.update({prefix + name: piece.clone() for name, piece in zip(theirs, pieces, strict=True)})
    tensors |= {f"model.{name}": x for name, x in state.items() if name.startswith(("action.", "value."))}
    path = tmp_path / "last.ckpt"
    torch.save({"epoch": 3, "optimizer_states": [{"state": {}}], "state_dict": tensors}, path)
    loaded = load_checkpoint([path], CONFIG, fill_seed=None)
    assert weights_sha256(loaded.model) == weights_sha256(model)
    assert loaded.coverage.sources[0].outside == ("epoch", "optimizer_states")
    assert loaded.info.trained


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_becomes_the_same_numbers_in_fp32(
    original: dict[str, Tensor], tmp_path: Path, dtype: torch.dtype
) -> None:
    half = {name: x.to(dtype) for name, x in original.items()}
    loaded = load_checkpoint([write_directory(tmp_path / "vlm", half)], CONFIG, fill_seed=0)
    assert torch.equal(loaded.model.language.embed.weight, half["language_model.model.embed_tokens.weight"].float())
    assert {x.dtype for x in loaded.model.state_dict().values()} == {torch.float32}


def test_buffers_that_follow_from_the_configuration_are_ignored_by_name(
    original: dict[str, Tensor], tmp_path: Path
) -> None:
    name = "language_model.model.layers.0.self_attn.rotary_emb.inv_freq"
    path = write_directory(tmp_path / "vlm", original | {name: torch.zeros(4)})
    assert load_checkpoint([path], CONFIG, fill_seed=0).coverage.sources[0].ignored == (name,)


# What is said of the weights


def test_without_an_action_expert_there_is_no_network(vlm: Path) -> None:
    assert "vlm: no action expert (60 tensors)" in refusal(vlm, fill_seed=None)


def test_a_seed_fills_the_action_expert_and_marks_it_untrained(vlm: Path) -> None:
    a = load_checkpoint([vlm], CONFIG, fill_seed=5)
    b = load_checkpoint([vlm], CONFIG, fill_seed=6)
    assert not a.info.trained
    assert a.info.origin.endswith("action: random seed 5")
    assert not torch.equal(a.model.action.queries, b.model.action.queries)
    assert weights_sha256(a.model) == weights_sha256(load_checkpoint([vlm], CONFIG, fill_seed=5).model)


def test_an_absent_value_network_is_reported(vlm: Path, model: TicVla, tmp_path: Path) -> None:
    path = tmp_path / "expert.safetensors"
    save_weights(model, path, WeightsInfo(trained=True, origin=""), parts=("action",))
    loaded = load_checkpoint([vlm, path], CONFIG, fill_seed=None)
    assert loaded.coverage.seeded == {"value": 0}
    assert loaded.info.trained
    assert "value: random seed 0" in loaded.info.origin


def test_a_seed_beside_a_whole_checkpoint_changes_nothing(vlm: Path, model: TicVla, tmp_path: Path) -> None:
    path = tmp_path / "expert.safetensors"
    save_weights(model, path, WeightsInfo(trained=True, origin=""), parts=("action",))
    with_seed, without = (load_checkpoint([vlm, path], CONFIG, fill_seed=seed) for seed in (5, None))
    assert weights_sha256(with_seed.model) == weights_sha256(without.model)
    assert with_seed.info == without.info  # which is all that an artifact keeps


@pytest.mark.parametrize("changed", ["model.safetensors", "config.json", "preprocessor_config.json", "tokenizer.json"])
def test_every_file_of_a_directory_is_part_of_the_fingerprint(vlm: Path, changed: str) -> None:
    before = WeightSource(CONFIG, [vlm], 0).fingerprint()
    (vlm / changed).touch()
    content = (vlm / changed).read_bytes()
    # A header may end in spaces; JSON, too.
    (vlm / changed).write_bytes(_with_a_space(content) if changed.endswith("safetensors") else content + b" ")
    assert WeightSource(CONFIG, [vlm], 0).fingerprint() != before


def test_checkpoints_of_one_name_and_another_order_have_other_fingerprints(expert: Path, tmp_path: Path) -> None:
    """vlm/model.safetensors, action/model.safetensors: each counts, though both have the same name."""
    paths = [tmp_path / folder / "model.safetensors" for folder in ("vlm", "action")]
    for path in paths:
        path.parent.mkdir(exist_ok=True)
        shutil.copy(expert, path)
    same = WeightSource(CONFIG, paths, None).fingerprint()
    paths[0].write_bytes(_with_a_space(paths[0].read_bytes()))
    other = WeightSource(CONFIG, paths, None).fingerprint()
    assert len({json.dumps(found, sort_keys=True) for found in (same, other)}) == 2
    assert WeightSource(CONFIG, paths[::-1], None).fingerprint() != other


def _with_a_space(content: bytes) -> bytes:
    """The same tensors in a safetensors file whose header ends in a space more."""
    length = int.from_bytes(content[:8], "little")
    return (length + 1).to_bytes(8, "little") + content[8 : 8 + length] + b" " + content[8 + length :]


def test_the_origin_names_files_and_hashes_but_no_place(vlm: Path, expert: Path, tmp_path: Path) -> None:
    origin = load_checkpoint([vlm, expert], CONFIG, fill_seed=None).info.origin
    assert "vlm/model.safetensors (sha256 " in origin
    assert "expert.safetensors (sha256 " in origin
    assert str(tmp_path) not in origin


# Coverage


def test_a_refusal_counts_and_names_every_kind_of_difference(original: dict[str, Tensor], tmp_path: Path) -> None:
    tensors = dict(original)
    for n in range(CONFIG.language.layers):
        del tensors[f"language_model.model.layers.{n}.mlp.up_proj.weight"]
    tensors["language_model.model.layers.0.q_norm.weight"] = torch.zeros(8)
    tensors["mlp1.0.weight"] = torch.zeros(3)
    path = write_directory(tmp_path / "vlm", tensors)
    line = refusal(path)
    assert f"3 tensors missing ({', '.join(f'language.layers.{n}.up.weight' for n in range(3))})" in line
    assert "1 tensor unknown (vlm: language_model.model.layers.0.q_norm.weight)" in line
    assert "1 tensor of another shape (mlp1.0.weight is [3], expected [128])" in line


@pytest.mark.slow
def test_part_of_a_stacked_matrix_is_missing_by_its_own_name(tmp_path: Path) -> None:
    hf_model().save_pretrained(tmp_path / "hf")
    tensors = load_file(tmp_path / "hf" / "model.safetensors")
    del tensors["vision_tower.encoder.layer.1.attention.k_proj.bias"]
    save_file(tensors, str(tmp_path / "hf" / "model.safetensors"))
    assert "vision_tower.encoder.layer.1.attention.k_proj.bias" in refusal(tmp_path / "hf")


def test_the_configuration_of_every_directory_is_checked(vlm: Path, tmp_path: Path) -> None:
    """Also that of the second one, whatever the first has."""
    second = Path(shutil.copytree(vlm, tmp_path / "second"))
    config = json.loads((vlm / "config.json").read_text())
    (vlm / "config.json").write_text(json.dumps({**config, "tie_word_embeddings": True}))
    (second / "config.json").write_text("{}")
    with pytest.raises(CheckpointError, match=r"second: config\.json|second/config\.json"):
        load_checkpoint([vlm, second], CONFIG, fill_seed=0)


def test_a_tensor_given_twice_is_refused(vlm: Path, model: TicVla, tmp_path: Path) -> None:
    whole = tmp_path / "whole.safetensors"
    save_weights(model, whole, WeightsInfo(True, ""))
    assert "given twice (vision.cls in vlm and whole.safetensors" in refusal(vlm, whole)


def test_an_action_expert_of_another_configuration_is_refused(vlm: Path, tmp_path: Path) -> None:
    other = dataclasses.replace(CONFIG, action=dataclasses.replace(CONFIG.action, parameterisation="offsets"))
    path = tmp_path / "expert.safetensors"
    save_weights(build(other, 0), path, WeightsInfo(True, ""), parts=("action",))
    assert "action.parameterisation is 'offsets', expected 'increments'" in refusal(vlm, path)


# config.json


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        ("vision_config", "qk_normalization", True),
        ("vision_config", "norm_type", "rms_norm"),
        ("vision_config", "hidden_act", "quick_gelu"),
        ("vision_config", "qkv_bias", False),
        ("llm_config", "hidden_act", "gelu"),
        ("llm_config", "model_type", "llama"),
        ("llm_config", "rope_scaling", {"type": "yarn", "factor": 4.0}),
        ("llm_config", "rope_scaling", "dynamic"),
        ("llm_config", "rope_scaling", [1.0]),
        ("llm_config", "rope_parameters", "default"),
        ("llm_config", "layer_types", 5),
        ("llm_config", "layer_types", "full_attention"),
        ("llm_config", "layer_types", [["full_attention"]]),
        ("llm_config", "rms_norm_eps", float("inf")),
        ("llm_config", "num_hidden_layers", "three"),
        ("llm_config", "num_key_value_heads", 3),
        ("llm_config", "max_position_embeddings", 16),
        (None, "ps_version", "v1"),
        (None, "select_layer", -4),
        (None, "downsample_ratio", 0.3),
        (None, "downsample_ratio", float("nan")),
        (None, "downsample_ratio", float("inf")),
    ],
)
def test_unsupported_parts_are_refused_by_name(vlm: Path, section: str | None, key: str, value: object) -> None:
    config = original_config()
    (config[section] if section else config)[key] = value
    (vlm / "config.json").write_text(json.dumps(config), encoding="utf-8")
    line = refusal(vlm)
    # The number of K/V heads is refused by the configuration itself, which calls it by our name.
    assert key in line or "kv_heads" in line or "rope_scaling" in line


@pytest.mark.parametrize(("key", "ours"), [("rope_theta", "rope_theta"), ("rms_norm_eps", "rms_eps")])
def test_a_directory_that_contradicts_the_model_is_refused(vlm: Path, key: str, ours: str) -> None:
    config = original_config()
    config["llm_config"][key] = 0.5
    (vlm / "config.json").write_text(json.dumps(config), encoding="utf-8")
    assert f"language.{ours} is 0.5, model 'small' has" in refusal(vlm)


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"llm_config": 3}', "{" * 100_000])
def test_a_broken_config_is_refused(vlm: Path, content: str) -> None:
    (vlm / "config.json").write_text(content, encoding="utf-8")
    assert "config.json" in refusal(vlm)


# Tokenizers


def test_the_directory_brings_its_tokenizer_if_the_ids_are_the_networks(vlm: Path) -> None:
    from tokenizers import Tokenizer, models

    tokens = {f"t{n}": n for n in range(6)} | {"<|im_start|>": 6, "<|im_end|>": 7, "<img>": 8, "</img>": 9}
    tokenizer = Tokenizer(models.WordLevel(tokens | {"<IMG_CONTEXT>": 10}, unk_token="t0"))
    tokenizer.save(str(vlm / "tokenizer.json"))
    loaded = load_checkpoint([vlm], CONFIG, fill_seed=0)
    assert loaded.tokenizer == (vlm / "tokenizer.json").read_bytes()
    assert tokenizer_for(CONFIG, loaded.tokenizer) == loaded.tokenizer
    Tokenizer(models.WordLevel(tokens | {"<IMG_CONTEXT>": 11}, unk_token="t0")).save(str(vlm / "tokenizer.json"))
    assert "<IMG_CONTEXT> is id 11, the network was built for 10" in refusal(vlm)
    (vlm / "tokenizer.json").write_text("{}", encoding="utf-8")
    assert "vlm/tokenizer.json: not a tokenizer" in refusal(vlm)


@pytest.mark.slow
def test_nano_and_the_paper_size_have_a_tokenizer_and_other_ids_have_none() -> None:
    from tokenizers import Tokenizer

    assert Tokenizer.from_buffer(tokenizer_for(NANO, None)).token_to_id("<IMG_CONTEXT>") == 5
    assert Tokenizer.from_buffer(tokenizer_for(PRESETS["1b"], None)).token_to_id("<IMG_CONTEXT>") == 151667
    with pytest.raises(CheckpointError, match="no tokenizer for token ids"):
        tokenizer_for(CONFIG, None)


# Our own files


def test_saved_weights_are_loaded_unchanged(model: TicVla, tmp_path: Path) -> None:
    file = tmp_path / "small.safetensors"
    save_weights(model, file, WeightsInfo(trained=False, origin="random seed 0"))
    loaded = load_checkpoint([file], CONFIG, fill_seed=None)
    assert weights_sha256(loaded.model) == weights_sha256(model)
    assert not loaded.info.trained
    assert loaded.info.origin.startswith("small.safetensors (sha256 ")
    assert loaded.info.origin.endswith(", random seed 0)")


def test_a_foreign_safetensors_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.safetensors"
    save_file({"a": torch.zeros(1)}, str(path))
    assert "tensors of no layout that is known (a)" in refusal(path)


def test_another_version_of_our_format_is_refused(model: TicVla, tmp_path: Path) -> None:
    path = tmp_path / "nano.safetensors"
    save_file(model.state_dict(), str(path), metadata={"format": "tic-vla-edge/2"})
    assert "format 'tic-vla-edge/2', expected 'tic-vla-edge/1'" in refusal(path)


@pytest.mark.parametrize("module", [weights, parity], ids=["weights", "samples"])
def test_a_full_disk_is_an_os_error_and_leaves_no_file(
    module: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_tensors: object, path: str | Path, **_: object) -> None:
        Path(path).write_bytes(b"half")
        raise SafetensorError("Error while serializing: I/O error: No space left on device (os error 28)")

    monkeypatch.setattr(module, "save_file", full)
    path = tmp_path / "w.safetensors"
    with pytest.raises(OSError, match=r"No space left on device.*w\.safetensors"):
        if module is weights:
            save_weights(build(NANO, 0), path, WeightsInfo(True, ""))
        else:
            parity.save_samples([], path)
    assert list(tmp_path.iterdir()) == []
