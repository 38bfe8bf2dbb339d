"""SE(2) poses obey the laws of rigid motions."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.geometry import SE2, interpolate, wrap_angle

lengths = st.floats(-1e3, 1e3)
angles = st.floats(-20.0, 20.0)
poses = st.builds(SE2, lengths, lengths, angles)


def close(a: SE2, b: SE2, tolerance: float = 1e-6) -> bool:
    return (
        math.isclose(a.x_m, b.x_m, abs_tol=tolerance)
        and math.isclose(a.y_m, b.y_m, abs_tol=tolerance)
        and abs(wrap_angle(a.theta_rad - b.theta_rad)) < 1e-9
    )


@given(poses, poses, poses)
def test_composition_is_associative(a: SE2, b: SE2, c: SE2) -> None:
    assert close((a @ b) @ c, a @ (b @ c))


@given(poses)
def test_a_pose_times_its_inverse_is_identity(a: SE2) -> None:
    assert close(a @ a.inverse(), SE2(0, 0, 0))
    assert close(a.inverse() @ a, SE2(0, 0, 0))


def test_forward_is_x_and_left_is_y() -> None:
    T_w_a = SE2(1.0, 2.0, math.pi / 2)
    assert close(T_w_a @ SE2(1.0, 0.0, 0.0), SE2(1.0, 3.0, math.pi / 2))
    assert close(T_w_a @ SE2(0.0, 1.0, 0.0), SE2(0.0, 2.0, math.pi / 2))


@given(angles)
def test_wrapped_angles_lie_in_half_open_turn_and_name_the_same_direction(angle: float) -> None:
    wrapped = wrap_angle(angle)
    assert -math.pi <= wrapped < math.pi
    assert math.isclose(math.cos(wrapped), math.cos(angle), abs_tol=1e-9)
    assert math.isclose(math.sin(wrapped), math.sin(angle), abs_tol=1e-9)


@given(poses, poses)
def test_interpolation_meets_both_ends(a: SE2, b: SE2) -> None:
    assert close(interpolate(a, b, 0.0), a)
    assert close(interpolate(a, b, 1.0), b)


def test_interpolation_takes_the_short_way_round() -> None:
    middle = interpolate(SE2(0, 0, 3.0), SE2(0, 0, -3.0), 0.5)
    assert abs(wrap_angle(middle.theta_rad - math.pi)) < 1e-9


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_pose_that_is_not_finite_is_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="not finite"):
        SE2(0.0, bad, 0.0)
