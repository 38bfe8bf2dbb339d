"""Augmented images and samples show the same content: nothing is moved, and the text stays true."""

from __future__ import annotations

import numpy as np
import pytest

from edge.core.geometry import SE2
from edge.state.reasoning_text import format_text, parse_waypoints
from tests.support.train.train_drives import drive
from tools.train.config.encoder import AugmentConfig
from tools.train.config.sft import AROUND, ShowConfig
from tools.train.samples.anchors import Anchor, anchors_of, waiting
from tools.train.samples.augment import augmented, decoded, disturbed, encoded, shifted, through_jpeg

STILL = AugmentConfig(brightness=0.0, contrast=0.0, colour=0.0, blur_share=0.0, noise_share=0.0, jpeg_share=0.0)


def picture() -> np.ndarray:
    """Dark on the left and below, bright on the right; a red square in the upper left."""
    shown = np.tile(np.linspace(40, 200, 128), (128, 1))[..., None].repeat(3, axis=2)
    shown[20:50, 20:50] = (220, 30, 30)
    shown[100:] *= 0.5
    return shown.astype(np.uint8)


def test_with_nothing_to_change_it_stays_as_it_is() -> None:
    assert np.array_equal(augmented(picture(), STILL, np.random.default_rng(1)), picture())


def test_the_same_numbers_give_the_same_picture_and_others_another() -> None:
    one, same, other = (augmented(picture(), AugmentConfig(), np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert one.dtype == np.uint8 and one.shape == (128, 128, 3)
    assert np.array_equal(one, same) and not np.array_equal(one, other)


def test_left_stays_left_and_things_stay_where_they_are() -> None:
    for seed in range(40):
        seen = augmented(picture(), AugmentConfig(), np.random.default_rng(seed)).astype(float)
        assert seen[60:90, :40].mean() < seen[60:90, 88:].mean()
        red = seen[..., 0] - seen[..., 1]
        assert red[25:45, 25:45].mean() > 60 and red[60:, 60:].mean() < 30


def test_jpeg_comes_back_as_the_picture_in_the_same_colours() -> None:
    off = np.abs(decoded(encoded(picture(), 95)).astype(int) - picture())
    assert off.mean() < 3
    assert off.mean() < np.abs(through_jpeg(picture(), 10).astype(int) - picture()).mean()


def test_data_that_is_not_jpeg_is_refused() -> None:
    with pytest.raises(ValueError, match="expected a JPEG"):
        decoded(np.zeros(10, np.uint8))


@pytest.fixture(scope="module")
def anchors() -> list[Anchor]:
    return anchors_of(drive(frames=150))


def drawn(anchor: Anchor, config: ShowConfig, count: int = 200) -> list[Anchor]:
    rng = np.random.default_rng(1)
    return [shifted(anchor, config, rng) for _ in range(count)]


def test_the_newest_frame_is_any_of_those_around_and_its_waypoints_are_its_own(anchors: list[Anchor]) -> None:
    recorded, anchor = drive(frames=150), anchors[11]
    found = drawn(anchor, ShowConfig())
    assert {each.k for each in found} == set(range(anchor.k - AROUND, anchor.k + AROUND + 1))
    for each in found:
        assert each.frames[-1] == each.k
        assert np.allclose(each.points, recorded.plan_xy[each.k])
        assert parse_waypoints(format_text(each.reasoning)) == pytest.approx(
            np.round(np.array(each.points), 2), abs=0.06
        )


def test_past_motion_is_in_the_frame_of_the_shown_picture(anchors: list[Anchor]) -> None:
    recorded, anchor = drive(frames=150), anchors[11]
    for each in drawn(anchor, ShowConfig()):
        T_shown_anchor = recorded.T_odom_base(each.k).inverse() @ recorded.T_odom_base(anchor.k)
        moved = [T_shown_anchor @ SE2(x_m, y_m, 0.0) for x_m, y_m in anchor.way]
        assert each.way == tuple(pytest.approx((point.x_m, point.y_m), abs=0.051) for point in moved)


def test_older_frames_are_near_where_they_should_be_and_in_order(anchors: list[Anchor]) -> None:
    for anchor in anchors:
        for each in drawn(anchor, ShowConfig(shift_frames=0), 50):
            assert list(each.frames) == sorted(set(each.frames)) and each.frames[0] >= 0
            assert len(each.frames) == len(anchor.frames)
            assert max(abs(a - b) for a, b in zip(each.frames, anchor.frames, strict=True)) <= 2


def test_at_a_drives_ends_there_is_no_frame_beyond(anchors: list[Anchor]) -> None:
    assert all(0 <= min(each.frames) <= each.k for each in drawn(anchors[0], ShowConfig()))
    short = anchors_of(drive(frames=141))[-1]
    assert short.k == 140 and max(each.k for each in drawn(short, ShowConfig())) == 140


def test_a_robot_that_waits_is_shown_as_it_is(anchors: list[Anchor]) -> None:
    still = waiting(anchors[0], 2)
    assert all(each == still for each in drawn(still, ShowConfig(), 20))


def test_noise_is_in_units_of_the_tokens_and_a_share_is_blank() -> None:
    tokens = (3.0 * np.random.default_rng(2).standard_normal((2000, 8))).astype(np.float16)
    (shown,) = disturbed((tokens,), ShowConfig(noise=0.2, drop=0.25), np.random.default_rng(1))
    blank = ~np.any(shown, axis=1)
    assert blank.mean() == pytest.approx(0.25, abs=0.03)
    off = (shown.astype(np.float64) - tokens)[~blank]
    assert off.std() == pytest.approx(0.6, rel=0.05) and shown.dtype == np.float16
