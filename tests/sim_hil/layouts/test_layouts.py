"""Generated layouts: every seed gives another valid scene; the benchmark's seeds are kept apart from training's."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sim_hil import layouts
from sim_hil.benchmark.language.instruction_words import AREAS, NAME
from sim_hil.layouts.__main__ import main
from sim_hil.layouts.check import overlaps, problems
from sim_hil.layouts.plan import LayoutError, Rect, shared_border, wall_lines
from sim_hil.scene.map import draw_map, map_view
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Scene, load_scene

SEED = 4711


@pytest.fixture(scope="module")
def made() -> dict[str, Scene]:
    return {kind: layouts.generate(kind, SEED) for kind in layouts.KINDS}


@pytest.mark.parametrize("kind", layouts.KINDS)
def test_a_layout_is_sound(kind: str, made: dict[str, Scene]) -> None:
    assert problems(made[kind]) == []


@pytest.mark.parametrize("kind", layouts.KINDS)
def test_every_doorway_is_passable_for_a_robot_almost_a_metre_wide(kind: str, made: dict[str, Scene]) -> None:
    scene = made[kind]
    grid = NavGrid(scene, clearance_m=0.48, resolution_m=0.2 if kind == "sidewalk" else 0.1)
    reached = np.isfinite(grid.distance_field(scene.start[:2]))
    for area in scene.areas:
        if area.kind == "street":
            continue
        (x0, y0), (x1, y1) = area.polygon[0], area.polygon[2]
        low, high = grid.cell(min(x0, x1), min(y0, y1)), grid.cell(max(x0, x1), max(y0, y1))
        assert reached[low[0] : high[0], low[1] : high[1]].any(), f"{area.label} is shut"


@pytest.mark.slow
@pytest.mark.parametrize("kind", layouts.KINDS)
def test_the_same_seed_gives_the_same_scene_and_another_seed_another(kind: str, made: dict[str, Scene]) -> None:
    assert layouts.generate(kind, SEED) == made[kind]
    other = layouts.generate(kind, SEED + 1)
    assert {area.polygon for area in other.areas} != {area.polygon for area in made[kind].areas}


@pytest.mark.slow
@pytest.mark.parametrize("kind", layouts.KINDS)
def test_the_benchmarks_scene_is_what_its_reserved_seed_gives(kind: str) -> None:
    assert load_scene(kind) == layouts.generate(kind, layouts.BENCHMARK_SEEDS[kind], reserved=True)


@pytest.mark.parametrize(
    ("kind", "seed", "complaint"),
    [("office", layouts.BENCHMARK_SEEDS["office"], "reserved"), ("castle", SEED, "hospital"), ("office", -1, "seed")],
)
def test_reserved_seeds_unknown_kinds_and_negative_seeds_are_refused(kind: str, seed: int, complaint: str) -> None:
    with pytest.raises(LayoutError, match=complaint):
        layouts.generate(kind, seed)


@pytest.mark.parametrize("kind", layouts.KINDS)
def test_every_landmark_and_named_area_has_a_name_that_instructions_know(kind: str, made: dict[str, Scene]) -> None:
    for thing in made[kind].landmarks():
        assert re.fullmatch(NAME, thing.landmark), thing.landmark
    for area in made[kind].areas:
        if area.kind in ("lobby", "yard", "plaza"):
            assert area.name in AREAS


def test_overlapping_objects_are_found(made: dict[str, Scene]) -> None:
    scene = made["hospital"]
    bed = next(thing for thing in scene.objects if thing.kind == "hospital_bed")
    twin = replace(bed, label="twin", position_m=(bed.position_m[0] + 0.3, *bed.position_m[1:]))
    assert any("twin" in line for line in overlaps(replace(scene, objects=(*scene.objects, twin))))


def test_a_room_that_was_walled_up_is_found(made: dict[str, Scene]) -> None:
    scene = made["office"]
    bar = next(thing for thing in scene.objects if thing.kind == "cabinet")
    # A cabinet as long as the building right before the start shuts off everything behind it.
    x, y, _ = scene.start
    length = max(scene.floor_max_m) * 2
    wall = replace(bar, label="bar", position_m=(x + 0.9, y, 0.0), heading_rad=0.0, size_m=(0.2, length, 1.0))
    found = problems(replace(scene, objects=(*scene.objects, wall)))
    assert any("cannot be reached" in line for line in found)


@pytest.mark.slow
def test_the_command_writes_a_scene_and_a_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, picture = tmp_path / "w.toml", tmp_path / "w.png"
    code = main(["warehouse", "--seed", str(SEED), "--out", str(out), "--map", str(picture), "--json", "-"])
    assert code == 0
    assert load_scene(out) == layouts.generate("warehouse", SEED)
    assert picture.stat().st_size > 1000
    assert json.loads(capsys.readouterr().out)["name"] == "warehouse"


def test_the_command_refuses_a_reserved_seed_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["office", "--seed", "5", "--out", str(tmp_path / "o.toml")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "o.toml").exists()


def test_a_map_shows_things_where_they_stand(made: dict[str, Scene]) -> None:
    scene = made["warehouse"]
    image, view = draw_map(scene, 20.0), map_view(scene, 20.0)
    rack = next(thing for thing in scene.objects if thing.kind == "storage_rack")
    # Beside the line that shows where it looks.
    x, y = rack.position_m[0] + 0.25, rack.position_m[1] + 0.25
    column, row = view.pixel((x, y))
    assert image[row, column] == pytest.approx([round(255 * c) for c in rack.colour], abs=2)
    assert image.shape[0] == round((scene.floor_max_m[1] + 1) * 20)


def _total_m(lines: list[tuple[tuple[float, float], tuple[float, float]]]) -> float:
    return sum(abs(b[0] - a[0]) + abs(b[1] - a[1]) for a, b in lines)


def test_two_rooms_share_the_stretch_on_which_both_border() -> None:
    border = shared_border(Rect(0, 0, 4, 3), Rect(4, 1, 8, 5))
    assert (border.along_x, border.at, border.low, border.high) == (False, 4, 1, 3)
    assert border.middle == (4, 2)


def test_rooms_that_meet_in_a_corner_share_nothing() -> None:
    with pytest.raises(LayoutError, match="do not touch"):
        shared_border(Rect(0, 0, 1, 1), Rect(1, 1, 2, 2))


def test_a_wall_between_two_rooms_is_built_once() -> None:
    lines = wall_lines([Rect(0, 0, 4, 3), Rect(4, 0, 8, 3)], [])
    assert sum(a[0] == b[0] == 4 for a, b in lines) == 1
    # Outline 2 * (8 + 3) and 3 m between them; corners are filled by no more than half a wall each.
    assert _total_m(lines) == pytest.approx(25, abs=0.4)


def test_an_opening_leaves_a_gap_of_its_own_width() -> None:
    rooms = [Rect(0, 0, 4, 3), Rect(4, 0, 8, 3)]
    border = shared_border(*rooms)
    closed, opened = wall_lines(rooms, []), wall_lines(rooms, [border.cut(1.0, 2.2)])
    assert _total_m(closed) - _total_m(opened) == pytest.approx(1.2)
    assert not any(a[0] == b[0] == 4 and a[1] < 1.6 < b[1] for a, b in opened)


def test_a_rectangle_without_area_is_refused() -> None:
    with pytest.raises(LayoutError, match="without area"):
        Rect(1, 1, 1, 2)
