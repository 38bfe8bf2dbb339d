"""Recordings of real robots become drives of 20 s at 10 Hz, and no frame is given anything that came after it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from math import cos, pi, sin
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tools.train.config.checks import TrainError
from tools.train.drives.drive import Dataset
from tools.train.drives.futures import relative
from tools.train.importers.__main__ import import_folder, main
from tools.train.importers.cut import FRAMES, drives, pieces
from tools.train.importers.recording import Recording, read_gnd, read_picture, read_scand

FIRST_NS = 1_636_492_800_123_456_789
SPEED_MPS, TURN_RADPS = 0.6, 0.1
PICTURE_HZ, POSE_HZ = 15.0, 50.0


def _picture(path: Path, number: int) -> None:
    """A grey 64 x 36 picture as bright as its number."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full((36, 64, 3), 20 + number % 200, np.uint8))


def _pose(time_s: float) -> tuple[float, float, float]:
    turned = TURN_RADPS * time_s
    radius = SPEED_MPS / TURN_RADPS
    return (5 + radius * sin(turned), -2 - radius * cos(turned), turned)


def _times(rate_hz: float, length_s: float) -> list[float]:
    return [k / rate_hz for k in range(round(length_s * rate_hz) + 1)]


def _scand(folder: Path, length_s: float = 45.0, texts: Mapping[str, Any] | None = None) -> Path:
    """A recording in SCAND's layout, an arc at constant speed."""
    for number, time_s in enumerate(_times(PICTURE_HZ, length_s)):
        _picture(folder / "image" / f"{FIRST_NS + round(time_s * 1e9)}.jpg", number)
    rows = [
        ",".join(map(str, (*_pose(time_s), 0.0, FIRST_NS + round(time_s * 1e9))))
        for time_s in _times(POSE_HZ, length_s)
    ]
    (folder / "odometry.csv").write_text("\n".join(["x_m,y_m,theta_rad,speed,stamp_ns", *rows]) + "\n")
    if texts is not None:
        (folder / "texts.json").write_text(json.dumps(texts))
    return folder


def _gnd(folder: Path, length_s: float = 25.0) -> Path:
    """A recording in GND's layout, the same arc on a ramp's height."""
    frames = []
    for number, time_s in enumerate(_times(PICTURE_HZ, length_s)):
        _picture(folder / "camera" / f"{number:05d}.png", number)
        frames.append({"stamp_s": 1.7e9 + time_s, "file": f"camera/{number:05d}.png"})
    poses = []
    for time_s in _times(POSE_HZ, length_s):
        x, y, theta = _pose(time_s)
        quaternion = [0.0, 0.0, sin(theta / 2), cos(theta / 2)]
        poses.append({"stamp_s": 1.7e9 + time_s, "position_m": [x, y, 0.3], "quaternion_xyzw": quaternion})
    (folder / "recording.json").write_text(json.dumps({"frames": frames, "poses": poses}))
    return folder


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """45 s of SCAND."""
    return read_scand(_scand(tmp_path_factory.mktemp("scand") / "A_Spot_1"))


@pytest.fixture(scope="module")
def recording_gnd(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """25 s of GND."""
    return read_gnd(_gnd(tmp_path_factory.mktemp("gnd") / "campus-1"))


def _synthetic(
    stamps_s: list[float] | np.ndarray, pose_times_s: list[float] | np.ndarray, pose: Callable[[float], Any] = _pose
) -> Recording:
    """A recording of which nobody opens a picture."""
    return Recording(
        "made-up",
        np.array(stamps_s),
        tuple(Path(f"{k}.jpg") for k in range(len(stamps_s))),
        np.array([(time_s, *pose(time_s)) for time_s in pose_times_s]),
        {},
    )


# -- 10 Hz ------------------------------------------------------------------------------------------------------------


def test_poses_are_where_it_was_at_every_tenth_of_a_second(recording: Recording) -> None:
    (piece,) = pieces(recording)
    assert len(piece.pose) == 450
    expected = np.array([_pose(k / 10) for k in range(1, 451)])
    expected[:, 2] = (expected[:, 2] + pi) % (2 * pi) - pi
    assert np.allclose(piece.pose, expected, atol=1e-3)


def test_every_instant_has_the_newest_picture_that_was_there_by_then(recording: Recording) -> None:
    (piece,) = pieces(recording)
    times = recording.stamps_s[0] + np.arange(1, len(piece.picture) + 1) / 10
    ages = times - recording.stamps_s[piece.picture]
    assert ages.min() > -2e-5 and ages.max() < 1 / PICTURE_HZ + 1e-5


def test_the_state_is_of_the_tenth_before_and_independent_of_later_motion(recording: Recording) -> None:
    (piece,) = pieces(recording)
    assert np.allclose(piece.state, (SPEED_MPS, 0.0, TURN_RADPS), atol=0.02)

    def stops(time_s: float) -> tuple[float, float, float]:
        return _pose(min(time_s, 5.0))

    times = np.arange(0.0, 10.0, 0.02)
    (going,), (stopping,) = (pieces(_synthetic(times, times, pose)) for pose in (_pose, stops))
    assert np.array_equal(going.state[:49], stopping.state[:49])
    assert np.allclose(stopping.state[51:], 0.0, atol=1e-6)


def test_a_hole_in_the_pictures_cuts_the_recording() -> None:
    stamps = [k / 10 for k in range(100) if not 40 <= k < 60]
    found = pieces(_synthetic(stamps, np.arange(0.0, 9.9, 0.02)))
    assert [len(piece.pose) for piece in found] == [41, 39]
    assert np.allclose(found[1].pose[0], _pose(6.0), atol=1e-3)
    assert np.allclose(found[1].state[0], (SPEED_MPS, 0.0, TURN_RADPS), atol=0.02)


# -- episodes ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_episodes_are_of_twenty_seconds_and_the_rest_is_left_out(recording: Recording) -> None:
    found = list(drives(recording, "scand", "spot"))
    assert [drive.id for drive in found] == ["scand-A_Spot_1-0000", "scand-A_Spot_1-0001"]
    assert [len(drive) for drive in found] == [FRAMES, FRAMES] == [200, 200]
    assert np.allclose(found[1].pose[0], _pose(20.1), atol=1e-3)
    assert found[0].about.driver == "imported" and found[0].about.robot == "spot" and not found[0].wordings


@pytest.mark.slow
def test_labels_are_the_driven_future_and_waypoints_where_it_then_was(recording: Recording) -> None:
    first, second = drives(recording, "scand", "spot")
    whole = pieces(recording)[0].pose
    assert np.allclose(first.future[17], relative(whole[17], whole[18:68]), atol=1e-5)
    assert np.allclose(first.plan_xy[17], relative(whole[17], whole[[47, 77, 107]])[:, :2], atol=1e-5)
    # The recording goes on after an episode's end, so its last labels are whole as well.
    assert np.all(first.future_steps == 50)
    assert np.allclose(first.future[199], relative(whole[199], whole[200:250]), atol=1e-5)
    assert np.all(second.future_steps == 50)


def test_at_the_recordings_end_the_future_is_as_long_as_it_is_known(tmp_path: Path) -> None:
    (drive,) = drives(read_scand(_scand(tmp_path / "A", 20.4)), "scand", "spot")
    assert [int(drive.future_steps[k]) for k in (153, 154, 199)] == [50, 49, 4]
    assert np.array_equal(drive.future[199, 4:], np.repeat(drive.future[199, 3:4], 46, axis=0))


def test_pictures_are_squeezed_whole_to_128_pixels(recording: Recording) -> None:
    first = next(drives(recording, "scand", "spot"))
    picture = first.frame(100)  # at 10.1 s: picture 151 of 15 Hz
    assert picture.shape == (128, 128, 3) and np.abs(picture.mean() - 171) < 3


@pytest.mark.slow
def test_gnds_poses_in_space_become_poses_on_the_ground(recording_gnd: Recording) -> None:
    (drive,) = drives(recording_gnd, "gnd", "jackal")
    assert drive.id == "gnd-campus-1-0000"
    assert np.allclose(drive.pose[::50], [_pose(k / 10) for k in (1, 51, 101, 151)], atol=2e-3)
    assert np.all(drive.future_steps[:199] == 50) and drive.future_steps[199] == 50


# -- words ------------------------------------------------------------------------------------------------------------

TRACE = {
    "situation": "on a sidewalk",
    "objects": "none",
    "motion": "nobody near",
    "progress": {"step": 1, "steps": 1, "passed": 0},
    "plan": "turn left into the yard in 3 m",
}


@pytest.mark.slow
def test_an_instruction_belongs_to_its_own_episode(tmp_path: Path) -> None:
    texts = {"1": {"wordings": ["follow the path", "go along the path"], "traces": [TRACE] * 20}}
    first, second = drives(read_scand(_scand(tmp_path / "A", 41.0, texts)), "scand", "spot")
    assert first.wordings == () and first.traces == ()
    assert second.wordings == ("follow the path", "go along the path")
    assert [trace["k"] for trace in second.traces] == list(range(0, 200, 10))
    assert second.trace_at(15) == {"k": 10, **TRACE}


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        ({"7": {"wordings": ["go"]}}, "texts for episode 7; expected a number below 1"),
        ({"0": {"wordings": ["go"], "traces": [TRACE]}}, "expected 20 traces"),
        ({"0": {"wordings": ["go"], "mood": "good"}}, "wordings and traces"),
        ({"0": {"wordings": "go"}}, "list of texts"),
        ({"0": {"wordings": ["go"], "traces": [{"plan": "go"}]}}, "each trace to have"),
        ({"0": {"wordings": ["go"], "traces": [{**TRACE, "plan": "go"}] * 20}}, "plan 'go'.*grammar"),
        ({"first": {"wordings": ["go"]}}, "number of an episode"),
    ],
)
def test_invalid_instructions_are_refused(tmp_path: Path, texts: Mapping[str, Any], message: str) -> None:
    with pytest.raises(TrainError, match=message):
        list(drives(read_scand(_scand(tmp_path / "A", 21.0, texts)), "scand", "spot"))


# -- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("stamp_ns,x_m,y_m\n1,2,3\n", "column theta_rad is missing"),
        ("stamp_ns,x_m,y_m,theta_rad\n1,2,north,3\n", "not of numbers"),
    ],
)
def test_odometry_that_cannot_be_is_refused(tmp_path: Path, rows: str, message: str) -> None:
    folder = _scand(tmp_path / "A", 1.0)
    (folder / "odometry.csv").write_text(rows)
    with pytest.raises(TrainError, match=message):
        read_scand(folder)


def test_a_picture_without_a_stamp_is_refused(tmp_path: Path) -> None:
    folder = _scand(tmp_path / "A", 1.0)
    _picture(folder / "image" / "first.jpg", 1)
    with pytest.raises(TrainError, match="whole nanoseconds"):
        read_scand(folder)


@pytest.mark.parametrize("name", ["/etc/hostname", "../secret.png", "camera/../../secret.png"])
def test_a_recording_reads_nothing_outside_of_its_folder(tmp_path: Path, name: str) -> None:
    folder = _gnd(tmp_path / "A", 1.0)
    content = json.loads((folder / "recording.json").read_text())
    content["frames"][3]["file"] = name
    (folder / "recording.json").write_text(json.dumps(content))
    with pytest.raises(TrainError, match="not a path below"):
        read_gnd(folder)


def test_a_quaternion_that_is_none_is_refused(tmp_path: Path) -> None:
    folder = _gnd(tmp_path / "A", 1.0)
    content = json.loads((folder / "recording.json").read_text())
    content["poses"][3]["quaternion_xyzw"] = [0.0, 0.0, 0.0, 0.5]
    (folder / "recording.json").write_text(json.dumps(content))
    with pytest.raises(TrainError, match="length 1"):
        read_gnd(folder)


def test_stamps_that_do_not_grow_are_refused(recording: Recording) -> None:
    stamps = recording.stamps_s.copy()
    stamps[5] = stamps[4]
    with pytest.raises(TrainError, match="increasing stamps"):
        replace(recording, stamps_s=stamps)


def test_a_file_that_is_no_picture_is_refused(tmp_path: Path) -> None:
    for name in ("a.jpg", "a.png"):
        (tmp_path / name).write_bytes(b"something else entirely")
        with pytest.raises(TrainError, match=name):
            read_picture(tmp_path / name)


# -- the command ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_folder_of_recordings_becomes_a_data_set(tmp_path: Path) -> None:
    _scand(tmp_path / "in" / "A", 21.0)
    _scand(tmp_path / "in" / "B", 21.0)
    (tmp_path / "in" / "notes").mkdir()
    result = import_folder(tmp_path / "in", "scand", "spot", tmp_path / "out")
    found = Dataset.open(tmp_path / "out", verify=True)
    assert found.ids == ("scand-A-0000", "scand-B-0000")
    assert (result["recordings"], result["drives"], result["sha256"]) == (2, 2, found.sha256)


def test_the_command_reports_an_error_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["gnd", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "found no recording of gnd" in said
