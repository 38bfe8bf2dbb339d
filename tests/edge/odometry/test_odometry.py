"""The drift estimator: what each sensor is good for, what must not enter, and how sure the result may be."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.geometry import SE2, wrap_angle
from edge.odometry.calibration import OdometryCalibration
from edge.odometry.drift_rate import MOST_COMPARISONS, Comparison, DriftMonitor
from edge.odometry.estimator import DriftEstimator
from edge.odometry.gate import OdometryInputs
from edge.odometry.visual_odometry import VisualMotion
from edge.state.pose_history import PoseHistory
from tests.support.runner.odometry_drives import STATE_NS, drive, play, visual_motions

SECOND_NS = 1_000_000_000


def offset_error(path, estimator: DriftEstimator, index: int, back: int) -> np.ndarray:  # type: ignore[no-untyped-def]
    found = estimator.motion_offset(path.stamp_ns(index - back))
    assert found is not None
    true = path.true[index - back].inverse() @ path.true[index]
    fused = found[0]
    return np.array((fused.x_m - true.x_m, fused.y_m - true.y_m, wrap_angle(fused.theta_rad - true.theta_rad)))


def run(path, estimator: DriftEstimator, motions=None):  # type: ignore[no-untyped-def]
    return [outputs for _, outputs in play(path, estimator, motions)][-1]


def test_a_perfect_robot_is_believed_to_the_millimetre() -> None:
    path, estimator = drive(10, gyro_sigma_radps=0.0), DriftEstimator()
    run(path, estimator)
    assert offset_error(path, estimator, len(path.true) - 1, 250) == pytest.approx((0, 0, 0), abs=2e-3)


def test_the_gyro_overrules_odometry_that_turns_by_itself() -> None:
    path, estimator = drive(12, yaw_drift_rad_per_m=math.radians(5)), DriftEstimator()
    run(path, estimator)
    error = offset_error(path, estimator, len(path.true) - 1, 250)
    assert abs(error[2]) < math.radians(0.5)  # 2.5 m at 5 degrees a metre would be 12.5


def test_the_gyros_bias_is_learned_while_the_robot_stands() -> None:
    path, estimator = drive(8, gyro_bias_radps=math.radians(0.6)), DriftEstimator()
    run(path, estimator)
    assert math.degrees(estimator.gyro_bias_radps) == pytest.approx(0.6, abs=0.05)


def test_a_robot_that_stands_does_not_turn_with_its_gyros_bias() -> None:
    path, estimator = drive(20, vx_mps=0.0, wz_radps=0.0, gyro_bias_radps=math.radians(0.4)), DriftEstimator()
    outputs = run(path, estimator)
    assert outputs.standing
    assert offset_error(path, estimator, len(path.true) - 1, 700) == pytest.approx((0, 0, 0), abs=2e-3)


def test_a_foot_in_the_air_is_not_standing() -> None:
    path = drive(4, vx_mps=0.0, wz_radps=0.0)
    lifted = replace(path, reports=tuple(replace(r, foot_forces=(0.0, 80.0, 80.0, 0.0)) for r in path.reports))
    assert not run(lifted, DriftEstimator()).standing


def test_the_camera_corrects_a_wrong_scale() -> None:
    path = drive(20, scale=1.05)
    alone, seeing = DriftEstimator(), DriftEstimator()
    run(path, alone)
    run(path, seeing, visual_motions(path))
    last = len(path.true) - 1
    errors = [math.hypot(*offset_error(path, estimator, last, 250)[:2]) for estimator in (alone, seeing)]
    assert errors[0] > 0.1
    assert errors[1] < 0.3 * errors[0]


@pytest.mark.slow
def test_minutes_of_a_noisy_camera_leave_the_scale_as_it_is() -> None:
    """The camera's noise once raised both scales for ever: in 90 minutes of a soak the fused path shrank by 39 %."""
    path, estimator = drive(300, vx_mps=0.1), DriftEstimator()
    pose = run(path, estimator, visual_motions(path)).pose
    assert pose is not None and pose.vx_mps == pytest.approx(0.1, rel=0.02)


def test_a_camera_that_is_late_corrects_the_past_and_not_the_present() -> None:
    """The interval it saw is replaced; what came after is played again on top of it."""
    path = drive(20, scale=1.05)
    estimator = DriftEstimator()
    for _ in play(path, estimator, visual_motions(path), delay_ns=700_000_000):
        pass
    error = offset_error(path, estimator, len(path.true) - 1, 250)
    assert math.hypot(*error[:2]) < 0.04


def test_a_camera_that_sees_nonsense_is_not_believed() -> None:
    path, estimator = drive(10), DriftEstimator()
    motions = [replace(m, T_start_end=SE2(2.0, -1.0, 1.0)) for m in visual_motions(path)]
    run(path, estimator, motions)
    assert estimator.visual_used == 0
    assert estimator.visual_rejected > 0
    assert math.hypot(*offset_error(path, estimator, len(path.true) - 1, 250)[:2]) < 0.03


@pytest.mark.slow
def test_without_a_gyro_the_camera_holds_the_heading() -> None:
    path = drive(20, yaw_drift_rad_per_m=math.radians(5))
    path = replace(path, reports=tuple(replace(r, gyro_wz_radps=None) for r in path.reports))
    alone, seeing = DriftEstimator(), DriftEstimator()
    run(path, alone)
    run(path, seeing, visual_motions(path))
    last = len(path.true) - 1
    assert abs(offset_error(path, seeing, last, 250)[2]) < 0.3 * abs(offset_error(path, alone, last, 250)[2])


def turned_rad(estimator: DriftEstimator, report: OdometryInputs) -> float:
    outputs = estimator.step(report, report.received_ns)
    assert outputs.pose is not None
    return outputs.pose.T_odom_base.theta_rad


def at_rest(index: int, **fields: object) -> OdometryInputs:
    """The report number `index`, 20 a second, of a robot without a command."""
    stamp_ns = (index + 1) * SECOND_NS // 20
    still = OdometryInputs(stamp_ns, (0.0, 0.0, 0.0), 0.0, 0.0, 0.0, robot_stamp_ns=stamp_ns, commanded=(0.0, 0.0, 0.0))
    return replace(still, **fields)


def test_without_a_gyro_the_camera_corrects_a_turn_on_the_spot() -> None:
    """Wheels that report a tenth too much, over 286 degrees."""
    path, estimator = drive(12, vx_mps=0.0, wz_radps=0.5), DriftEstimator()
    path = replace(
        path,
        reports=tuple(
            replace(r, gyro_wz_radps=None, wz_radps=1.1 * r.wz_radps, T_odom_base=(0.0, 0.0, 1.1 * (pose.theta_rad)))
            for r, pose in zip(path.reports, path.true, strict=True)
        ),
    )
    run(path, estimator, visual_motions(path))
    assert estimator.visual_used > 15
    last = len(path.true) - 1
    assert abs(math.degrees(offset_error(path, estimator, last, 250)[2])) < 6.0  # 14 without a camera


def test_a_robot_that_is_turned_by_hand_turns_and_teaches_the_gyro_nothing() -> None:
    estimator, rate, theta = DriftEstimator(), math.radians(3.0), 0.0
    for index in range(600):
        turns = 100 <= index < 500
        heading = theta + rate / 20 * max(0, min(index, 500) - 100)
        rates = {"wz_radps": rate * turns, "gyro_wz_radps": rate * turns}
        found = turned_rad(estimator, at_rest(index, T_odom_base=(0.0, 0.0, heading), **rates))
    assert math.degrees(found) == pytest.approx(60.0, abs=1.5)
    assert abs(math.degrees(estimator.gyro_bias_radps)) < 0.1


def test_after_a_long_rest_a_bias_that_changes_is_learned_within_half_a_minute() -> None:
    estimator = DriftEstimator()
    for index in range(12_600):
        bias = math.radians(0.2 if index < 12_000 else 0.6)
        turned_rad(estimator, at_rest(index, gyro_wz_radps=bias))
    assert math.degrees(estimator.gyro_bias_radps) == pytest.approx(0.6, abs=0.1)


def test_the_calibration_takes_a_known_scale_out_without_a_camera() -> None:
    path = drive(10, scale=1.05)
    estimator = DriftEstimator(OdometryCalibration(scale_x=1.05, scale_x_sigma=0.002))
    run(path, estimator)
    assert math.hypot(*offset_error(path, estimator, len(path.true) - 1, 250)[:2]) < 0.01


def test_a_jump_does_not_move_the_fused_pose() -> None:
    path, estimator = drive(10), DriftEstimator()
    reports = list(path.reports)
    for index in range(300, len(reports)):
        x, y, theta = reports[index].T_odom_base
        reports[index] = replace(reports[index], T_odom_base=(x + 1.0, y, theta))
    outputs = [estimator.step(report, report.received_ns) for report in reports]
    assert outputs[300].pose is None
    assert [f.name for f in outputs[300].findings] == ["odometry-jump"]
    assert math.hypot(*offset_error(path, estimator, len(path.true) - 1, 300)[:2]) < 0.03


def test_a_report_that_is_not_finite_is_rejected_and_named() -> None:
    path, estimator = drive(3), DriftEstimator()
    run(path, estimator)
    bad = replace(path.reports[-1], received_ns=path.stamp_ns(-1) + STATE_NS, T_odom_base=(math.nan, 0.0, 0.0))
    outputs = estimator.step(bad, bad.received_ns)
    assert outputs.pose is None
    assert [f.name for f in outputs.findings] == ["odometry-not-finite"]
    assert estimator.rejected == 1


def test_thirty_seconds_are_remembered_and_not_much_more() -> None:
    path, estimator = drive(40), DriftEstimator()
    run(path, estimator)
    now_ns = path.stamp_ns(-1)
    assert estimator.motion_offset(now_ns - 30 * SECOND_NS) is not None
    assert estimator.motion_offset(now_ns - 31 * SECOND_NS) is None


def test_the_pose_history_equals_the_estimator() -> None:
    path, estimator, history = drive(10, scale=1.02), DriftEstimator(), PoseHistory()
    for _, outputs in play(path, estimator, visual_motions(path)):
        if outputs.pose is not None:
            history.put(outputs.pose)
    anchor_ns, newest = path.stamp_ns(250), history.newest()
    anchor, found = history.at(anchor_ns), estimator.motion_offset(anchor_ns)
    assert anchor is not None and newest is not None and found is not None
    assert (anchor.inverse() @ newest.T_odom_base).as_tuple() == pytest.approx(found[0].as_tuple(), abs=0.02)


def test_uncertainty_grows_with_the_way_and_vanishes_at_the_anchor() -> None:
    path, estimator = drive(20), DriftEstimator()
    run(path, estimator)
    now_ns = path.stamp_ns(-1)
    traces = []
    for seconds in (0, 2, 5, 15):
        found = estimator.motion_offset(now_ns - seconds * SECOND_NS)
        assert found is not None
        assert np.all(np.linalg.eigvalsh(found[1]) > 0)
        traces.append(float(np.trace(found[1])))
    assert traces == sorted(traces)
    assert traces[0] < 1e-5


@pytest.mark.slow
def test_the_error_matches_the_reported_uncertainty() -> None:
    """Mean of the normalised squared error of 20 drives, 3 degrees of freedom each: about chi-square's 99.9 % band."""
    rng = np.random.default_rng(1)
    errors = []
    for seed in range(20):
        scale, drift = 1 + rng.normal(0, 0.03), rng.normal(0, math.radians(2))
        bias = rng.normal(0, math.radians(0.2))
        path = drive(9, scale=scale, yaw_drift_rad_per_m=drift, gyro_bias_radps=bias, seed=seed, wz_radps=0.2,
                     gyro_sigma_radps=math.radians(0.08) / math.sqrt(0.02))  # fmt: skip
        estimator = DriftEstimator()
        motions = visual_motions(path, seed=seed, scale=1 + rng.normal(0, 0.008))
        run(path, estimator, motions)
        last = len(path.true) - 1
        found = estimator.motion_offset(path.stamp_ns(last - 250))
        assert found is not None
        error = offset_error(path, estimator, last, 250)
        errors.append(float(error @ np.linalg.solve(found[1], error)))
    assert 1.5 < np.mean(errors) < 5.1


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "drift_deg"), [(1.02, 1.0), (0.95, 5.0)])
def test_the_drift_rate_is_that_of_the_robots_own_odometry(scale: float, drift_deg: float) -> None:
    path = drive(44, scale=scale, yaw_drift_rad_per_m=math.radians(drift_deg), wz_radps=0.05)
    rate = run(path, DriftEstimator(), visual_motions(path)).drift
    # All of the error is forward: per axis it is 1/sqrt(2) of it.
    assert rate.m_per_m == pytest.approx(abs(scale - 1) / math.sqrt(2), rel=0.25)
    assert math.degrees(rate.rad_per_m) == pytest.approx(drift_deg, rel=0.25)
    assert rate.distance_m == pytest.approx(20.0, abs=1.0)


def test_without_a_camera_nothing_is_claimed_about_the_drift() -> None:
    rate = run(drive(20), DriftEstimator()).drift
    assert rate.m_per_m is None and rate.rad_per_m is None


@pytest.mark.parametrize("distance_m", [0.0, 1e-4, 0.25], ids=["turns on the spot", "creeps", "drives"])
def test_hours_of_comparisons_take_bounded_memory(distance_m: float) -> None:
    monitor = DriftMonitor()
    for _ in range(3 * MOST_COMPARISONS):
        monitor.add(Comparison(distance_m, 0.001, 0.0, 0.01, 1e-8, 1e-8))
        assert len(monitor) <= 2 * MOST_COMPARISONS
    rate = monitor.rate()
    assert rate.rad_per_m is None or np.isfinite(rate.rad_per_m)


def test_camera_motions_that_come_twice_or_out_of_order_are_used_once() -> None:
    path, estimator = drive(6), DriftEstimator()
    motions: list[VisualMotion] = [m for motion in visual_motions(path) for m in (motion, motion)]
    run(path, estimator, motions)
    # Of the first second the robot stood: those tell nothing.
    assert estimator.visual_used <= len(motions) // 2
    assert estimator.visual_used > 0


numbers = st.floats(allow_nan=True, allow_infinity=True)
reports = st.builds(
    OdometryInputs,
    received_ns=st.integers(0, 2**62),
    T_odom_base=st.tuples(numbers, numbers, numbers),
    vx_mps=numbers,
    vy_mps=numbers,
    wz_radps=numbers,
    gyro_wz_radps=st.none() | numbers,
    robot_stamp_ns=st.integers(0, 2**62),
    foot_forces=st.none() | st.tuples(*[st.floats(-1e4, 1e4)] * 4),
    commanded=st.none() | st.tuples(*[st.floats(-2, 2)] * 3),
)


@pytest.mark.slow
@given(st.lists(reports, max_size=12))
def test_any_robot_report_leaves_the_pose_finite_and_raises_nothing(garbage: list[OdometryInputs]) -> None:
    path, estimator = drive(0.2), DriftEstimator()
    for report in [*path.reports, *garbage]:
        outputs = estimator.step(report, report.received_ns)
        assert outputs.pose is None or all(map(math.isfinite, outputs.pose.T_odom_base.as_tuple()))
        estimator.motion_offset(report.received_ns - SECOND_NS)
