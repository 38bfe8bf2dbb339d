"""The validator: it finds the shipped suite sound, and finds each way in which an episode could lie."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from sim_hil.benchmark.conditions.rewording import training_texts
from sim_hil.benchmark.language.task_checks import MIN_PIXELS
from sim_hil.benchmark.language.visibility import EYE_M, Sightlines
from sim_hil.benchmark.suite.episode import Episode, load_suite, suite_to_toml
from sim_hil.benchmark.suite.validate import Validator, main, validate
from sim_hil.scene.scene import SceneError, SceneObject, load_scene, scene_to_toml
from tests.support.benchmark import dynanav_fakes
from tests.support.benchmark.benchmark_episodes import block, hall

EPISODES = load_suite("dynanav")
SOUND = next(episode for episode in EPISODES if episode.task == "warehouse-cone")


@pytest.fixture(scope="module")
def validator() -> Validator:
    return Validator()


def problems(validator: Validator, **changes: object) -> str:
    return "\n".join(validator.problems(replace(SOUND, **changes)))  # type: ignore[arg-type]


@pytest.mark.slow
def test_the_shipped_suite_is_sound() -> None:
    # An episode a task and, of the large outdoor scene, two tasks: the command checks all 85.
    chosen: dict[str, Episode] = {}
    for episode in EPISODES:
        chosen.setdefault(episode.task, episode)
    outdoors = [name for name, episode in chosen.items() if episode.scene == "sidewalk"]
    for name in outdoors[2:]:
        del chosen[name]
    assert len(chosen) == 17
    assert validate(list(chosen.values())) == {}


def test_a_sound_episode_has_no_problems(validator: Validator) -> None:
    assert problems(validator) == ""


def reworded(*pairs: tuple[str, str]) -> tuple[str, ...]:
    """The sound episode's instructions with some words replaced."""
    texts = SOUND.instructions
    for old, new in pairs:
        texts = tuple(text.replace(old, new) for text in texts)
    return texts


TRAINING_PATTERN = "Enter the second aisle on the right and stop at the traffic cone."


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"shortest_m": SOUND.shortest_m - 0.5}, "shortest_m"),
        ({"timeout_s": 5.0}, "timeout_s"),
        ({"goal_xy": (SOUND.goal_xy[0], SOUND.goal_xy[1] + 6.0)}, "away from"),
        ({"threshold_m": 4.0}, "through a wall"),
        ({"instructions": reworded(("right", "<"), ("left", "right"), ("<", "left"))}, "expected right, found left"),
        ({"instructions": reworded(("second", "third"))}, "expected number 2, found 3"),
        ({"instructions": reworded(("traffic cone", "forklift"))}, "goal: expected traffic cone"),
        ({"instructions": ("Stop at the traffic cone.",)}, "leaves out 1 of 1 turns"),
        ({"instructions": (TRAINING_PATTERN,)}, "belongs to training"),
    ],
)
def test_a_false_episode_is_found(validator: Validator, change: dict[str, object], problem: str) -> None:
    assert problem in problems(validator, **change)


def test_a_timeout_that_leaves_no_time_to_stop_and_think_is_found(validator: Validator) -> None:
    assert "at 0.12 m/s" in problems(validator, timeout_s=SOUND.shortest_m / 0.13)
    assert problems(validator, timeout_s=SOUND.shortest_m / 0.11) == ""


def test_a_start_in_a_rack_is_found(validator: Validator) -> None:
    rack = next(thing for thing in load_scene("warehouse").objects if thing.kind == "storage_rack")
    assert "start is not free" in problems(validator, start=(*rack.position_m[:2], 0.0))


def test_landmarks_that_no_wording_names_are_found(validator: Validator) -> None:
    other = next(t.label for t in load_scene("warehouse").landmarks() if t.label != SOUND.goal_landmark)
    assert "the instructions name" in problems(validator, landmarks=(SOUND.goal_landmark, other))


def test_the_command_lists_the_problems_and_exits_with_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    path = tmp_path / "wrong.toml"
    path.write_text(suite_to_toml("wrong", 1, [replace(SOUND, timeout_s=5.0)]), encoding="utf-8")
    assert main(["--suite", str(path), "--json", "-"]) == 1
    result = json.loads(capsys.readouterr().out)
    assert (result["episodes"], result["wrong"]) == (1, 1)
    assert "timeout_s" in result["problems"][SOUND.id][0]


def test_the_command_refuses_an_unreadable_suite(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--suite", "nowhere.toml"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


PLATE = SceneObject("plate", "notice_board", (4.0, 0.0, 0.0), 3.141592653589793, (0.01, 1.0, 0.7), (1, 0, 0), "")


def test_a_plate_is_as_large_in_the_picture_as_optics_say() -> None:
    lines = Sightlines(load_scene("corridor"))
    # 128 px over 2 tan 50 deg = 2.38 m at 1 m across; 16:9 squeezed into a square: 1.78 times as dense upwards.
    expected = 1.0 * 0.7 * (64 / 1.1918) ** 2 * 16 / 9 / 3.995**2
    assert lines.pixels((0.0, 0.0, EYE_M), 0.0, PLATE, 12.0) == pytest.approx(expected, rel=0.03)


def test_landmarks_behind_the_robot_a_wall_or_beyond_range_are_not_seen() -> None:
    lines = Sightlines(load_scene("corridor"))
    eye = (0.0, 0.0, EYE_M)
    assert lines.pixels(eye, 3.1, PLATE, 12.0) == 0
    assert lines.pixels(eye, 0.0, PLATE, 3.0) == 0
    beyond = replace(PLATE, position_m=(8.0, 3.5, 0.0), heading_rad=-1.5707963)
    assert lines.pixels((8.0, 0.0, EYE_M), 1.5707963, beyond, 12.0) == 0
    assert lines.pixels((8.0, 0.0, EYE_M), 1.5707963, replace(beyond, position_m=(8.0, 1.5, 0.0)), 12.0) > MIN_PIXELS


def test_a_scene_without_room_is_one_line_for_every_reader(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, suite = tmp_path / "full.toml", tmp_path / "suite.toml"
    scene.write_text(scene_to_toml(hall(block(0.0, 0.0, 20.0, 10.0))), encoding="utf-8")
    text = dynanav_fakes.suite_text("a").replace('scene = "corridor"', f'scene = "{scene}"')
    suite.write_text(text.replace("[1.0, 0.0, 0.0]", "[-8.0, 0.0, 0.0]"), encoding="utf-8")
    assert main(["--suite", str(suite)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "expected room for a clearance of" in error
    with pytest.raises(SceneError, match="expected room"):
        training_texts(load_suite(str(suite)))
