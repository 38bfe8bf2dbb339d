"""The pose history answers for any instant, from any thread, without waiting."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.geometry import SE2
from edge.state.pose_history import PoseHistory, StampedPose


def pose(stamp_ns: int, x_m: float) -> StampedPose:
    return StampedPose(stamp_ns, SE2(x_m, 0.0, 0.0), 0.0, 0.0, 0.0)


def test_an_empty_history_has_no_pose() -> None:
    history = PoseHistory()
    assert history.newest() is None
    assert history.at(0) is None


def test_between_two_reports_the_pose_is_interpolated() -> None:
    history = PoseHistory()
    history.put(pose(100, 1.0))
    history.put(pose(200, 2.0))
    found = history.at(125)
    assert found is not None
    assert found.x_m == pytest.approx(1.25)


def test_outside_the_history_the_nearest_end_answers() -> None:
    history = PoseHistory()
    history.put(pose(100, 1.0))
    history.put(pose(200, 2.0))
    assert history.at(0) == SE2(1.0, 0.0, 0.0)
    assert history.at(900) == SE2(2.0, 0.0, 0.0)


def test_a_report_that_does_not_advance_in_time_is_ignored() -> None:
    history = PoseHistory()
    history.put(pose(100, 1.0))
    history.put(pose(100, 9.0))
    history.put(pose(50, 9.0))
    assert history.newest() == pose(100, 1.0)


@given(st.integers(2, 200), st.integers(2, 16), st.floats(0, 1))
def test_after_wrapping_round_the_newest_reports_remain_exact(count: int, capacity: int, where: float) -> None:
    history = PoseHistory(capacity)
    for i in range(count):
        history.put(pose(10 * i, float(i)))
    oldest = max(0, count - capacity)
    stamp = 10 * oldest + where * 10 * (count - 1 - oldest)
    found = history.at(round(stamp))
    assert found is not None
    assert found.x_m == pytest.approx(round(stamp) / 10)
