"""Made-up drives for the tests of the drift estimator: a true path at 50 Hz and what sensors would say of it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from edge.core.geometry import SE2
from edge.odometry.estimator import DriftEstimator, OdometryOutputs
from edge.odometry.gate import OdometryInputs
from edge.odometry.visual_odometry import VisualMotion

STATE_NS = 20_000_000
STAND_S = 2.0
VISUAL_NS = 400_000_000
VISUAL_SIGMA = (0.003, 0.003, math.radians(0.1))


@dataclass(frozen=True)
class Drive:
    """True poses, one every `STATE_NS`, and what the robot reports of them."""

    true: tuple[SE2, ...]
    reports: tuple[OdometryInputs, ...]

    def stamp_ns(self, index: int) -> int:
        return self.reports[index].received_ns


def drive(
    seconds: float, *, vx_mps: float = 0.5, wz_radps: float = 0.1, scale: float = 1.0, yaw_drift_rad_per_m: float = 0.0,
    gyro_bias_radps: float = 0.0, seed: int = 0, gyro_sigma_radps: float = 0.003,
) -> Drive:  # fmt: skip
    """Stand, then drive an arc; the odometry reports `scale` times the way and turns by a drift that is not there."""
    rng = np.random.default_rng(seed)
    dt_s = STATE_NS / 1e9
    true, odometry = SE2(0.0, 0.0, 0.0), SE2(3.0, -1.0, 0.5)
    trues, reports = [], []
    for index in range(round(seconds / dt_s)):
        moving = index * dt_s >= STAND_S
        vx, wz = (vx_mps, wz_radps) if moving else (0.0, 0.0)
        true = true @ SE2(vx * dt_s, 0.0, wz * dt_s)
        turned = wz * dt_s + yaw_drift_rad_per_m * abs(vx) * dt_s
        odometry = odometry @ SE2(scale * vx * dt_s, 0.0, turned)
        trues.append(true)
        reports.append(
            OdometryInputs(
                received_ns=(index + 1) * STATE_NS,
                T_odom_base=odometry.as_tuple(),
                vx_mps=scale * vx,
                vy_mps=0.0,
                wz_radps=turned / dt_s,
                gyro_wz_radps=wz + gyro_bias_radps + rng.normal(0, gyro_sigma_radps),
                robot_stamp_ns=(index + 1) * STATE_NS,
                foot_forces=(40.0, 40.0, 40.0, 40.0),
                commanded=(vx, 0.0, wz),
            )
        )
    return Drive(tuple(trues), tuple(reports))


def visual_motions(path: Drive, *, seed: int = 0, scale: float = 1.0) -> list[VisualMotion]:
    """Camera motions over the whole drive, with the noise that they admit to."""
    rng = np.random.default_rng((seed, 7))
    every = VISUAL_NS // STATE_NS
    sx, sy, stheta = VISUAL_SIGMA
    motions = []
    for start in range(0, len(path.true) - every, every):
        moved = path.true[start].inverse() @ path.true[start + every]
        ex, ey, etheta = rng.normal(0, VISUAL_SIGMA)
        seen = SE2(scale * moved.x_m + ex, scale * moved.y_m + ey, moved.theta_rad + etheta)
        covariance = (sx * sx, 0.0, 0.0, 0.0, sy * sy, 0.0, 0.0, 0.0, stheta * stheta)
        motions.append(VisualMotion(path.stamp_ns(start), path.stamp_ns(start + every), seen, covariance, 50))
    return motions


def play(
    path: Drive, estimator: DriftEstimator, motions: list[VisualMotion] | None = None, delay_ns: int = 100_000_000
) -> Iterator[tuple[int, OdometryOutputs]]:
    """Feed a drive to an estimator, camera motions as late as they would be; (index, outputs) of every report."""
    waiting = list(motions or [])
    for index, report in enumerate(path.reports):
        while waiting and waiting[0].end_ns + delay_ns <= report.received_ns:
            estimator.add_visual(waiting.pop(0))
        yield index, estimator.step(report, report.received_ns)
