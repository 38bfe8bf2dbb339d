"""Scenes are opened by name: shipped ones, files, and the layouts that are kept from training."""

from __future__ import annotations

from pathlib import Path

import pytest

from sim_hil.layouts import generate
from sim_hil.layouts.scenes import layout_name, open_scene
from sim_hil.scene.scene import SceneError, load_scene, scene_to_toml


def test_a_shipped_scene_is_opened_by_its_name() -> None:
    assert open_scene("corridor") == load_scene("corridor")


@pytest.mark.slow
def test_a_reserved_layout_is_generated_and_has_the_name_of_its_kind_and_seed() -> None:
    scene = open_scene(layout_name("warehouse", 61))
    assert scene.name == "warehouse-61"
    assert scene.objects == generate("warehouse", 61, reserved=True).objects


def test_a_scene_file_is_opened_by_its_path(tmp_path: Path) -> None:
    path = tmp_path / "office-60.toml"
    path.write_text(scene_to_toml(load_scene("corridor")), encoding="utf-8")
    assert open_scene(path).name == "corridor"


@pytest.mark.parametrize("name", ["warehouse-100", "warehouse-061", "garden-60", "warehouse-", "warehouse-60 "])
def test_a_layout_of_training_or_an_unknown_one_is_refused_by_name(name: str) -> None:
    with pytest.raises(SceneError, match="unknown scene"):
        open_scene(name)
