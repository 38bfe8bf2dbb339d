"""Leg kinematics and the trot as pure functions."""

from __future__ import annotations

from math import isclose

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_hil.robots.go2.gait import BodyMotion, GaitConfig, limit_command, start_gait, step_gait
from sim_hil.robots.go2.kinematics import foot_position, foot_velocity, jacobian, joint_angles, joint_torque
from sim_hil.robots.go2.urdf import LEG_GEOMETRY, TOTAL_MASS_KG

LEGS = st.integers(0, 3)
# Angles well inside every leg's limits, with the foot below the hip: where a walking leg lives.
ANGLES = st.tuples(st.floats(-0.7, 0.7), st.floats(-0.2, 1.3), st.floats(-2.6, -0.9))
CONFIG = GaitConfig()
LEVEL = BodyMotion(0, 0, 0, 0, 0, 0, 0, 0)


def _body(vx: float, vy: float) -> BodyMotion:
    return LEVEL._replace(vx_mps=vx, vy_mps=vy)


@given(LEGS, ANGLES)
def test_inverse_kinematics_undoes_forward_kinematics(leg: int, q: tuple[float, float, float]) -> None:
    foot = foot_position(leg, q)
    again = foot_position(leg, joint_angles(leg, foot))
    assert again == pytest.approx(foot, abs=1e-6)


@given(LEGS, ANGLES, st.integers(0, 2))
def test_jacobian_is_the_derivative_of_forward_kinematics(leg: int, q: tuple[float, float, float], joint: int) -> None:
    step = 1e-6
    moved = tuple(angle + (step if index == joint else 0.0) for index, angle in enumerate(q))
    before, after = foot_position(leg, q), foot_position(leg, moved)  # type: ignore[arg-type]
    slope = [(b - a) / step for a, b in zip(before, after, strict=True)]
    assert slope == pytest.approx([row[joint] for row in jacobian(leg, q)], abs=1e-4)


@given(LEGS, ANGLES, st.tuples(*[st.floats(-5, 5)] * 3), st.tuples(*[st.floats(-100, 100)] * 3))
def test_joint_power_equals_foot_power(leg: int, q, dq, force) -> None:  # type: ignore[no-untyped-def]
    joints = sum(t * w for t, w in zip(joint_torque(leg, q, force), dq, strict=True))
    foot = sum(f * v for f, v in zip(force, foot_velocity(leg, q, dq), strict=True))
    assert isclose(joints, foot, abs_tol=1e-6)


@given(LEGS, st.tuples(*[st.floats(-1, 1)] * 3))
def test_any_foot_target_gives_angles_within_the_calf_limits(leg: int, foot: tuple[float, float, float]) -> None:
    lower, upper = LEG_GEOMETRY[leg].limits_rad[2]
    assert lower - 1e-9 <= joint_angles(leg, foot)[2] <= upper + 1e-9


def test_without_a_command_a_still_robot_keeps_all_feet_down_and_carries_its_weight() -> None:
    state = start_gait(CONFIG, 0.0)
    state, output = step_gait(CONFIG, state, (0.0, 0.0, 0.0), LEVEL, 0.002)
    assert not state.walking
    assert output.feet == CONFIG.home
    assert -sum(push[2] for push in output.push) == pytest.approx(TOTAL_MASS_KG * 9.81)


def test_trotting_swings_diagonal_legs_together() -> None:
    state = start_gait(CONFIG, 0.0)
    lifted = set()
    for _ in range(500):
        state, output = step_gait(CONFIG, state, (0.4, 0.0, 0.0), _body(0.4, 0.0), 0.002)
        lifted.add(tuple(push[2] == 0.0 for push in output.push))
    assert lifted == {(False,) * 4, (True, False, False, True), (False, True, True, False)}


def test_foot_targets_never_jump() -> None:
    state = start_gait(CONFIG, 0.0)
    previous = state.feet
    for index in range(1500):
        command = (0.8, 0.2, 0.8) if index < 700 else (0.0, 0.0, 0.0)
        speed = min(index, max(1400 - index, 0), 250) * 0.0032  # a body cannot change its speed at once either
        state, output = step_gait(CONFIG, state, command, _body(speed, 0.0), 0.002)
        moved = np.abs(np.subtract(output.feet, previous)).max()
        assert moved < 0.012  # 6 m/s at the very most
        previous = output.feet


def test_gait_comes_to_rest_after_a_zero_command() -> None:
    state = start_gait(CONFIG, 0.0)
    for _ in range(300):
        state, _ = step_gait(CONFIG, state, (0.5, 0.0, 0.0), _body(0.5, 0.0), 0.002)
    for _ in range(1500):
        state, _ = step_gait(CONFIG, state, (0.0, 0.0, 0.0), LEVEL, 0.002)
    assert not state.walking


@given(st.tuples(*[st.floats(-10, 10)] * 3))
def test_commands_are_clipped_to_what_the_gait_can_do(command: tuple[float, float, float]) -> None:
    vx, vy, wz = limit_command(CONFIG, command)
    assert CONFIG.vx_limits_mps[0] <= vx <= CONFIG.vx_limits_mps[1]
    assert abs(vy) <= CONFIG.vy_limit_mps and abs(wz) <= CONFIG.wz_limit_radps
    assert abs(vx * wz) <= CONFIG.turn_mps2 + 1e-9


@pytest.mark.parametrize("command", [(1.5, 0.3, -1.0), (1.0, -0.5, 1.2), (-0.8, 0.5, 1.2)])
def test_the_corners_of_the_envelope_pass_unclipped(command: tuple[float, float, float]) -> None:
    assert limit_command(CONFIG, command) == pytest.approx(command)
