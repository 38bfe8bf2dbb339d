"""The drifting odometry of the simulated robot."""

from __future__ import annotations

import math

import numpy as np
import pytest

from edge.core.geometry import SE2
from sim_hil.robots.odometry_noise import LEVELS, NoiseLevel, OdometryNoise


def drive(noise: OdometryNoise, metres: float, step_m: float, dt_s: float = 0.02) -> SE2:
    for _ in range(round(metres / step_m)):
        noise.step(SE2(step_m, 0.0, 0.0), dt_s)
    return noise.pose


def test_without_noise_the_report_is_the_truth() -> None:
    noise = OdometryNoise(LEVELS["none"], seed=1, start=SE2(1.0, 2.0, math.pi / 2))
    noise.step(SE2(1.0, 0.0, 0.0), 1.0)
    report = noise.step(SE2(0.5, 0.0, 0.1), 1.0)
    assert report.T_odom_base.as_tuple() == pytest.approx((1.0, 3.5, math.pi / 2 + 0.1))
    assert (report.vx_mps, report.vy_mps, report.wz_radps) == pytest.approx((0.5, 0.0, 0.1))


def test_the_same_seed_drifts_alike_and_another_does_not() -> None:
    poses = [drive(OdometryNoise(LEVELS["severe"], seed), 3.0, 0.05) for seed in (7, 7, 8)]
    assert poses[0] == poses[1] != poses[2]


def test_a_robot_that_turns_on_the_spot_does_not_drift() -> None:
    noise = OdometryNoise(LEVELS["severe"], seed=0)
    for _ in range(10):
        noise.step(SE2(0.0, 0.0, 0.1), 0.1)
    assert noise.pose.as_tuple() == pytest.approx((0.0, 0.0, 1.0))


def test_the_velocity_is_that_of_the_reported_pose() -> None:
    noise = OdometryNoise(LEVELS["severe"], seed=2)
    before = noise.pose
    report = noise.step(SE2(0.05, 0.0, 0.01), 0.1)
    moved = before.inverse() @ report.T_odom_base
    assert (report.vx_mps, report.vy_mps, report.wz_radps) == pytest.approx(tuple(v / 0.1 for v in moved.as_tuple()))


@pytest.mark.slow
@pytest.mark.parametrize("step_m", [0.01, 0.1])
def test_the_drift_of_a_metre_has_the_levels_size_for_any_step(step_m: float) -> None:
    level = LEVELS["typical"]
    # Of an Ornstein-Uhlenbeck rate integrated over s: 2 L s - 2 L^2 (1 - exp(-s / L)), L its correlation length.
    expected = math.sqrt(2.0 - 2.0 * (1.0 - math.exp(-1.0)))
    ends = [drive(OdometryNoise(level, seed), 1.0, step_m) for seed in range(300)]
    turned = np.std([end.theta_rad for end in ends])
    along = np.std([end.x_m - 1.0 for end in ends])
    assert turned / level.rotation_rad_per_m == pytest.approx(expected, rel=0.15)
    assert along / level.translation_m_per_m == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize("values", [(-0.1, 0.0, 1.0), (0.0, math.nan, 1.0), (0.0, 0.0, 0.0)])
def test_a_level_that_means_nothing_is_refused(values: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="odometry noise"):
        NoiseLevel(*values)


def test_a_step_that_takes_no_time_is_refused() -> None:
    with pytest.raises(ValueError, match="more than 0 s"):
        OdometryNoise(LEVELS["none"], seed=0).step(SE2(0.0, 0.0, 0.0), 0.0)
