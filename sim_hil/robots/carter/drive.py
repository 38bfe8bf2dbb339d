"""Drive of the Carter: a velocity command in, two wheel torques and wheel odometry out. Pure: no clock, no physics.

A reference velocity follows the command within acceleration limits. A feed-forward torque and a PI controller per wheel
track it. The motors' torque limit decreases near their top speed. A command is valid for 1 s; then the base brakes.
Odometry integrates the encoders with a calibration of the wheels, so it includes their slip and its errors.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, floor, isfinite, pi, sin
from typing import Final

import numpy as np

from edge.core.geometry import SE2
from sim_hil.robots.carter.urdf import MASS_KG, TRACK_M, WHEEL_INERTIA_KGM2, WHEEL_RADIUS_M

HOLD_S: Final = 1.0  # the robots' contract (sim_hil/robots/interface.py)
# Our choice: a hub motor that climbs an 8 degree ramp with its rated load and a 2 cm edge, and spins its tyre rather
# than climb a kerb. The top speed is the maker's 3.3 m/s.
MAX_TORQUE_NM: Final = 25.0
NO_LOAD_RADPS: Final = 3.3 / WHEEL_RADIUS_M
# Of the loaded wheel (0.5 kg.m^2): a corner of 2.5 Hz; of one in the air (0.034 kg.m^2): stable down to 240 Hz.
_KP_NMS_PER_RAD: Final = 8.0
_KI_NM_PER_RAD: Final = 30.0
_TURN_INERTIA_KGM2: Final = 3.0
# Limits of commands, and of the reference's acceleration and braking.
V_MAX_MPS: Final = 1.5
W_MAX_RADPS: Final = 2.0
ACCEL_MPS2: Final = 1.0
BRAKE_MPS2: Final = 2.0
ESTOP_MPS2: Final = 2.5
ALPHA_RADPS2: Final = 4.0
COUNTS_PER_TURN: Final = 4096  # our choice: an encoder of 12 bits on the wheel
# Our choice, of the size that tyres differ by: 0.2 % between two of a kind, 0.5 % for both, 1 % of the track where the
# tyre's width hides the point that it turns about. 0.2 % between the wheels turns the report by 0.28 degrees a metre.
_SCALE_SIGMA: Final = 0.005
_MISMATCH_SIGMA: Final = 0.002
_TRACK_SIGMA: Final = 0.01


def towards(now: float, target: float, up: float, down: float) -> float:
    """Move `now` towards `target`: at most `up` away from zero, at most `down` towards zero, never across it."""
    if now * target < 0 or abs(target) < abs(now):
        low = max(abs(now) - down, abs(target) if now * target > 0 else 0.0)
        return low if now > 0 else -low
    step = min(abs(target) - abs(now), up)
    return now + (step if target > 0 else -step)


class DriveController:
    """Controller of both wheels; call `step` once per physics step, every `dt_s`."""

    def __init__(self, dt_s: float) -> None:
        self.powered = False
        self.estop = False
        self._dt_s = dt_s
        self._hold = round(HOLD_S / dt_s)
        self._left_steps = 0
        self._target = (0.0, 0.0)
        self._v = self._w = 0.0
        self._sum_left = self._sum_right = 0.0
        self.saturated = False

    def command(self, v_mps: float, w_radps: float) -> None:
        """Command a velocity, clipped to the limits; ignored while unpowered or stopped. Raises ValueError on NaN."""
        if not (isfinite(v_mps) and isfinite(w_radps)):
            raise ValueError(f"drive: expected finite velocities, found {v_mps}, {w_radps}")
        if not self.ready:
            return
        self._target = (max(-V_MAX_MPS, min(V_MAX_MPS, v_mps)), max(-W_MAX_RADPS, min(W_MAX_RADPS, w_radps)))
        self._left_steps = self._hold

    @property
    def ready(self) -> bool:
        """Whether the drive would obey a command."""
        return self.powered and not self.estop

    @property
    def commanded(self) -> tuple[float, float]:
        """The command in force: zero once it has expired or is forbidden."""
        return self._target if self.ready and self._left_steps > 0 else (0.0, 0.0)

    @property
    def reference(self) -> tuple[float, float]:
        """Current reference velocity, m/s and rad/s."""
        return self._v, self._w

    def step(self, left_radps: float, right_radps: float) -> tuple[float, float]:
        """Return the torques of the left and the right wheel, N.m, for their measured speeds."""
        v_target, w_target = self.commanded
        if self._left_steps > 0:
            self._left_steps -= 1
        dt = self._dt_s
        brake = ESTOP_MPS2 if self.estop else BRAKE_MPS2
        v = towards(self._v, v_target, ACCEL_MPS2 * dt, brake * dt)
        w = towards(self._w, w_target, ALPHA_RADPS2 * dt, ALPHA_RADPS2 * dt)
        a, alpha = (v - self._v) / dt, (w - self._w) / dt
        if v == 0.0 == w and (self._v != 0.0 or self._w != 0.0):
            # Come to rest: a wheel that was pushing something must let go of it. The integral starts anew and holds the
            # wheels where they are, on a ramp too.
            self._sum_left = self._sum_right = 0.0
        self._v, self._w = v, w
        half = TRACK_M / 2
        push = MASS_KG * a * WHEEL_RADIUS_M / 2 + WHEEL_INERTIA_KGM2 * a / WHEEL_RADIUS_M
        turn = _TURN_INERTIA_KGM2 * alpha * WHEEL_RADIUS_M / TRACK_M
        left_error = (v - w * half) / WHEEL_RADIUS_M - left_radps
        right_error = (v + w * half) / WHEEL_RADIUS_M - right_radps
        wanted_left = push - turn + _KP_NMS_PER_RAD * left_error + self._sum_left
        wanted_right = push + turn + _KP_NMS_PER_RAD * right_error + self._sum_right
        left, right = _within(wanted_left, left_radps), _within(wanted_right, right_radps)
        # The integral only grows while the motor can follow it.
        if left == wanted_left:
            self._sum_left += _KI_NM_PER_RAD * left_error * dt
        if right == wanted_right:
            self._sum_right += _KI_NM_PER_RAD * right_error * dt
        self.saturated = left != wanted_left or right != wanted_right
        return left, right


def _within(torque_nm: float, speed_radps: float) -> float:
    """Limit a motor's torque: full for braking, decreasing for driving above two thirds of its top speed."""
    share = min(1.0, max(0.0, 3.0 * (1.0 - abs(speed_radps) / NO_LOAD_RADPS)))
    driving = MAX_TORQUE_NM * share
    up = driving if speed_radps > 0 else MAX_TORQUE_NM
    down = driving if speed_radps < 0 else MAX_TORQUE_NM
    return max(-down, min(up, torque_nm))


@dataclass(frozen=True)
class WheelCalibration:
    """Assumed dimensions of the wheels, m."""

    left_radius_m: float = WHEEL_RADIUS_M
    right_radius_m: float = WHEEL_RADIUS_M
    track_m: float = TRACK_M

    @staticmethod
    def drawn(seed: int) -> WheelCalibration:
        """Return a calibration with typical errors; deterministic per seed."""
        rng = np.random.default_rng((seed, 0x0D0))
        scale, mismatch, track = (float(value) for value in rng.standard_normal(3))
        radius = WHEEL_RADIUS_M * (1 + _SCALE_SIGMA * scale)
        half = _MISMATCH_SIGMA * mismatch / 2
        return WheelCalibration(radius * (1 - half), radius * (1 + half), TRACK_M * (1 + _TRACK_SIGMA * track))


@dataclass(frozen=True)
class OdometrySample:
    """Odometry report: `T_odom_base`, body velocity from the wheel speeds, distance travelled, encoder counts."""

    T_odom_base: SE2
    v_mps: float
    w_radps: float
    distance_m: float
    left_counts: int
    right_counts: int


def _counts(angle_rad: float) -> int:
    return floor(angle_rad * COUNTS_PER_TURN / (2 * pi))


class WheelOdometry:
    """Integrator of encoder counts, starting at the origin; call `step` after every physics step."""

    def __init__(self, calibration: WheelCalibration | None = None) -> None:
        calibration = calibration or WheelCalibration()
        self._calibration = calibration
        self._left_m = 2 * pi * calibration.left_radius_m / COUNTS_PER_TURN
        self._right_m = 2 * pi * calibration.right_radius_m / COUNTS_PER_TURN
        self._left = self._right = 0
        self._x = self._y = self._theta = self._way = 0.0

    def step(self, left_rad: float, right_rad: float) -> None:
        """Add the wheels' angles."""
        left, right = _counts(left_rad), _counts(right_rad)
        left_m, right_m = (left - self._left) * self._left_m, (right - self._right) * self._right_m
        self._left, self._right = left, right
        moved, turned = (left_m + right_m) / 2, (right_m - left_m) / self._calibration.track_m
        # The chord of the arc, along its middle heading: exact for a turn at a steady rate to the third order.
        middle = self._theta + turned / 2
        self._x += moved * cos(middle)
        self._y += moved * sin(middle)
        self._theta += turned
        self._way += abs(moved)

    def sample(self, left_radps: float, right_radps: float) -> OdometrySample:
        """Return the report; speeds come from the motors, because the counts of one step are too coarse."""
        wheels = self._calibration
        left, right = left_radps * wheels.left_radius_m, right_radps * wheels.right_radius_m
        pose = SE2(self._x, self._y, self._theta)
        return OdometrySample(
            pose, (left + right) / 2, (right - left) / wheels.track_m, self._way, self._left, self._right
        )
