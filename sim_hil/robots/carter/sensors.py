"""Sensors of the Carter, independent of the protocol: wheel odometry, IMU, battery, bumpers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from edge.core.geometry import SE2
from sim_hil.robots.carter.body import CarterTruth
from sim_hil.robots.odometry_noise import LEVELS, OdometryNoise

Triple = tuple[float, float, float]

# Our choice, of the size of a robot's MEMS sensor: bias drawn once, white noise on every sample (one standard
# deviation).
GYRO_BIAS_RADPS: Final = 0.002
GYRO_NOISE_RADPS: Final = 0.002
ACCEL_BIAS_MPS2: Final = 0.03
ACCEL_NOISE_MPS2: Final = 0.03
EMPTY_PERCENT: Final = 3.0
"""Reported charge of a battery that is nearly empty, %."""


@dataclass(frozen=True)
class Sensors:
    """One reading: pairs are (left, right), vectors in the base frame; bumpers front, rear, left, right."""

    T_odom_base: SE2
    v_mps: float
    w_radps: float
    wheel_radps: tuple[float, float]
    wheel_nm: tuple[float, float]
    wheel_counts: tuple[int, int]
    gyro_radps: Triple
    accel_mps2: Triple
    charge_percent: float
    voltage_v: float
    current_a: float
    bumpers: tuple[bool, bool, bool, bool]
    overload: bool


class _Robot(Protocol):
    def truth(self, time_s: float) -> CarterTruth: ...


class CarterSensors:
    """Sensors of one robot; the same seed and the same calls give the same readings."""

    def __init__(self, robot: _Robot, *, odometry_noise: str = "none", seed: int = 0) -> None:
        """Create the sensors; `odometry_noise`: a name of `LEVELS`, in addition to the wheels' slip."""
        self._robot = robot
        self._noise = None if odometry_noise == "none" else OdometryNoise(LEVELS[odometry_noise], seed)
        self._rng = np.random.default_rng((seed, 0x1A0))
        self._gyro_bias = GYRO_BIAS_RADPS * self._rng.standard_normal(3)
        self._accel_bias = ACCEL_BIAS_MPS2 * self._rng.standard_normal(3)
        self._wheels_pose = SE2(0.0, 0.0, 0.0)
        self._time_s = 0.0
        self._error = (0.0, 0.0)  # of the reported velocity, m/s and rad/s
        self.is_empty = False
        """Whether the battery reads nearly empty."""

    def read(self, time_s: float) -> Sensors:
        """Return the reading at a time, s; times must not decrease."""
        truth = self._robot.truth(time_s)
        odometry, battery, bumpers = truth.odometry, truth.battery, truth.bumpers
        pose = self._drifted(odometry.T_odom_base, time_s)
        gyro = truth.gyro_radps + self._gyro_bias + GYRO_NOISE_RADPS * self._rng.standard_normal(3)
        accel = truth.accel_mps2 + self._accel_bias + ACCEL_NOISE_MPS2 * self._rng.standard_normal(3)
        return Sensors(
            T_odom_base=pose,
            v_mps=odometry.v_mps + self._error[0],
            w_radps=odometry.w_radps + self._error[1],
            wheel_radps=truth.wheel_dq_radps,
            wheel_nm=truth.wheel_tau_nm,
            wheel_counts=(odometry.left_counts, odometry.right_counts),
            gyro_radps=(float(gyro[0]), float(gyro[1]), float(gyro[2])),
            accel_mps2=(float(accel[0]), float(accel[1]), float(accel[2])),
            charge_percent=EMPTY_PERCENT if self.is_empty else battery.soc_percent,
            voltage_v=battery.voltage_v,
            current_a=battery.current_a,
            bumpers=(bumpers.front, bumpers.rear, bumpers.left, bumpers.right),
            overload=truth.saturated,
        )

    def _drifted(self, pose: SE2, time_s: float) -> SE2:
        if self._noise is None:
            return pose
        elapsed_s = time_s - self._time_s
        if elapsed_s > 0:
            moved = self._wheels_pose.inverse() @ pose
            report = self._noise.step(moved, elapsed_s)
            self._error = (report.vx_mps - moved.x_m / elapsed_s, report.wz_radps - moved.theta_rad / elapsed_s)
            self._wheels_pose, self._time_s = pose, time_s
        return self._noise.pose
