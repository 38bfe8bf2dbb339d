"""Scene files: what they contain, what is refused, and that writing and reading back loses nothing."""

from __future__ import annotations

from dataclasses import replace
from math import cos, hypot, pi, radians
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_hil.scene.parts import AREA_KINDS, PLACE_KINDS, TERRAIN_KINDS
from sim_hil.scene.scene import (
    CEILING_TEXTURES,
    FLOOR_TEXTURES,
    KINDS,
    SCENES,
    WALL_TEXTURES,
    Area,
    Floor,
    Place,
    Route,
    Scene,
    SceneError,
    SceneObject,
    Terrain,
    Wall,
    load_scene,
    parse_scene,
    scene_names,
    scene_to_toml,
)

CORRIDOR = (SCENES / "corridor.toml").read_text(encoding="utf-8")
PLAIN = Scene("plain", (0.0, 0.0, 0.0), (1.0, 1.0), (-9.0, -9.0), (9.0, 9.0), "paving", 0.0, (), (), ())
SQUARE = ((0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0))

numbers = st.floats(-1e5, 1e5)
sizes = st.floats(1e-3, 1e3)
angles = st.floats(-7.0, 7.0)
words = st.text(st.characters(exclude_categories=("Cs",)), max_size=12)
points = st.tuples(numbers, numbers)
colours = st.tuples(*[st.floats(0, 1)] * 3)


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """Any scene that the format can hold, few parts of each sort."""

    def some(strategy: st.SearchStrategy) -> tuple:
        return tuple(draw(st.lists(strategy, max_size=2)))

    labels = iter(range(100))
    label = st.builds(lambda word: f"{next(labels)} {word}", words)
    walls = st.builds(
        lambda name, start, length, texture: Wall(name, start, (start[0] + 1 + length, start[1]), 0.2, 2.5, texture),
        label, points, sizes, st.sampled_from(sorted(WALL_TEXTURES)),
    )  # fmt: skip
    objects = st.builds(
        SceneObject, label, st.sampled_from(sorted(KINDS)), st.tuples(numbers, numbers, numbers), angles,
        st.tuples(sizes, sizes, sizes), colours, words, words,
    )  # fmt: skip
    terrain = st.builds(
        Terrain, label, st.sampled_from(sorted(TERRAIN_KINDS)), st.tuples(numbers, numbers, numbers), angles,
        st.tuples(sizes, sizes), sizes, st.sampled_from(sorted(FLOOR_TEXTURES)),
    )  # fmt: skip
    polygons = st.builds(lambda x, y, a: ((x, y), (x + a + 1, y), (x + a, y + a + 1)), numbers, numbers, sizes)
    return Scene(
        draw(words), (0.5, 0.25, draw(angles)), (1.0, 2.0), (-1.0, -2.0), (3.0, 4.0),
        draw(st.sampled_from(sorted(FLOOR_TEXTURES))), draw(sizes), some(walls), some(objects),
        some(st.builds(lambda x, y: Route(((x, y), (x + 2, y))), numbers, numbers)),
        floors=some(st.builds(Floor, polygons, st.sampled_from(sorted(FLOOR_TEXTURES)), angles)),
        terrain=some(terrain),
        areas=some(st.builds(Area, label, st.sampled_from(sorted(AREA_KINDS)), polygons, words)),
        places=some(st.builds(Place, label, points, angles, st.sampled_from(sorted(PLACE_KINDS)), st.integers(1, 9))),
        ceiling_texture=draw(st.sampled_from(sorted(CEILING_TEXTURES))), sky=draw(colours),
    )  # fmt: skip


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(scenes())
def test_writing_a_scene_and_reading_it_back_gives_the_same_scene(scene: Scene) -> None:
    assert parse_scene(scene_to_toml(scene), "test") == scene


def test_a_shipped_scene_survives_writing() -> None:
    scene = load_scene("corridor")
    assert parse_scene(scene_to_toml(scene), "test") == scene


def test_a_scene_is_loaded_by_the_path_of_its_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(scene_to_toml(PLAIN), encoding="utf-8")
    assert load_scene(path) == load_scene(str(path)) == PLAIN


def test_a_missing_path_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"nowhere\.toml"):
        load_scene(tmp_path / "nowhere.toml")


def test_an_object_without_size_and_colour_gets_those_of_its_kind() -> None:
    text = scene_to_toml(PLAIN) + (
        '[[objects]]\nlabel = "it"\nkind = "forklift"\nposition_m = [0, 0, 0]\nheading_deg = 0\nlandmark = "forklift"\n'
    )
    (thing,) = parse_scene(text, "test").landmarks()
    assert (thing.size_m, thing.colour) == (KINDS["forklift"].size_m, KINDS["forklift"].colour)


@pytest.mark.parametrize(
    ("terrain", "heights_m"),
    [
        pytest.param(
            (Terrain("ramp", "ramp", (0.0, 0.0, 0.0), 0.0, (3.0, 1.2), 0.42, "concrete"),),
            {(-1.6, 0): 0, (-1.5, 0): 0, (0, 0): 0.21, (1.499, 0): 0.42, (1.6, 0): 0, (0, 0.7): 0},
            id="a ramp rises evenly and drops off at its front",
        ),
        pytest.param(
            (Terrain("bump", "bump", (0.0, 0.0, 0.0), 0.0, (0.6, 2.0), 0.05, "asphalt"),),
            {(0, 0.5): 0.05, (0.2999, 0.5): 0, (0.15, 0.5): 0.05 * 0.5**0.5},
            id="a bump follows half a sine wave",
        ),
        pytest.param(
            (
                Terrain("ramp", "ramp", (0.0, 0.0, 0.15), 0.3, (2.0, 1.0), 0.2, "paving"),
                Terrain("slab", "platform", (0.0, 0.0, 0.0), 0.3, (4.0, 4.0), 0.15, "paving"),
            ),
            {(0, 0): 0.25, (-1.8, 0): 0.15},
            id="a ramp on a platform",
        ),
    ],
)
def test_ground_height(terrain: tuple[Terrain, ...], heights_m: dict[tuple[float, float], float]) -> None:
    scene = replace(PLAIN, terrain=terrain)
    assert [scene.ground_height_m(*xy) for xy in heights_m] == pytest.approx(list(heights_m.values()), abs=1e-3)


@pytest.mark.parametrize("kind", sorted(TERRAIN_KINDS))
def test_the_physics_solid_has_the_top_of_the_ground_height(kind: str) -> None:
    terrain = Terrain("it", kind, (1.0, -2.0, 0.1), 0.7, (2.0, 1.0), 0.3, "paving")
    top = max(z for _, _, z in terrain.vertices_m())
    assert top == pytest.approx(0.4)
    for x, y, z in terrain.vertices_m():
        # Just inside the outline, so that rounding does not put the corner beside it.
        inner_x, inner_y = 1.0 + (x - 1.0) * 0.9999, -2.0 + (y + 2.0) * 0.9999
        assert z <= terrain.height_m(inner_x, inner_y) + 1e-3


def test_an_area_contains_its_points_even_round_a_corner() -> None:
    bent = Area("L", "corridor", ((0, 0), (4, 0), (4, 1), (1, 1), (1, 4), (0, 4)), "the corridor with a bend")
    scene = replace(PLAIN, areas=(bent,))
    assert scene.area_at(3.5, 0.5) is scene.area_at(0.5, 3.5) is bent
    assert scene.area_at(2.0, 2.0) is None


def test_an_umbrella_stops_feet_only_at_its_pole_and_foot() -> None:
    thing = SceneObject("u", "umbrella", (0.0, 0.0, 0.0), 0.0, KINDS["umbrella"].size_m, (1, 0, 0), "", "umbrella")
    assert all(max(hypot(x, y) for x, y in box.corners()) < 0.45 for box in thing.boxes)
    assert max(box.centre_m[2] + box.size_m[2] / 2 for box in thing.boxes) > 2


def test_a_round_fountain_does_not_stop_feet_at_the_corners_of_its_square() -> None:
    size = KINDS["fountain"].size_m
    thing = SceneObject("f", "fountain", (1.0, 1.0, 0.0), 0.4, size, (1, 1, 1), "", "fountain")
    reach = max(hypot(x - 1, y - 1) for box in thing.boxes for x, y in box.corners())
    assert reach == pytest.approx(size[0] / 2 / cos(pi / 8), rel=1e-3)
    assert reach < 0.8 * size[0] / 2 * 2**0.5


def test_parts_turn_with_their_object() -> None:
    thing = SceneObject("f", "forklift", (5.0, 0.0, 0.0), radians(90), (3.2, 1.2, 2.1), (1, 1, 0), "", "forklift")
    forks = [box for box in thing.boxes if box.size_m[2] < 0.2]
    assert len(forks) == 2
    assert all(box.centre_m[1] > 1.0 and abs(box.centre_m[0] - 5.0) < 0.4 for box in forks)


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_parts_stay_within_the_visible_object(kind: str) -> None:
    size = KINDS[kind].size_m
    thing = SceneObject("it", kind, (0.0, 0.0, 0.0), 0.0, size, (0.5, 0.5, 0.5), "")
    round_off = 1 / cos(pi / 8)  # an octagon's corners reach a little beyond the circle within it
    for box in thing.boxes:
        assert all(abs(x) <= size[0] / 2 * round_off + 1e-9 for x, _ in box.corners())
        assert all(abs(y) <= size[1] / 2 * round_off + 1e-9 for _, y in box.corners())
        assert -1e-9 <= box.centre_m[2] - box.size_m[2] / 2 < box.centre_m[2] + box.size_m[2] / 2 <= size[2] + 1e-9


@pytest.mark.parametrize(
    ("wrong", "complaint"),
    [
        ('[[floors]]\ntexture = "grass"', "polygon"),
        ('[[floors]]\ntexture = "lava"\nmin_m = [0, 0]\nmax_m = [1, 1]', "lava"),
        ('[[floors]]\ntexture = "grass"\npolygon = [[0, 0], [2, 0], [0.5, 0.5], [0, 2]]', "convex"),
        ('[[areas]]\nlabel = "a"\nkind = "attic"\nname = "a"\npolygon = [[0, 0], [1, 0], [0, 1]]', "attic"),
        ('[[areas]]\nlabel = "a"\nkind = "room"\nname = "a"\npolygon = [[0, 0], [1, 0]]', "three corners"),
        ('[[places]]\nlabel = "p"\nkind = "fly"\nposition_m = [0, 0]\nheading_deg = 0', "fly"),
        ('[[places]]\nlabel = "p"\nkind = "sit"\nposition_m = [0, 0]\nheading_deg = 0\ncapacity = 0', "capacity"),
        ('[[places]]\nlabel = "p"\nkind = "sit"\nposition_m = [0, 0]\nheading_deg = 0\nheading_rad = 0', "both"),
        (
            '[[terrain]]\nlabel = "t"\nkind = "ramp"\nposition_m = [0, 0, 0]\nheading_deg = 0\nsize_m = [1, 1]\n'
            'rise_m = 0\ntexture = "paving"',
            "rise_m",
        ),
    ],
)
def test_a_wrong_part_is_refused_in_one_line(wrong: str, complaint: str) -> None:
    with pytest.raises(SceneError, match=complaint) as error:
        parse_scene(scene_to_toml(PLAIN) + wrong + "\n", "test.toml")
    assert "\n" not in str(error.value)


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
        ("max_m = [28.0, 2.0]", "max_m = [1e6, 1e6]", "floor: expected at most 250000 m²"),
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
