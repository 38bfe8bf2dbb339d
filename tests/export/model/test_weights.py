"""Weights travel as safetensors and are refused unless they are exactly the network asked for."""

from __future__ import annotations

import dataclasses
import pickle  # noqa: TID251 - planted in a file to be refused, never loaded
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from export.checkpoint.load import LoadedCheckpoint, load_checkpoint
from export.model.config import PRESETS, TicVlaConfig
from export.model.network import TicVla, build
from export.model.weights import CheckpointError, WeightsInfo, save_weights, weights_sha256

NANO = PRESETS["nano"]


@pytest.fixture(scope="module")
def model() -> TicVla:
    return build(NANO, 0)


@pytest.fixture
def file(model: TicVla, tmp_path: Path) -> Path:
    path = tmp_path / "nano.safetensors"
    save_weights(model, path, WeightsInfo(trained=False, origin="random seed 0"))
    return path


def load(path: Path, config: TicVlaConfig = NANO) -> LoadedCheckpoint:
    return load_checkpoint([path], config, fill_seed=None)


def test_what_was_saved_is_loaded(model: TicVla, file: Path) -> None:
    loaded = load(file)
    assert weights_sha256(loaded.model) == weights_sha256(model)
    assert not loaded.info.trained
    assert loaded.info.origin.startswith("nano.safetensors (sha256 ")
    assert loaded.info.origin.endswith(", random seed 0)")


def test_nothing_but_the_file_is_left_behind(file: Path) -> None:
    assert [p.name for p in file.parent.iterdir()] == [file.name]


def test_one_changed_weight_changes_the_hash(model: TicVla) -> None:
    other = build(NANO, 0)
    with torch.no_grad():
        next(iter(other.parameters())).view(-1)[0] += 1e-3
    assert weights_sha256(other) != weights_sha256(model)


def test_weights_of_another_configuration_are_refused(file: Path) -> None:
    other = dataclasses.replace(NANO, action=dataclasses.replace(NANO.action, layers=3))
    with pytest.raises(CheckpointError, match=r"another configuration .*action\.layers is 6, expected 3"):
        load(file, other)


@pytest.mark.parametrize("damage", ["missing", "extra", "shape", "nan"])
def test_tensors_that_do_not_fit_are_refused(model: TicVla, tmp_path: Path, damage: str) -> None:
    path = tmp_path / "nano.safetensors"
    save_weights(model, path, WeightsInfo(False, ""))
    tensors = load_file(path)
    if damage == "missing":
        del tensors["vision.cls"]
    elif damage == "extra":
        tensors["surprise"] = torch.zeros(1)
    elif damage == "shape":
        tensors["vision.cls"] = torch.zeros(1, 1, 5)
    else:
        tensors["vision.cls"][0, 0, 0] = float("nan")
    from safetensors import safe_open

    with safe_open(str(path), "pt") as opened:
        metadata = opened.metadata()
    save_file(tensors, str(path), metadata=metadata)
    with pytest.raises(CheckpointError):
        load(path)


def test_a_pickle_is_refused_without_being_opened_as_one(tmp_path: Path) -> None:
    path = tmp_path / "nano.safetensors"
    path.write_bytes(pickle.dumps({"a": 1}))
    with pytest.raises(CheckpointError, match="not a readable safetensors"):
        load(path)


def test_a_safetensors_file_of_somebody_else_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.safetensors"
    save_file({"a": torch.zeros(1)}, str(path))
    with pytest.raises(CheckpointError, match=r"tensors of no layout that is known \(a\)"):
        load(path)


def test_another_version_of_our_format_is_refused(model: TicVla, tmp_path: Path) -> None:
    path = tmp_path / "nano.safetensors"
    save_file(model.state_dict(), str(path), metadata={"format": "tic-vla-edge/2"})
    with pytest.raises(CheckpointError, match="format 'tic-vla-edge/2', expected 'tic-vla-edge/1'"):
        load(path)
