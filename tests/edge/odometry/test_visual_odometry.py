"""The camera's motion: right where it answers, silent where it cannot tell."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.geometry import SE2
from edge.odometry.camera_geometry import Attitude, CameraGeometry, FloorProjector
from edge.odometry.visual_odometry import VisualMotion, VisualOdometry, grey_frame
from tests.support.runner.floor_pictures import GEOMETRY, HEIGHT_PX, WIDTH_PX, floor_texture, picture

FRAME_NS = 100_000_000
TEXTURE = floor_texture()
Grey = npt.NDArray[np.uint8]


def watch(
    frames: Iterable[Grey], eye: VisualOdometry | None = None, attitude: Attitude | None = None
) -> list[VisualMotion]:
    eye = eye or VisualOdometry(GEOMETRY)
    answers = [eye.step(frame, FRAME_NS * index, attitude or Attitude()) for index, frame in enumerate(frames)]
    return [answer for answer in answers if answer is not None]


def along(step: SE2, frames: int) -> list[SE2]:
    poses = [SE2(0.0, 0.0, 0.0)]
    for _ in range(frames - 1):
        poses.append(poses[-1] @ step)
    return poses


def total(answers: list[VisualMotion]) -> SE2:
    pose = SE2(0.0, 0.0, 0.0)
    for answer in answers:
        pose = pose @ answer.T_start_end
    return pose


def true_motion(poses: list[SE2], answers: list[VisualMotion]) -> SE2:
    return poses[answers[0].start_ns // FRAME_NS].inverse() @ poses[answers[-1].end_ns // FRAME_NS]


@pytest.mark.slow
@pytest.mark.parametrize(
    "step",
    [SE2(0.05, 0.0, 0.0), SE2(0.04, 0.0, 0.05), SE2(0.03, 0.02, -0.04), SE2(-0.03, 0.0, 0.0), SE2(0.0, 0.0, 0.06)],
    ids=["ahead", "curve", "sideways curve", "back", "turn on the spot"],
)
def test_a_motion_over_the_floor_is_measured_to_a_percent(step: SE2) -> None:
    poses = along(step, 16)
    answers = watch(picture(TEXTURE, pose) for pose in poses)
    assert answers
    found, true = total(answers), true_motion(poses, answers)
    length = sum(math.hypot(a.T_start_end.x_m, a.T_start_end.y_m) for a in answers)
    assert math.hypot(found.x_m - true.x_m, found.y_m - true.y_m) < 0.012 * length + 0.006
    assert found.theta_rad == pytest.approx(true.theta_rad, abs=0.006)


@pytest.mark.slow
def test_answers_follow_each_other_without_a_gap() -> None:
    answers = watch(picture(TEXTURE, pose) for pose in along(SE2(0.06, 0.0, 0.0), 20))
    assert len(answers) >= 3
    assert all(before.end_ns == after.start_ns for before, after in itertools.pairwise(answers))


def test_a_nod_that_the_robot_reports_is_no_motion() -> None:
    eye = VisualOdometry(GEOMETRY)
    answers = []
    for index in range(12):
        attitude = Attitude(0.02 * math.cos(index), 0.03 * math.sin(index))
        answer = eye.step(picture(TEXTURE, SE2(0.0, 0.0, 0.0), attitude), FRAME_NS * index, attitude)
        answers += [answer] if answer is not None else []
    assert answers
    assert max(math.hypot(a.T_start_end.x_m, a.T_start_end.y_m) for a in answers) < 0.01


@pytest.mark.slow
def test_a_larger_camera_pitch_than_configured_is_estimated_gradually() -> None:
    configured = GEOMETRY
    real = CameraGeometry(
        configured.hfov_rad, configured.height_m, configured.pitch_rad + math.radians(0.4), configured.forward_m
    )
    eye = VisualOdometry(configured)
    for index, pose in enumerate(along(SE2(0.06, 0.0, 0.0), 50)):
        eye.step(picture(TEXTURE, pose, geometry=real), FRAME_NS * index, Attitude())
    assert 0.1 < math.degrees(eye.tilt_rad) < 0.5


def test_a_person_who_walks_through_the_picture_is_outvoted() -> None:
    poses = along(SE2(0.05, 0.0, 0.0), 14)
    frames = []
    person = np.random.default_rng(5).integers(0, 255, (80, 50)).astype(np.uint8)
    for index, pose in enumerate(poses):
        frame = picture(TEXTURE, pose)
        frame[60:140, 40 + 12 * index : 90 + 12 * index] = person[:, : max(0, min(50, WIDTH_PX - 40 - 12 * index))]
        frames.append(frame)
    answers = watch(frames)
    assert answers
    found, true = total(answers), true_motion(poses, answers)
    assert found.x_m == pytest.approx(true.x_m, abs=0.02)


def blurred(pose: SE2) -> Grey:
    floor = cv2.GaussianBlur(picture(TEXTURE, pose)[90:], (0, 0), 30)
    return np.vstack((np.full((90, WIDTH_PX), 128, np.uint8), floor))


NOISE = np.random.default_rng(3)


@pytest.mark.parametrize(
    "look",
    [
        *(lambda _pose, level=level: np.full((HEIGHT_PX, WIDTH_PX), level, np.uint8) for level in (0, 128, 255)),
        lambda pose: (picture(TEXTURE, pose) // 16).astype(np.uint8),
        blurred,
        lambda _pose: NOISE.integers(0, 255, (HEIGHT_PX, WIDTH_PX)).astype(np.uint8),
    ],
    ids=["black", "grey", "overexposed", "dark", "blurred", "noise"],
)
def test_without_a_visible_floor_there_is_no_estimate(look: Callable[[SE2], Grey]) -> None:
    assert watch(look(pose) for pose in along(SE2(0.05, 0.0, 0.0), 15)) == []


def test_corners_are_not_followed_across_a_pause() -> None:
    eye = VisualOdometry(GEOMETRY)
    poses = along(SE2(0.05, 0.0, 0.0), 12)
    stamps = [FRAME_NS * index + (1_000_000_000 if index >= 6 else 0) for index in range(12)]
    answers = [eye.step(picture(TEXTURE, p), ns, Attitude()) for p, ns in zip(poses, stamps, strict=True)]
    assert all(a is None or not (a.start_ns <= stamps[5] and a.end_ns >= stamps[6]) for a in answers)


def test_a_frame_that_does_not_advance_is_ignored() -> None:
    eye = VisualOdometry(GEOMETRY)
    frame = picture(TEXTURE, SE2(0.0, 0.0, 0.0))
    eye.step(frame, 100, Attitude())
    assert eye.step(frame, 100, Attitude()) is None
    assert eye.step(frame, 50, Attitude()) is None


@pytest.mark.parametrize("bad", [np.zeros((180, 320, 3), np.uint8), np.zeros((180, 320)), np.zeros((8, 8), np.uint8)])
def test_an_image_that_is_not_greyscale_is_refused(bad: npt.NDArray[np.generic]) -> None:
    with pytest.raises(ValueError, match="expected a grey uint8 picture"):
        VisualOdometry(GEOMETRY).step(bad, 0, Attitude())  # type: ignore[arg-type]


@given(
    st.floats(0.2, 3.0), st.floats(-1.5, 1.5), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.02, 0.02)
)  # fmt: skip
def test_a_floor_point_projects_to_its_pixel(x: float, y: float, roll: float, pitch: float, lift: float) -> None:
    projector, attitude = FloorProjector(GEOMETRY, WIDTH_PX, HEIGHT_PX), Attitude(roll, pitch, lift)
    point = np.array([[x + GEOMETRY.forward_m, y]])
    back, depression = projector.floor_points(projector.pixels(point, attitude), attitude)
    assert depression[0] > 0
    assert back[0] == pytest.approx(point[0], abs=1e-6)


@pytest.mark.parametrize(("width", "expected"), [(320, 320), (640, 320), (1280, 320), (2560, 320), (200, 200)])
def test_a_large_jpeg_is_shrunk_while_it_is_decoded(width: int, expected: int) -> None:
    _, data = cv2.imencode(".jpg", np.zeros((width * 9 // 16, width, 3), np.uint8))
    grey = grey_frame(data.tobytes())
    assert grey is not None
    assert grey.shape[1] == expected


@pytest.mark.slow
@pytest.mark.parametrize(
    ("height_m", "hfov_deg", "pitch_deg"), [(0.2, 90, 5), (1.0, 70, 15), (1.5, 90, 5)], ids=["low", "high", "higher"]
)
def test_a_camera_at_another_height_measures_as_well(height_m: float, hfov_deg: float, pitch_deg: float) -> None:
    geometry = CameraGeometry(math.radians(hfov_deg), height_m, math.radians(pitch_deg), 0.2)
    poses = along(SE2(0.04, 0.0, 0.05), 16)
    answers = watch((picture(TEXTURE, pose, geometry=geometry) for pose in poses), VisualOdometry(geometry))
    assert answers
    found, true = total(answers), true_motion(poses, answers)
    assert math.hypot(found.x_m - true.x_m, found.y_m - true.y_m) < 0.008
