"""Weights that ship: who takes them, and that they are those of today's network."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from export.checkpoint.load import SHIPPED, shipped_weights
from export.model.config import PRESETS, with_overrides
from export.model.network import PARTS, build
from export.model.weights import CheckpointError, WeightsInfo, save_weights
from export.pipeline.job import WeightSource

SMALL = with_overrides(
    PRESETS["nano"], {"vision.layers": "1", "language.layers": "1", "action.layers": "1", "action.ffn": "64"}
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Weights as they are given away: float16, without the value network."""
    info = WeightsInfo(trained=True, origin="a test")
    save_weights(
        build(SMALL, 5).half(), tmp_path / "nano.safetensors", info, [part for part in PARTS if part != "value"]
    )
    return tmp_path


def test_a_networks_own_weights_are_found(folder: Path) -> None:
    assert shipped_weights(SMALL, folder) == folder / "nano.safetensors"


def test_a_network_with_other_numbers_has_none(folder: Path) -> None:
    assert shipped_weights(with_overrides(SMALL, {"action.layers": "2"}), folder) is None
    assert shipped_weights(with_overrides(SMALL, {"value.channels": "8"}), folder) is None
    assert shipped_weights(PRESETS["1b"], folder) is None


def test_a_damaged_file_is_reported(folder: Path) -> None:
    (folder / "nano.safetensors").write_bytes(b"\x00" * 20)
    with pytest.raises(CheckpointError, match="install the package again"):
        shipped_weights(SMALL, folder)


@pytest.mark.slow
def test_an_export_takes_them_unless_a_seed_is_given(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("export.pipeline.job.shipped_weights", lambda config: shipped_weights(config, folder))
    shipped, random = WeightSource(SMALL, [], None).loaded, WeightSource(SMALL, [], 3).loaded
    assert shipped.info.trained and not random.info.trained
    trained = build(SMALL, 5).half().float()
    for name, tensor in shipped.model.state_dict().items():
        if not name.startswith("value."):
            assert tensor.dtype == torch.float32 and torch.equal(tensor, trained.state_dict()[name])


def test_without_any_an_export_is_of_a_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("export.pipeline.job.shipped_weights", lambda config: shipped_weights(config, tmp_path))
    assert WeightSource(SMALL, [], None).fingerprint()["seed"] == 0


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.safetensors")), ids=lambda path: path.stem)
def test_the_weights_that_ship_are_those_of_todays_network_and_small_and_have_a_card(path: Path) -> None:
    assert shipped_weights(PRESETS[path.stem]) == path
    assert path.stat().st_size <= 40_000_000 and path.with_suffix(".md").is_file()
