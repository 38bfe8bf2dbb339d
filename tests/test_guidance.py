"""Waypoints stay where they are in the world while the robot moves."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.geometry import SE2
from edge.guidance import waypoints_now

METRES = st.floats(-50, 50)
POSES = st.builds(SE2, METRES, METRES, st.floats(-3, 3))


def world(T_odom_base: SE2, point: tuple[float, float]) -> tuple[float, float]:
    placed = T_odom_base @ SE2(*point, 0.0)
    return placed.x_m, placed.y_m


@given(anchor=POSES, now=POSES, point=st.tuples(METRES, METRES))
def test_a_waypoint_is_the_same_place_seen_from_anywhere(anchor: SE2, now: SE2, point: tuple[float, float]) -> None:
    seen = waypoints_now((point,), anchor.inverse() @ now)
    assert world(now, tuple(seen[0, 0].astype(float))) == pytest.approx(world(anchor, point), abs=1e-3)


def test_a_robot_that_has_not_moved_sees_them_as_they_were_written() -> None:
    written = ((1.0, 0.0), (2.0, 0.5), (3.0, -1.25))
    assert np.array_equal(waypoints_now(written, SE2(0.0, 0.0, 0.0)), np.array([written], dtype=np.float32))
