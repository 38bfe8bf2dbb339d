"""Scenes as data: what is accepted, what is refused, what a scene says about itself."""

from __future__ import annotations

import pytest

from sim_hil.scene.scene import SCENES, SceneError, load_scene, parse_scene, scene_names

CORRIDOR = (SCENES / "corridor.toml").read_text(encoding="utf-8")


def test_the_corridor_is_as_long_and_wide_as_it_says_and_has_a_vending_machine_by_the_goal() -> None:
    scene = load_scene("corridor")
    assert scene.floor_max_m[0] - scene.floor_min_m[0] == pytest.approx(30)
    assert scene.floor_max_m[1] - scene.floor_min_m[1] == pytest.approx(4)
    machine = next(thing for thing in scene.objects if thing.kind == "vending_machine")
    dx, dy = scene.goal_xy[0] - machine.position_m[0], scene.goal_xy[1] - machine.position_m[1]
    assert (dx**2 + dy**2) ** 0.5 < 1.5


def test_every_shipped_scene_loads() -> None:
    for name in scene_names():
        assert load_scene(name).name == name


def test_unknown_scene_is_refused_by_naming_the_known_ones() -> None:
    with pytest.raises(SceneError, match="corridor"):
        load_scene("no-such-place")


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("ceiling_height_m = 2.6", "ceiling_height_m = 2.6\nceilling = 1", "ceilling"),
        ('kind = "bench"', 'kind = "bench"\ncolor = [0, 0, 0]', "color"),
        ('kind = "bench"', 'kind = "throne"', "throne"),
        ("size_m = [0.8, 1.1, 1.9]", "size_m = [0.8, 1.1]", "size_m"),
        ("size_m = [0.8, 1.1, 1.9]", "size_m = [0.8, 1.1, -1]", "positive"),
        ("goal_xy = [24.0, 0.6]", "goal_xy = [240.0, 0.6]", "goal_xy"),
        ("goal_xy = [24.0, 0.6]", "goal_xy = [nan, 0.6]", "goal_xy"),
        ('texture = "floor_tiles"', 'texture = "lava"', "lava"),
        ('label = "right wall"', 'label = "left wall"', "unique"),
        ("start = [0.0, 0.0, 0.0]", "", "start"),
    ],
)
def test_a_wrong_scene_file_is_refused_in_one_line(old: str, new: str, complaint: str) -> None:
    assert old in CORRIDOR
    with pytest.raises(SceneError, match=complaint) as error:
        parse_scene(CORRIDOR.replace(old, new, 1), "test.toml")
    assert str(error.value).startswith("test.toml: ")
    assert "\n" not in str(error.value)


def test_text_that_is_not_toml_is_refused() -> None:
    with pytest.raises(SceneError, match="TOML"):
        parse_scene("walls = [", "test.toml")


def test_a_scene_without_one_object_lacks_only_that() -> None:
    scene = load_scene("corridor")
    rest = scene.without("vending machine")
    assert {thing.label for thing in scene.objects} - {thing.label for thing in rest.objects} == {"vending machine"}
    with pytest.raises(KeyError):
        rest.without("vending machine")
