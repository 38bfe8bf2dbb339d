"""From a planned trajectory to a velocity command: the point 1 s ahead, an arc to it, limits, slew (paper appendix B).

Pure: no clock, no thread, no I/O. Whatever is missing, old or not finite gives zero velocity in the same step. The
limits are the robot file's and frozen: the supervisor can lower the speed below them, and nothing can raise it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from edge.core.geometry import SE2
from firmware_bridge.core.config import LimitsConfig

TARGET_TIME_S = 1.0
TURN_IN_PLACE_M = 0.05
"""Distance below which a target's direction is ignored and only its heading is followed, m."""
STEER_M = 0.25
"""Distance from which only its direction is followed, m: that of a robot that hardly moves is noise."""
MAX_STEP_S = 0.2
NO_SEMANTIC_STATE = "no-semantic-state"
"""Reason for standing before the first text of an instruction."""


@dataclass(frozen=True)
class ControllerConfig:
    """Limits of the robot and the ages beyond which inputs give zero velocity."""

    limits: LimitsConfig
    step_s: float
    frame_max_age_ms: float
    odometry_max_age_ms: float

    def __post_init__(self) -> None:
        if self.step_s <= 0 or self.frame_max_age_ms <= 0 or self.odometry_max_age_ms <= 0:
            raise ValueError("controller step and ages must be positive")


@dataclass(frozen=True)
class ControllerInputs:
    """The inputs of one tick; an age is None while there is no such input."""

    trajectory: npt.NDArray[np.float32] | None
    """Planned (x m, y m, θ rad) in the current robot frame, [steps, 3]; None before the first semantic state."""
    frame_age_ms: float | None
    odometry_age_ms: float | None
    speed_scale: float = 1.0
    """Share of the speed limits that may be used (supervisor), clamped to 0..1."""
    hold: str | None = None
    """Reason for zero velocity whatever the plan; None: the plan decides."""


@dataclass(frozen=True)
class VelocityCommand:
    """Body velocity with the target it came from and, when zero was forced, why."""

    vx_mps: float
    vy_mps: float
    wz_radps: float
    target: SE2 | None
    reason: str


def arc_to(target: SE2, time_s: float) -> tuple[float, float]:
    """Return speed (m/s) and yaw rate (rad/s) of the arc, tangent to x, that meets the target in `time_s`.

    The arc's end has twice the target's bearing as its heading; the nearer the target, the more its own heading counts.
    """
    distance_m = math.hypot(target.x_m, target.y_m)
    if distance_m < TURN_IN_PLACE_M:
        return 0.0, target.theta_rad / time_s
    bearing = math.atan2(target.y_m, target.x_m)
    arc_m, turn_rad = 0.0, math.copysign(math.pi / 2, bearing)
    # A point behind is turned to instead of reversed to: the camera faces forward.
    if abs(bearing) <= math.pi / 2:
        arc_m = distance_m if abs(bearing) < 1e-6 else distance_m * bearing / math.sin(bearing)
        turn_rad = 2 * bearing
    share = min((distance_m - TURN_IN_PLACE_M) / (STEER_M - TURN_IN_PLACE_M), 1.0)
    return arc_m / time_s, (share * turn_rad + (1.0 - share) * target.theta_rad) / time_s


def is_plan(trajectory: npt.NDArray[np.float32]) -> bool:
    """Return whether a trajectory can be driven: at least one row, each of three finite numbers."""
    shaped = trajectory.ndim == 2 and trajectory.shape[0] > 0 and trajectory.shape[1] == 3
    return shaped and bool(np.isfinite(trajectory).all())


def target_of(trajectory: npt.NDArray[np.float32], step_s: float) -> SE2:
    """Return the target point of a finite plan [steps, 3]: 1 s ahead, or the last one of a shorter plan."""
    index = min(len(trajectory), max(1, round(TARGET_TIME_S / step_s))) - 1
    x_m, y_m, theta_rad = (float(value) for value in trajectory[index])
    return SE2(x_m, y_m, theta_rad)


def scale_to_limits(
    speed_mps: float, yaw_rate_radps: float, limits: LimitsConfig, speed_scale: float
) -> tuple[float, float]:
    """Reduce both velocities by one factor to within `speed_scale` of the limits: slower on the same arc.

    `speed_mps` is 0 or more. The result never exceeds a limit, not even by a rounding error.
    """
    # A comparison with NaN is false: a scale that is no number gives no speed.
    scale = min(speed_scale, 1.0) if speed_scale > 0 else 0.0
    vx_max_mps, wz_max_radps = limits.vx_max_mps * scale, limits.wz_max_radps * scale
    share = scale / max(scale, speed_mps / limits.vx_max_mps, abs(yaw_rate_radps) / limits.wz_max_radps, 1e-9)
    # The rounded product can lie one bit above the limit that the factor was computed from.
    wz_radps = min(max(yaw_rate_radps * share, -wz_max_radps), wz_max_radps)
    return min(speed_mps * share, vx_max_mps), wz_radps


def grown(value: float, goal: float, step: float) -> float:
    """Return `goal` with its magnitude at most `step` above that of `value`; slowing down is never limited."""
    reached = abs(value) if value * goal > 0 else 0.0
    return math.copysign(min(abs(goal), reached + step), goal)


class Controller:
    """Controller whose only state is the last command, for the slew limit."""

    def __init__(self, config: ControllerConfig) -> None:
        self._config = config
        self._vx_mps = 0.0
        self._wz_radps = 0.0
        self._last_ns: int | None = None

    @property
    def config(self) -> ControllerConfig:
        """Immutable configuration."""
        return self._config

    def step(self, inputs: ControllerInputs, now_ns: int) -> VelocityCommand:
        """Return the command of this tick."""
        elapsed_s = 0.0 if self._last_ns is None else min(max((now_ns - self._last_ns) / 1e9, 0.0), MAX_STEP_S)
        self._last_ns = now_ns
        reason = self._refusal(inputs)
        if reason is not None or inputs.trajectory is None:
            return self.halt(reason or NO_SEMANTIC_STATE)
        target = target_of(inputs.trajectory, self._config.step_s)
        speed, yaw_rate = arc_to(target, TARGET_TIME_S)
        limits = self._config.limits
        vx_mps, wz_radps = scale_to_limits(speed, yaw_rate, limits, inputs.speed_scale)
        self._vx_mps = grown(self._vx_mps, vx_mps, limits.accel_mps2 * elapsed_s)
        self._wz_radps = grown(self._wz_radps, wz_radps, limits.alpha_radps2 * elapsed_s)
        return VelocityCommand(self._vx_mps, 0.0, self._wz_radps, target, "ok")

    def halt(self, reason: str) -> VelocityCommand:
        """Command zero velocity; the next command accelerates from standstill."""
        self._vx_mps = self._wz_radps = 0.0
        return VelocityCommand(0.0, 0.0, 0.0, None, reason)

    def _refusal(self, inputs: ControllerInputs) -> str | None:
        config = self._config
        if inputs.hold is not None:
            return inputs.hold
        if inputs.frame_age_ms is None or not 0 <= inputs.frame_age_ms <= config.frame_max_age_ms:
            return "stale-frame"
        if inputs.odometry_age_ms is None or not 0 <= inputs.odometry_age_ms <= config.odometry_max_age_ms:
            return "stale-odometry"
        if inputs.trajectory is None:
            return NO_SEMANTIC_STATE
        if not is_plan(inputs.trajectory):
            return "bad-output"
        return None
