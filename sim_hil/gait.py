"""The trot: phase, commanded and measured motion -> foot targets; pure, one call per control step.

Diagonal pairs swing in turn. A stance foot is carried backwards under the body at the wanted velocity; a swing foot
lands where the body will be half a stance later (Raibert, "Legged Robots That Balance", 1986: foot placement at
v*T/2 plus a gain on the velocity error). Position control alone walks too slowly and drifts, because legs sag and feet
slip, so the error of velocity and of heading is also integrated into the velocity that the stance feet are carried at.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import cos, exp, pi, sin
from typing import NamedTuple

from sim_hil.go2_urdf import FOOT_RADIUS_M, LEG_GEOMETRY, THIGH_Y_M, TOTAL_MASS_KG
from sim_hil.kinematics import Vec3

GRAVITY_MPS2 = 9.81
# Phase offset of FR, FL, RR, RL: diagonal pairs move together.
_OFFSETS = (0.0, 0.5, 0.5, 0.0)


@dataclass(frozen=True)
class GaitConfig:
    """Gait numbers; the limits are those measured not to fall (see sim_hil/sport.py), not the robot's own."""

    period_s: float = 0.42
    stance_ratio: float = 0.56
    swing_height_m: float = 0.075
    body_height_m: float = 0.31
    stance_widen_m: float = 0.012
    forward_shift_m: float = 0.0
    attitude_nm_per_rad: float = 120.0
    attitude_nms_per_rad: float = 6.0
    velocity_ns_per_m: float = 60.0
    accel_mps2: float = 1.5
    alpha_radps2: float = 4.0
    vx_limits_mps: tuple[float, float] = (-0.6, 1.1)
    vy_limit_mps: float = 0.35
    wz_limit_radps: float = 1.2

    def __post_init__(self) -> None:
        if not 0.2 <= self.period_s <= 1.0 or not 0.5 <= self.stance_ratio < 0.9:
            raise ValueError(f"gait: period {self.period_s} s or stance ratio {self.stance_ratio} makes no trot")
        if not 0.15 <= self.body_height_m <= 0.36:
            raise ValueError(f"gait: body height {self.body_height_m} m, expected 0.15..0.36")


class BodyMotion(NamedTuple):
    """What the gait knows of the body: attitude, rates and velocity in the level frame that turns with the heading."""

    yaw_rad: float
    roll_rad: float
    pitch_rad: float
    roll_rate_radps: float
    pitch_rate_radps: float
    yaw_rate_radps: float
    vx_mps: float
    vy_mps: float


class GaitState(NamedTuple):
    """Everything the gait remembers between steps."""

    walking: bool
    phase: float
    feet: tuple[Vec3, ...]
    lifted: tuple[Vec3, ...]
    smooth: Vec3  # slew-limited command vx, vy, wz
    filtered: Vec3  # low-passed measured vx, vy, wz
    integral: tuple[float, float]  # of the velocity error, m/s
    heading_rad: float  # heading the command asks for
    idle_s: float  # how long the command and the motion have been zero


class GaitOutput(NamedTuple):
    """Foot targets and the force each foot shall push on the ground with (zero in swing); base frame, m and N."""

    feet: tuple[Vec3, ...]
    push: tuple[Vec3, ...]


@lru_cache(maxsize=8)
def neutral_feet(config: GaitConfig) -> tuple[Vec3, ...]:
    """Foot targets of a level stand at the gait's body height, base frame, m."""
    return tuple(
        (
            leg.hip_m[0] + config.forward_shift_m,
            leg.hip_m[1] + leg.left * (THIGH_Y_M + config.stance_widen_m),
            FOOT_RADIUS_M - config.body_height_m,
        )
        for leg in LEG_GEOMETRY
    )


def start_gait(config: GaitConfig, yaw_rad: float) -> GaitState:
    """The gait's state of a robot that stands still with heading `yaw_rad`."""
    feet = neutral_feet(config)
    zero = (0.0, 0.0, 0.0)
    return GaitState(False, 0.0, feet, feet, zero, zero, (0.0, 0.0), yaw_rad, 0.0)


def _wrap(angle: float) -> float:
    return (angle + pi) % (2 * pi) - pi


def _clip(value: float, low: float, high: float) -> float:
    return low if value < low else high if value > high else value


def _slew(value: float, target: float, step: float) -> float:
    return value + _clip(target - value, -step, step)


def _near(value: float, centre: float, reach: float) -> float:
    """The value, no further than `reach` from the centre."""
    return _clip(value, centre - reach, centre + reach)


def _small(error: float, bound: float) -> float:
    """The error while it is small, else zero: a large one means being held, and must not be integrated."""
    return error if abs(error) < bound else 0.0


def limit_command(config: GaitConfig, command: Vec3) -> Vec3:
    """Clip (vx, vy, wz) to what this gait can do without falling."""
    low, high = config.vx_limits_mps
    return (
        _clip(command[0], low, high),
        _clip(command[1], -config.vy_limit_mps, config.vy_limit_mps),
        _clip(command[2], -config.wz_limit_radps, config.wz_limit_radps),
    )


def step_gait(
    config: GaitConfig, state: GaitState, command: Vec3, body: BodyMotion, dt_s: float
) -> tuple[GaitState, GaitOutput]:
    """Advance the gait by dt_s under `command` (vx m/s, vy m/s, wz rad/s, body frame)."""
    wanted = limit_command(config, command)
    asked = wanted != (0.0, 0.0, 0.0)
    restless = abs(body.vx_mps) + abs(body.vy_mps) > 0.25 or abs(body.roll_rad) + abs(body.pitch_rad) > 0.25
    if not state.walking and not asked and not restless:
        return _stand(config, state, body)
    if not state.walking:
        # A fresh walk starts from where the feet stand and from the heading the robot has now.
        state = state._replace(
            walking=True, phase=0.0, lifted=state.feet, heading_rad=body.yaw_rad, integral=(0.0, 0.0), idle_s=0.0
        )

    # The body surges and rocks within a step: feedback must see the average over one, not the ripple.
    blend = 1.0 - exp(-dt_s / (0.35 * config.period_s))
    filtered = (
        state.filtered[0] + blend * (body.vx_mps - state.filtered[0]),
        state.filtered[1] + blend * (body.vy_mps - state.filtered[1]),
        state.filtered[2] + blend * (body.yaw_rate_radps - state.filtered[2]),
    )
    # A robot held by a wall must not push harder and harder: the wish stays near what is achieved, and it eases off as
    # the body tilts. On a free floor neither limit is ever reached.
    ease = _clip(1.0 - (abs(body.roll_rad) + abs(body.pitch_rad) - 0.12) / 0.25, 0.0, 1.0)
    linear, turn = config.accel_mps2 * dt_s, config.alpha_radps2 * dt_s
    smooth = (
        _slew(state.smooth[0], _near(wanted[0] * ease, filtered[0], 0.4), linear),
        _slew(state.smooth[1], _near(wanted[1] * ease, filtered[1], 0.3), linear),
        _slew(state.smooth[2], _near(wanted[2] * ease, filtered[2], 0.8), turn),
    )
    error_x, error_y = smooth[0] - filtered[0], smooth[1] - filtered[1]
    integral = (
        _clip(state.integral[0] + 0.9 * _small(error_x, 0.3) * dt_s, -0.25, 0.25),
        _clip(state.integral[1] + 0.9 * _small(error_y, 0.2) * dt_s, -0.2, 0.2),
    )
    # Heading is followed rather than yaw rate: a straight command then stays straight over any distance. The lag is
    # bounded, so that a robot held by a wall does not spin when it comes free.
    lag = _clip(_wrap(state.heading_rad + smooth[2] * dt_s - body.yaw_rad), -0.18, 0.18)
    heading = body.yaw_rad + lag
    carry = (
        smooth[0] + integral[0] + 0.15 * error_x,
        smooth[1] + integral[1] + 0.15 * error_y,
        smooth[2] * 1.1 + 3.0 * lag + 0.1 * (smooth[2] - filtered[2]),
    )

    phase = (state.phase + dt_s / config.period_s) % 1.0
    feet, lifted, stance = _feet(config, state, phase, smooth, filtered, carry, body, dt_s)
    still = not asked and smooth == (0.0, 0.0, 0.0) and abs(filtered[0]) + abs(filtered[1]) < 0.08
    idle_s = state.idle_s + dt_s if still and abs(filtered[2]) < 0.15 and not restless else 0.0
    # Only after a whole quiet cycle, at the moment every foot is down, do the feet stay where they are.
    walking = not (idle_s > config.period_s and all(stance))
    return (
        GaitState(walking, phase, feet, lifted, smooth, filtered, integral, heading, idle_s),
        GaitOutput(feet, _push(config, feet, stance, body, smooth[0] - body.vx_mps, smooth[1] - body.vy_mps)),
    )


def _stand(config: GaitConfig, state: GaitState, body: BodyMotion) -> tuple[GaitState, GaitOutput]:
    feet = tuple((x, y, FOOT_RADIUS_M - config.body_height_m) for x, y, _ in state.feet)
    zero = (0.0, 0.0, 0.0)
    state = state._replace(feet=feet, smooth=zero, filtered=zero, heading_rad=body.yaw_rad)
    return state, GaitOutput(feet, _push(config, feet, (True,) * 4, body, 0.0, 0.0))


def _push(
    config: GaitConfig,
    feet: Sequence[Vec3],
    stance: Sequence[bool],
    body: BodyMotion,
    error_x_mps: float,
    error_y_mps: float,
) -> tuple[Vec3, ...]:
    """Share weight, attitude and velocity correction among the stance feet.

    Done in forces rather than in foot heights: a rate term in a position target would be differentiated once more by
    the joints' damping and make a standing robot shiver.
    """
    carrying = sum(stance)
    if carrying == 0:
        return ((0.0, 0.0, 0.0),) * len(feet)
    moment_x = -config.attitude_nm_per_rad * body.roll_rad - config.attitude_nms_per_rad * body.roll_rate_radps
    moment_y = -config.attitude_nm_per_rad * body.pitch_rad - config.attitude_nms_per_rad * body.pitch_rate_radps
    weight = TOTAL_MASS_KG * GRAVITY_MPS2 / carrying
    drive_x = config.velocity_ns_per_m * error_x_mps / carrying
    drive_y = config.velocity_ns_per_m * error_y_mps / carrying
    arms_x = sum(foot[0] ** 2 for foot, down in zip(feet, stance, strict=True) if down)
    arms_y = sum(foot[1] ** 2 for foot, down in zip(feet, stance, strict=True) if down)
    pushes: list[Vec3] = []
    for foot, down in zip(feet, stance, strict=True):
        if not down:
            pushes.append((0.0, 0.0, 0.0))
            continue
        up = weight + moment_x * foot[1] / arms_y - moment_y * foot[0] / arms_x
        pushes.append((-drive_x, -drive_y, -_clip(up, 0.0, 3.0 * weight)))
    return tuple(pushes)


def _feet(
    config: GaitConfig,
    state: GaitState,
    phase: float,
    smooth: Vec3,
    filtered: Vec3,
    carry: Vec3,
    body: BodyMotion,
    dt_s: float,
) -> tuple[tuple[Vec3, ...], tuple[Vec3, ...], tuple[bool, ...]]:
    ground = FOOT_RADIUS_M - config.body_height_m
    half_stance = 0.5 * config.stance_ratio * config.period_s
    feet, lifted, stances = [], [], []
    for leg, (offset, home) in enumerate(zip(_OFFSETS, neutral_feet(config), strict=True)):
        own = (phase + offset) % 1.0
        x, y, z = state.feet[leg]
        lift = state.lifted[leg]
        stance = own < config.stance_ratio
        if stance:
            x -= (carry[0] - carry[2] * y) * dt_s
            y -= (carry[1] + carry[2] * x) * dt_s
            x, y = _clip(x, home[0] - 0.14, home[0] + 0.14), _clip(y, home[1] - 0.09, home[1] + 0.09)
            z = ground
            lift = (x, y, z)
        else:
            swing = (own - config.stance_ratio) / (1.0 - config.stance_ratio)
            # Raibert: neutral point from the measured velocity, plus a correction of the velocity error.
            step_x = (filtered[0] - carry[2] * home[1]) * half_stance + 0.10 * (body.vx_mps - smooth[0])
            step_y = (filtered[1] + carry[2] * home[0]) * half_stance + 0.12 * (body.vy_mps - smooth[1])
            land_x, land_y = home[0] + _clip(step_x, -0.13, 0.13), home[1] + _clip(step_y, -0.11, 0.11)
            reach = min(swing / 0.9, 1.0)  # arrive early, so that the foot does not slide on touch-down
            blend = reach - sin(2 * pi * reach) / (2 * pi)
            x, y = lift[0] + (land_x - lift[0]) * blend, lift[1] + (land_y - lift[1]) * blend
            z = ground + config.swing_height_m * 0.5 * (1.0 - cos(2 * pi * swing))
        feet.append((x, y, z))
        lifted.append(lift)
        stances.append(stance)
    return tuple(feet), tuple(lifted), tuple(stances)
