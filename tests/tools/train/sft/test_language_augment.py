"""What a language model is shown of an anchor: frames that the drive has, words that still hold, tokens with noise."""

from __future__ import annotations

import numpy as np
import pytest

from edge.core.geometry import SE2
from edge.state.reasoning_text import format_text, parse_waypoints
from tests.support.train.training_drives import drive
from tools.train.config.sft import AROUND, ShowConfig
from tools.train.samples.anchors import Anchor, anchors_of, waiting
from tools.train.samples.augment import disturbed, shifted


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


def test_the_way_is_told_in_the_frame_that_is_shown(anchors: list[Anchor]) -> None:
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
