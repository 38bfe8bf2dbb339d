"""The controller: an arc to the point 1 s ahead, within limits and slew, and zero whenever something is missing."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from edge.core.geometry import SE2
from edge.motion.controller import (
    STEER_M,
    TURN_IN_PLACE_M,
    Controller,
    ControllerConfig,
    ControllerInputs,
    arc_to,
    scale_to_limits,
    target_of,
)
from firmware_bridge.core.config import LimitsConfig

LIMITS = LimitsConfig(
    vx_min_mps=-0.4, vx_max_mps=0.8, vy_max_mps=0.3, wz_max_radps=1.0, accel_mps2=2.0, alpha_radps2=4.0
)
CONFIG = ControllerConfig(LIMITS, step_s=0.1, frame_max_age_ms=500, odometry_max_age_ms=200)
TICK_NS = 100_000_000


def plan(dx: float, dy: float = 0.0, dtheta: float = 0.0) -> np.ndarray:
    return np.cumsum(np.tile(np.float32([dx, dy, dtheta]), (30, 1)), axis=0)


def fresh(trajectory: np.ndarray | None) -> ControllerInputs:
    return ControllerInputs(trajectory, frame_age_ms=50.0, odometry_age_ms=20.0)


def settled(trajectory: np.ndarray) -> tuple[float, float]:
    controller = Controller(CONFIG)
    for tick in range(50):
        command = controller.step(fresh(trajectory), tick * TICK_NS)
    return command.vx_mps, command.wz_radps


def test_a_base_that_cannot_move_sideways_follows_a_sideways_plan_by_turning() -> None:
    limits = replace(LIMITS, vy_max_mps=0.0, vx_min_mps=0.0)
    command = Controller(replace(CONFIG, limits=limits)).step(fresh(plan(0.03, 0.01)), 0)
    assert command.vy_mps == 0.0 and command.target is not None and command.target.y_m > 0
    x, y, theta = 0.0, 0.0, 0.0
    speed, yaw_rate = settled(plan(0.03, 0.01))
    for _ in range(100):
        x, y, theta = x + 0.01 * speed * math.cos(theta), y + 0.01 * speed * math.sin(theta), theta + 0.01 * yaw_rate
    assert (x, y) == (pytest.approx(0.3, abs=0.01), pytest.approx(0.1, abs=0.01))


def test_before_the_first_semantic_state_the_command_is_zero() -> None:
    command = Controller(CONFIG).step(fresh(None), 0)
    assert (command.vx_mps, command.wz_radps, command.reason) == (0.0, 0.0, "no-semantic-state")


def test_a_straight_plan_is_driven_at_its_own_speed() -> None:
    assert settled(plan(0.05)) == (pytest.approx(0.5), pytest.approx(0.0))


@given(st.floats(0.06, 2.0), st.floats(-1.5, 1.5))
def test_the_arc_meets_its_target(distance: float, bearing: float) -> None:
    target = SE2(distance * math.cos(bearing), distance * math.sin(bearing), 2 * bearing)
    speed, yaw_rate = arc_to(target, 1.0)
    if abs(yaw_rate) < 1e-9:
        x, y = speed, 0.0
    else:
        radius = speed / yaw_rate
        x, y = radius * math.sin(yaw_rate), radius * (1 - math.cos(yaw_rate))
    assert x == pytest.approx(target.x_m, abs=1e-5)
    assert y == pytest.approx(target.y_m, abs=1e-5)


def test_a_point_behind_and_a_plan_that_stays_in_place_only_turn() -> None:
    speed, yaw_rate = arc_to(SE2(-1.0, 0.2, 0.0), 1.0)
    assert speed == 0.0 and yaw_rate > 0
    assert arc_to(SE2(0.01, -0.01, 0.3), 1.0) == (0.0, pytest.approx(0.3))


finite = st.floats(-1e6, 1e6, width=32)


@pytest.mark.slow
@settings(max_examples=2 * settings.default.max_examples)
@given(
    st.lists(st.tuples(finite, finite, finite), min_size=30, max_size=30), st.lists(st.integers(0, 10**9), max_size=5)
)
def test_no_plan_can_leave_the_limits(points: list[tuple[float, float, float]], gaps_ns: list[int]) -> None:
    controller = Controller(CONFIG)
    now_ns = 0
    for gap_ns in [0, *gaps_ns]:
        now_ns += gap_ns
        command = controller.step(fresh(np.float32(points)), now_ns)
        assert LIMITS.vx_min_mps <= command.vx_mps <= LIMITS.vx_max_mps
        assert abs(command.wz_radps) <= LIMITS.wz_max_radps
        assert command.vy_mps == 0.0


@pytest.mark.slow
@settings(max_examples=5 * settings.default.max_examples)
@given(st.floats(0.0, 1e6), st.floats(-1e6, 1e6), st.floats(0.01, 3.8), st.floats(0.01, 4.0), st.floats(1e-6, 1.0))
@example(speed=3.2254540894089683, yaw_rate=0.0, vx_max_mps=0.8, wz_max_radps=1.0, speed_scale=1.0)
def test_no_velocity_leaves_a_limit_by_a_single_bit(
    speed: float, yaw_rate: float, vx_max_mps: float, wz_max_radps: float, speed_scale: float
) -> None:
    limits = replace(LIMITS, vx_max_mps=vx_max_mps, wz_max_radps=wz_max_radps)
    vx_mps, wz_radps = scale_to_limits(speed, yaw_rate, limits, speed_scale)
    assert 0.0 <= vx_mps <= vx_max_mps * speed_scale
    assert abs(wz_radps) <= wz_max_radps * speed_scale


def test_speed_rises_no_faster_than_the_slew_limit_and_falls_at_once() -> None:
    controller = Controller(CONFIG)
    speeds = [controller.step(fresh(plan(0.08)), tick * TICK_NS).vx_mps for tick in range(20)]
    assert max(np.diff([0.0, *speeds])) <= LIMITS.accel_mps2 * 0.1 + 1e-9
    assert controller.step(fresh(plan(0.0)), 20 * TICK_NS).vx_mps == 0.0


def test_a_long_pause_does_not_buy_a_jump() -> None:
    controller = Controller(CONFIG)
    controller.step(fresh(plan(0.08)), 0)
    assert controller.step(fresh(plan(0.08)), 3600 * 10**9).vx_mps <= LIMITS.accel_mps2 * 0.2 + 1e-9


POISONED = plan(0.05)
POISONED[29, 2] = math.nan


@pytest.mark.parametrize(
    "output",
    [POISONED, np.where(np.isnan(POISONED), math.inf, POISONED), *map(np.zeros, ((0, 3), (30, 2), (30,), (1, 30, 3)))],
    ids=lambda output: f"{output.shape}",
)
def test_an_output_that_is_not_finite_or_of_another_shape_stops_in_the_same_step(output: np.ndarray) -> None:
    controller = Controller(CONFIG)
    for tick in range(10):
        controller.step(fresh(plan(0.05)), tick * TICK_NS)
    command = controller.step(fresh(output.astype(np.float32)), 10 * TICK_NS)
    assert (command.vx_mps, command.wz_radps, command.reason) == (0.0, 0.0, "bad-output")


def driven(scale: float, trajectory: np.ndarray) -> tuple[float, float]:
    controller = Controller(CONFIG)
    for tick in range(10):
        command = controller.step(replace(fresh(trajectory), speed_scale=scale), tick * TICK_NS)
    return command.vx_mps, command.wz_radps


def test_a_lower_speed_scale_lowers_the_limit_and_leaves_a_slow_plan_as_it_is() -> None:
    assert driven(0.5, plan(0.2))[0] == pytest.approx(0.5 * LIMITS.vx_max_mps)
    assert driven(0.5, plan(0.03))[0] == pytest.approx(0.3)


@given(st.floats(0.01, 1.0), st.floats(0.06, 4.0), st.floats(-1.5, 1.5))
def test_limits_make_the_robot_slower_on_its_arc_not_take_another(
    scale: float, distance: float, bearing: float
) -> None:
    x, y = distance * math.cos(bearing), distance * math.sin(bearing)
    trajectory = np.tile(np.float32([x, y, 0.0]), (30, 1))
    (speed, yaw_rate), (full_speed, full_yaw_rate) = driven(scale, trajectory), driven(1.0, trajectory)
    wanted, wanted_yaw_rate = arc_to(SE2(float(np.float32(x)), float(np.float32(y)), 0.0), 1.0)
    assert speed <= full_speed + 1e-12
    for one, rate in ((speed, yaw_rate), (full_speed, full_yaw_rate)):
        assert rate * wanted == pytest.approx(wanted_yaw_rate * one, abs=1e-6)


@pytest.mark.parametrize("scale", [1.5, 1e9, math.inf, 0.0, -1.0, math.nan, -math.inf])
def test_no_speed_scale_raises_a_limit_and_one_that_is_no_share_gives_no_speed(scale: float) -> None:
    assert driven(scale, plan(0.5))[0] == pytest.approx(LIMITS.vx_max_mps if scale > 1 else 0.0)


def test_a_reason_to_hold_gives_zero_for_any_plan_and_restarts_the_slew_limit() -> None:
    controller = Controller(CONFIG)
    for tick in range(20):
        controller.step(fresh(plan(0.08)), tick * TICK_NS)
    held = controller.step(replace(fresh(plan(0.08)), hold="camera-stopped"), 20 * TICK_NS)
    assert (held.vx_mps, held.reason) == (0.0, "camera-stopped")
    assert controller.step(fresh(plan(0.08)), 21 * TICK_NS).vx_mps <= LIMITS.accel_mps2 * 0.1 + 1e-9


@pytest.mark.parametrize(
    ("frame_age_ms", "odometry_age_ms", "reason"),
    [
        (None, 20.0, "stale-frame"),
        (501.0, 20.0, "stale-frame"),
        (-1.0, 20.0, "stale-frame"),
        (50.0, None, "stale-odometry"),
        (50.0, 201.0, "stale-odometry"),
        (50.0, -1.0, "stale-odometry"),
    ],
)
def test_old_missing_and_future_inputs_stop(
    frame_age_ms: float | None, odometry_age_ms: float | None, reason: str
) -> None:
    command = Controller(CONFIG).step(ControllerInputs(plan(0.05), frame_age_ms, odometry_age_ms), 0)
    assert (command.vx_mps, command.reason) == (0.0, reason)


@pytest.mark.parametrize("field", ["step_s", "frame_max_age_ms", "odometry_max_age_ms"])
def test_a_step_and_ages_must_be_positive(field: str) -> None:
    assert getattr(replace(CONFIG, **{field: 0.5}), field) == 0.5
    for wrong in (0, -1.0):
        with pytest.raises(ValueError, match="must be positive"):
            replace(CONFIG, **{field: wrong})


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(-3, 3), st.floats(0.1, 10))
def test_in_twice_the_time_an_arc_needs_half_the_velocities(x: float, y: float, theta: float, time_s: float) -> None:
    target = SE2(x, y, theta)
    assert arc_to(target, 2 * time_s) == pytest.approx(tuple(each / 2 for each in arc_to(target, time_s)))


def test_a_target_at_the_turning_distance_is_driven_to_and_a_nearer_one_only_turned_to() -> None:
    assert arc_to(SE2(TURN_IN_PLACE_M, 0.0, 0.3), 1.0) == (TURN_IN_PLACE_M, 0.3)
    assert arc_to(SE2(TURN_IN_PLACE_M * 0.999, 0.0, 0.3), 1.0) == (0.0, 0.3)


@given(st.floats(STEER_M, 4.0), st.floats(-math.pi, math.pi), st.floats(-3, 3), st.floats(-3, 3))
def test_far_targets_are_steered_to_whatever_their_heading(d: float, bearing: float, one: float, other: float) -> None:
    xy = d * math.cos(bearing), d * math.sin(bearing)
    assume(math.hypot(*xy) >= STEER_M)
    assert arc_to(SE2(*xy, one), 1.0) == arc_to(SE2(*xy, other), 1.0)


@given(st.floats(-math.pi, math.pi), st.floats(-math.pi, math.pi), st.floats(-3, 3))
def test_the_direction_of_a_robot_that_hardly_moves_hardly_turns_it(one: float, other: float, theta: float) -> None:
    """Else noise of some centimetres commands full turns to alternating sides, and the run stands for oscillation."""
    turns = [arc_to(SE2(0.07 * math.cos(b), 0.07 * math.sin(b), theta), 1.0)[1] for b in (one, other)]
    assert abs(turns[0] - turns[1]) <= 0.1 * 2 * math.pi + 1e-9


@pytest.mark.parametrize("side", [1, -1])
def test_a_target_at_the_side_is_driven_to_in_a_half_circle_and_one_behind_turned_to_by_a_quarter(side: int) -> None:
    assert arc_to(SE2(0.0, side, 0.0), 1.0) == (pytest.approx(math.pi / 2), pytest.approx(side * math.pi))
    assert arc_to(SE2(-1e-6, side, 0.0), 1.0) == (0.0, side * math.pi / 2)


def test_the_target_of_a_short_plan_is_its_last_point_and_of_coarse_steps_the_first() -> None:
    points = np.float32([[0.1, 0.0, 0.0], [0.2, 0.0, 0.0], [0.3, 0.0, 0.0]])
    assert target_of(points, 0.1).x_m == pytest.approx(0.3)
    assert target_of(points, 0.5).x_m == pytest.approx(0.2)
    assert target_of(points, 3.0).x_m == pytest.approx(0.1)
    assert settled(np.float32([[0.3, 0.0, 0.0]])) == (pytest.approx(0.3), 0.0)


@given(st.floats(0.1, 3.0), st.floats(0.1, 4.0), st.floats(0, 10), st.floats(-10, 10), st.floats(0.01, 1.0))
def test_a_scaled_velocity_is_the_fastest_on_its_arc(
    vx_max: float, wz_max: float, speed: float, yaw_rate: float, share: float
) -> None:
    limits = replace(LIMITS, vx_max_mps=vx_max, wz_max_radps=wz_max)
    vx, wz = scale_to_limits(speed, yaw_rate, limits, share)
    assert vx * yaw_rate == pytest.approx(wz * speed, abs=1e-9)
    at_a_limit = vx == pytest.approx(vx_max * share) or abs(wz) == pytest.approx(wz_max * share)
    assert at_a_limit or (vx, wz) == (pytest.approx(speed), pytest.approx(yaw_rate))


@pytest.mark.parametrize("gap_ms", [20, 100, 200])
def test_both_velocities_begin_at_zero_and_rise_by_acceleration_times_the_time_passed(gap_ms: int) -> None:
    controller, turn = Controller(CONFIG), fresh(plan(0.05, 0.04))
    first = controller.step(turn, 0)
    assert (first.vx_mps, first.wz_radps) == (0.0, 0.0)
    second = controller.step(turn, gap_ms * 1_000_000)
    assert (second.vx_mps, second.vy_mps, second.reason) == (pytest.approx(2.0 * gap_ms / 1e3), 0.0, "ok")
    assert second.wz_radps == pytest.approx(4.0 * gap_ms / 1e3)
    assert controller.config is CONFIG


@given(st.floats(0, 500), st.floats(0, 200))
def test_inputs_up_to_their_greatest_age_drive(frame_age_ms: float, odometry_age_ms: float) -> None:
    for ages in ((frame_age_ms, odometry_age_ms), (500.0, 200.0), (0.0, 0.0)):
        command = Controller(CONFIG).step(ControllerInputs(plan(0.05), *ages), 0)
        assert command.reason == "ok"


def test_zero_is_zero_in_every_direction() -> None:
    command = Controller(CONFIG).halt("held")
    assert (command.vx_mps, command.vy_mps, command.wz_radps, command.target) == (0.0, 0.0, 0.0, None)
