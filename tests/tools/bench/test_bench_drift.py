"""The drift benchmark: its arithmetic, on made-up walks that need no simulator."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from edge.core.geometry import SE2
from edge.odometry.visual_odometry import VisualMotion
from tools.bench import drift
from tools.bench.sim.drift_runs import STATE_NS, Sample, Walk

VISUAL_SIGMA = (0.003, 0.003, math.radians(0.1))


def walk(seed: int, metres: float = 22.0) -> Walk:
    """A weaving walk at 0.6 m/s, and a camera with the noise that it admits to."""
    rng = np.random.default_rng(seed)
    pose, samples, motions = SE2(0.0, 0.0, 0.0), [], []
    bias = rng.normal(0, math.radians(0.2))
    count = round((metres / 0.6 + drift.STAND_S) * 1e9 / STATE_NS)
    for index in range(count):
        time_s = index * STATE_NS / 1e9
        moving = time_s >= drift.STAND_S
        vx, wz = (0.6, 0.4 * math.sin(0.5 * time_s)) if moving else (0.0, 0.0)
        pose = pose @ SE2(vx * STATE_NS / 1e9, 0.0, wz * STATE_NS / 1e9)
        gyro = wz + bias + rng.normal(0, math.radians(0.3))
        samples.append(Sample((index + 1) * STATE_NS, pose, gyro, 0.0, 0.0, (40.0,) * 4, (vx, 0.0, wz), 0.31))
    sx, sy, st = VISUAL_SIGMA
    covariance = (sx * sx, 0.0, 0.0, 0.0, sy * sy, 0.0, 0.0, 0.0, st * st)
    for start in range(0, count - 20, 20):
        before, after = samples[start], samples[start + 20]
        moved = before.T_world_base.inverse() @ after.T_world_base
        ex, ey, et = rng.normal(0, VISUAL_SIGMA)
        seen = SE2(moved.x_m + ex, moved.y_m + ey, moved.theta_rad + et)
        motions.append(VisualMotion(before.stamp_ns, after.stamp_ns, seen, covariance, 60))
    return Walk(seed, tuple(samples), tuple(motions), len(motions), (1.0,), metres, 0)


@pytest.fixture(scope="module")
def runs() -> dict[str, list[drift.DriftRun]]:
    walks = [walk(seed) for seed in range(2)]
    return {level: [drift.replay(w, level, 10 + w.seed) for w in walks] for level in drift.TESTED}


@pytest.mark.slow
@pytest.mark.parametrize("level", drift.TESTED)
def test_the_fused_offset_errs_at_most_half_as_much_as_the_robots_own(
    runs: dict[str, list[drift.DriftRun]], level: str
) -> None:
    summary = drift.summarise(runs[level])
    assert summary["ratio_m"] <= drift.MAX_RATIO
    assert summary["ratio_rad"] <= drift.MAX_RATIO


@pytest.mark.parametrize("level", drift.TESTED)
def test_the_drift_rate_after_20_metres_is_right_within_a_quarter(
    runs: dict[str, list[drift.DriftRun]], level: str
) -> None:
    for run in runs[level]:
        assert run.estimated_m_per_m == pytest.approx(run.true_m_per_m, rel=drift.MAX_RATE_ERROR)
        assert run.estimated_rad_per_m == pytest.approx(run.true_rad_per_m, rel=drift.MAX_RATE_ERROR)


def test_good_odometry_raises_no_fault(runs: dict[str, list[drift.DriftRun]]) -> None:
    assert all(run.findings == 0 for level in drift.TESTED for run in runs[level])


def test_a_level_fails_when_its_offsets_are_no_better_than_the_robots(runs: dict[str, list[drift.DriftRun]]) -> None:
    worse = [
        replace(run, windows=tuple(replace(w, fused_m=w.raw_m, nees=99.0) for w in run.windows))
        for run in runs["severe"]
    ]
    kept = drift.summarise(worse)["kept"]
    assert not kept["offset position at most half"]
    assert not kept["NEES inside its 95 % band"]
    assert kept["offset heading at most half"]


@pytest.mark.parametrize(("degrees", "low", "high"), [(10, 3.247, 20.483), (150, 117.985, 185.800)])
def test_the_band_is_that_of_chi_square(degrees: int, low: float, high: float) -> None:
    """Quantiles of printed tables."""
    assert drift.chi_square_band(degrees) == pytest.approx((low, high), rel=0.01)


@pytest.mark.parametrize("bad", [["--walks", "0"], ["--distance", "5"], ["--scene", "moon"]])
def test_bad_arguments_are_one_line(bad: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert drift.main(bad) == 2
    assert capsys.readouterr().err.count("\n") == 1
