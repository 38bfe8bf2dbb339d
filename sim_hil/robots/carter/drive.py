"""Drive electronics of the Carter: a velocity command in, two wheel torques out. Pure: no clock, no physics.

A reference velocity follows the command within acceleration limits. A feed-forward torque and a PI controller per wheel
track it. The motors' torque limit decreases near their top speed. A command is valid for 1 s; then the base brakes.
"""

from __future__ import annotations

from math import isfinite
from typing import Final

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


def _towards(now: float, target: float, up: float, down: float) -> float:
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
        v = _towards(self._v, v_target, ACCEL_MPS2 * dt, brake * dt)
        w = _towards(self._w, w_target, ALPHA_RADPS2 * dt, ALPHA_RADPS2 * dt)
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
