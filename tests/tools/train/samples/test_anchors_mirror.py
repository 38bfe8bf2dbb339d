"""A mirrored drive is the drive of another place: left and right are exchanged everywhere, and nothing else is."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.core.geometry import SE2
from edge.state.reasoning_text import format_text, parse_text
from tests.support.train.train_drives import MadeUpTokens, made_up_drive, tiny_model
from tests.support.train.train_imitate_rank import CONFIG, SideStates, imitate_job, side_dataset, side_drive
from tools.train.config.imitate import DelayConfig, SampleConfig
from tools.train.drives import trace_sentences as trace_words
from tools.train.drives.drive import Dataset, Drive
from tools.train.imitate.data import Delays, Samples, Source
from tools.train.imitate.imitate import run
from tools.train.samples.anchors import anchors_of
from tools.train.samples.drive_frames import DriveFrames
from tools.train.samples.mirror import (
    MirroredDrives,
    MirrorTokens,
    Views,
    balanced,
    mirrored,
    mirrored_drive,
    mirrored_frames,
    mirrored_reasoning,
    mirrored_text,
)


@pytest.mark.parametrize(
    ("text", "other"),
    [
        ("Take the second left, then turn right.", "Take the second right, then turn left."),
        ("All right, keep to the left side", "All right, keep to the right side"),
        ("all right, turn right", "all right, turn left"),
        ("Left at the desk", "Right at the desk"),
        ("Motion: person ahead 2 m crossing left.", "Motion: person ahead 2 m crossing right."),
        ("the handrail and the copyright sign", "the handrail and the copyright sign"),
    ],
)
def test_sides_are_exchanged_and_no_other_word(text: str, other: str) -> None:
    assert mirrored_text(text) == other
    assert mirrored_text(other) == text


def test_every_reasoning_text_has_a_mirror_image_with_the_same_words_but_for_the_sides() -> None:
    for text in itertools.islice(trace_words.corpus(), 0, None, 7):
        aspects = dataclasses.replace(parse_text(text), waypoints=None)
        other = mirrored_reasoning(aspects)
        assert format_text(other) == mirrored_text(format_text(aspects))
        assert mirrored_reasoning(other) == aspects


def test_an_anchor_in_the_mirror_tells_the_same_story_on_the_other_side() -> None:
    for anchor in anchors_of(made_up_drive("a")):
        other = mirrored(anchor)
        assert mirrored(other) == anchor
        assert [x for x, _ in other.way] == [x for x, _ in anchor.way]
        assert [y for _, y in other.way] == [-y for _, y in anchor.way]
        assert other.reasoning.waypoints == pytest.approx(np.array(anchor.points) * (1, -1))
        assert other.reasoning.progress == anchor.progress
        assert (other.earlier, other.frames) == (anchor.earlier, anchor.frames)
        texts = format_text(anchor.reasoning), format_text(other.reasoning)
        assert ("turn right into the room" in texts[1]) == ("turn left into the room" in texts[0])
        assert "-0.0" not in texts[1]


def half_white(drive_id: str, frames: int) -> Drive:
    """White on the left, the right getting lighter from frame to frame."""
    pieces = []
    for k in range(frames):
        picture = np.full((128, 128, 3), 255, np.uint8)
        picture[:, 64:] = 4 * k
        pieces.append(cv2.imencode(".jpg", picture)[1].reshape(-1))
    plain = made_up_drive(drive_id, frames)
    return dataclasses.replace(
        plain, jpeg=np.concatenate(pieces), jpeg_end=np.cumsum([len(piece) for piece in pieces], dtype=np.int64)
    )


def test_an_anchors_view_is_of_its_own_frames_on_either_side() -> None:
    views = Views(MadeUpTokens(), MadeUpTokens(10))
    anchor = anchors_of(made_up_drive("a"))[-1]
    for plain, other in zip(views.of(anchor), views.of(anchor, in_mirror=True), strict=True):
        np.testing.assert_array_equal(plain, other)
    with pytest.raises(ValueError, match="mirror image"):
        Views(MadeUpTokens()).of(anchor, in_mirror=True)
    with pytest.raises(ValueError, match="mirror image"):
        views.of(dataclasses.replace(anchor, frames=(25, 55)), in_mirror=True)


EVEN = SampleConfig().undisturbed()


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return side_dataset(tmp_path_factory.mktemp("collect"))


def test_its_anchors_are_those_that_fine_tuning_has_learned_from() -> None:
    drive = side_drive("left-a")
    assert anchors_of(mirrored_drive(drive)) == [mirrored(anchor) for anchor in anchors_of(drive)]


def test_motion_and_labels_go_to_the_other_side() -> None:
    drive = side_drive("left-a")
    other, right = mirrored_drive(drive), side_drive("right-a")
    for name in ("pose", "state", "future", "plan_xy"):
        np.testing.assert_allclose(getattr(other, name), getattr(right, name), atol=1e-5, err_msg=name)
    assert other.about.goal_xy == pytest.approx(right.about.goal_xy)
    moved = other.T_odom_base(20).inverse() @ other.T_odom_base(90)
    true = drive.T_odom_base(20).inverse() @ drive.T_odom_base(90)
    assert moved.as_tuple() == pytest.approx(SE2(true.x_m, -true.y_m, -true.theta_rad).as_tuple())


@pytest.mark.parametrize(("turn_rad", "is_drawn"), [(1.9, True), (2.5, False), (-2.5, True)])
def test_a_turn_about_to_the_left_has_no_mirror_image(turn_rad: float, is_drawn: bool) -> None:
    drive = made_up_drive("about")
    future = np.zeros_like(drive.future)
    future[20, :, 2] = np.linspace(0.0, turn_rad, future.shape[1])
    frames = DriveFrames.of(mirrored_drive(dataclasses.replace(drive, future=future)), 50, EVEN.weights)
    assert (mirrored_frames(frames).weight[20] > 0) == is_drawn


class MirroredSeconds:
    """Tokens of 13 seconds; the first number says which."""

    def frames(self, drive_id: str) -> np.ndarray:
        return np.broadcast_to(np.arange(13, dtype=np.float16)[:, None, None], (13, 4, 32))


@pytest.mark.slow
def test_samples_of_the_mirror_are_as_many_as_asked_for_and_of_whole_seconds(dataset: Dataset) -> None:
    plain = [DriveFrames.of(drive, 30, EVEN.weights) for drive in dataset.drives(dataset.train)]
    reflected = MirroredDrives.of(dataset).drives(dataset.train, pictures=False)
    others = [mirrored_frames(DriveFrames.of(drive, 30, EVEN.weights)) for drive in reflected]
    states = SideStates(dataset)
    samples = Samples(
        balanced(plain, others, 0.3),
        MadeUpTokens(),
        states,
        Delays.uniform(DelayConfig()),
        EVEN,
        tiny_model(),
        mirror=Source(MirrorTokens(MirroredSeconds()), states),
        drop=False,
    )
    count = 0
    for number in range(600):
        rng = np.random.default_rng((1, number))
        chosen = samples.choose(rng)
        group = samples.take(chosen, rng)
        drive = samples.drives[chosen.drive]
        if not drive.in_mirror:
            continue
        count += 1
        true = plain[[each.id for each in plain].index(drive.id)]
        for i, k in enumerate(chosen.ks):
            assert k % 10 == 0 and (group.visual_tokens[i] == k // 10).all()
            np.testing.assert_allclose(group.target[i], true.target[k] * (1.0, -1.0, -1.0), atol=1e-6)
            offset = true.offset(chosen.anchor, k)
            np.testing.assert_allclose(
                group.latency[i], (chosen.ages[i] / 10, offset.x_m, -offset.y_m, -offset.theta_rad), atol=1e-5
            )
    assert count / 600 == pytest.approx(0.3, abs=0.05)


@pytest.mark.slow
def test_a_run_learns_from_mirrored_samples_where_the_recipe_enables_it(tmp_path: Path) -> None:
    losses = []
    for share in (0.0, 0.5):
        side_dataset(tmp_path / f"{share}" / "collect")
        config = dataclasses.replace(CONFIG, samples=8, mirrored=share)
        losses.append(run(imitate_job(tmp_path / f"{share}", config))["loss"])
        folders = {path.name for path in (tmp_path / f"{share}" / "collect").iterdir() if path.is_dir()}
        assert ("kv-mirrored" in folders) == ("tokens-mirrored" in folders) == bool(share)
    assert losses[0] != losses[1]
