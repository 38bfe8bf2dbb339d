"""Episodes of 20 s, one every 3 s, in the robot's frame; the past knows nothing of the future."""

from __future__ import annotations

from dataclasses import replace
from math import cos, pi, sin

import numpy as np
import pytest

from edge.core.geometry import SE2
from tests.support.train.training_drives import SPEED_MPS, TURN_RADPS, arc, drive
from tools.train.drives.drive import Drive
from tools.train.drives.windows import relative, windows


def _straight(frames: int) -> Drive:
    """At 1 m/s into a direction of its own."""
    along = np.arange(frames) / 10
    pose = np.stack((3 + along * cos(2.0), 4 + along * sin(2.0), np.full(frames, 2.0)), axis=1)
    return drive(frames=frames, pose=pose)


def test_a_sample_comes_every_three_seconds_while_there_is_a_future() -> None:
    assert [window.k for window in windows(drive(frames=121))] == [0, 30, 60, 90]
    assert [window.k for window in windows(drive(frames=122))] == [0, 30, 60, 90, 120]


def test_the_future_is_twenty_seconds_or_what_there_is() -> None:
    found = list(windows(drive(frames=231)))
    assert [len(window.future) for window in found] == [200, 200, 170, 140, 110, 80, 50, 20]
    assert found[1].future_k[0] == 31 and found[1].future_k[-1] == 230


def test_the_step_of_number_i_is_where_it_is_i_tenths_later() -> None:
    window = list(windows(_straight(100)))[1]
    steps = np.arange(1, 70)
    assert np.array_equal(window.future_k, 30 + steps)
    assert np.allclose(window.future, np.stack((steps / 10, 0 * steps, 0 * steps), axis=1), atol=1e-9)


def test_the_future_of_an_arc_turns_with_it() -> None:
    window = list(windows(drive(frames=90)))[1]
    seconds = 2.0
    turned = TURN_RADPS * seconds
    radius = SPEED_MPS / TURN_RADPS
    expected = (radius * sin(turned), radius * (1 - cos(turned)), turned)
    assert np.allclose(window.future[19], expected, atol=1e-9)


def test_the_past_is_by_odometry_a_second_apart_oldest_first() -> None:
    made = _straight(130)
    window = list(windows(made))[4]
    assert window.k == 120 and list(window.past_k) == [30, 40, 50, 60, 70, 80, 90, 100, 110]
    # Odometry of these drives is 1 % long, and the robot looks along its way.
    assert np.allclose(window.past[:, 0], -1.01 * np.arange(9, 0, -1), atol=1e-9)
    assert np.allclose(window.past[:, 1:], 0, atol=1e-9)


def test_at_the_start_there_is_no_past() -> None:
    first, second = list(windows(drive(frames=60)))
    assert first.past.shape == (0, 3) and list(second.past_k) == [0, 10, 20]


def test_what_comes_after_changes_nothing_in_the_past_or_the_state() -> None:
    made = drive(frames=200)
    k = 60
    after = np.arange(200) > k
    changed = replace(
        made,
        pose=np.where(after[:, None], arc(200, (9.0, 9.0, 3.0)), made.pose),
        pose_odom=np.where(after[:, None], 7.0, made.pose_odom),
        state=np.where(after[:, None], np.float32(3), made.state),
    )
    one, other = (next(w for w in windows(each) if w.k == k) for each in (made, changed))
    assert np.array_equal(one.past, other.past) and np.array_equal(one.state, other.state)
    assert not np.allclose(one.future, other.future)


def test_the_truth_changes_nothing_in_what_the_robot_knows() -> None:
    made = drive(frames=100)
    moved = replace(made, pose=made.pose + np.array((5.0, -3.0, 1.0)))
    for one, other in zip(windows(made), windows(moved), strict=True):
        assert np.array_equal(one.past, other.past) and np.array_equal(one.state, other.state)


def test_odometry_changes_nothing_in_what_is_to_be_learned() -> None:
    made = drive(frames=100)
    moved = replace(made, pose_odom=made.pose_odom * 3)
    for one, other in zip(windows(made), windows(moved), strict=True):
        assert np.array_equal(one.future, other.future)


def test_a_stride_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="stride"):
        next(windows(drive(), 0.01))


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (2.0, -1.0, 3.1), (-4.0, 5.0, -2.0)])
def test_relative_is_what_se2_says(origin: tuple[float, float, float]) -> None:
    poses = np.array([(1.0, 2.0, 0.3), (-3.0, 0.5, -3.0), (0.0, 0.0, pi - 0.01)])
    expected = [(SE2(*origin).inverse() @ SE2(*(float(v) for v in pose))).as_tuple() for pose in poses]
    assert np.allclose(relative(np.array(origin), poses), expected, atol=1e-12)
