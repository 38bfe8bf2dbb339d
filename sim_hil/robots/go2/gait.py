"""Trot: foot targets from phase, commanded and measured motion; pure, one call per control step.

Diagonal pairs swing in turn. A stance foot is carried backwards under the body at the wanted velocity; a swing foot
lands where the body will be half a stance later (Raibert, "Legged Robots That Balance", 1986: foot placement at
v*T/2 plus a gain on the velocity error), shifted against the wanted acceleration: a body that speeds up or turns must
lean into it. Position control alone walks too slowly and drifts, because legs sag and feet slip, so the error of
velocity and of heading is also integrated into the velocity that the stance feet are carried at. With speed the period
shortens and the stance becomes half of it, so that the stride stays within the legs' reach.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import exp, pi, sqrt
from typing import NamedTuple

from sim_hil.robots.go2.kinematics import Vec3
from sim_hil.robots.go2.urdf import FOOT_RADIUS_M, LEG_GEOMETRY, THIGH_Y_M, TOTAL_MASS_KG

GRAVITY_MPS2 = 9.81
Vec2 = tuple[float, float]
# Phase offset of FR, FL, RR, RL: diagonal pairs move together.
_OFFSETS = (0.0, 0.5, 0.5, 0.0)
_ZERO2: Vec2 = (0.0, 0.0)
_ZERO3: Vec3 = (0.0, 0.0, 0.0)
_ALL_DOWN = (True, True, True, True)
_REACH_X_M, _REACH_Y_M = 0.17, 0.14  # how far from home a foot may be
_CARRY_SHARE = 0.92  # a trot with the stance feet carried at v was measured to go at v / 0.92


@dataclass(frozen=True)
class GaitConfig:
    """Gait numbers; the limits are those measured not to fall (tools/bench/locomotion.py), not the robot's own."""

    period_s: float = 0.36
    stance_ratio: float = 0.56
    swing_height_m: float = 0.075
    slow_mps: float = 0.5  # up to here the above hold,
    fast_period_s: float = 0.26  # from `fast_mps` on these
    fast_stance_ratio: float = 0.5
    fast_swing_height_m: float = 0.055
    fast_mps: float = 1.4
    body_height_m: float = 0.31
    stance_widen_m: float = 0.012
    forward_shift_m: float = 0.0
    attitude_nm_per_rad: float = 140.0
    attitude_nms_per_rad: float = 7.0
    velocity_ns_per_m: float = 60.0
    accel_x_mps2: float = 1.5
    accel_y_mps2: float = 1.0
    alpha_radps2: float = 3.0
    vx_limits_mps: tuple[float, float] = (-0.8, 1.5)
    vy_limit_mps: float = 0.5
    wz_limit_radps: float = 1.2
    run_mps: float = 1.0
    turn_mps2: float = 1.5

    @cached_property
    def home(self) -> tuple[Vec3, ...]:
        """Foot targets of a level stand at the gait's body height, base frame, m."""
        return tuple(
            (
                leg.hip_m[0] + self.forward_shift_m,
                leg.hip_m[1] + leg.left * (THIGH_Y_M + self.stance_widen_m),
                FOOT_RADIUS_M - self.body_height_m,
            )
            for leg in LEG_GEOMETRY
        )

    @cached_property
    def _legs(self) -> tuple[tuple[int, float, float, float], ...]:
        """Leg, phase offset, home x and home y: what the step loops over."""
        return tuple((leg, _OFFSETS[leg], x, y) for leg, (x, y, _) in enumerate(self.home))


class BodyMotion(NamedTuple):
    """Measured motion of the body: attitude, rates and velocity in the level frame that turns with the heading."""

    yaw_rad: float
    roll_rad: float
    pitch_rad: float
    roll_rate_radps: float
    pitch_rate_radps: float
    yaw_rate_radps: float
    vx_mps: float
    vy_mps: float


class GaitState(NamedTuple):
    """State of the gait between steps."""

    walking: bool
    phase: float
    feet: tuple[Vec3, ...]
    lifted: tuple[Vec3, ...]
    smooth: Vec3  # slew-limited command vx, vy, wz
    filtered: Vec3  # low-passed measured vx, vy, wz
    expected: Vec2  # vx, vy of `smooth` behind the same low-pass
    integral: Vec2  # of the velocity error, m/s
    lean_mps2: Vec2  # wanted acceleration along x and y of the body, low-passed
    heading_rad: float  # heading the command asks for
    idle_s: float  # how long the command and the motion have been zero


class GaitOutput(NamedTuple):
    """Foot targets and the force each foot shall push on the ground with (zero in swing); base frame, m and N."""

    feet: tuple[Vec3, ...]
    push: tuple[Vec3, ...]


def start_gait(config: GaitConfig, yaw_rad: float) -> GaitState:
    """The gait's state of a robot that stands still with heading `yaw_rad`."""
    feet = config.home
    return GaitState(False, 0.0, feet, feet, _ZERO3, _ZERO3, _ZERO2, _ZERO2, _ZERO2, yaw_rad, 0.0)


def _wrap(angle: float) -> float:
    return (angle + pi) % (2 * pi) - pi


def _clip(value: float, low: float, high: float) -> float:
    return low if value < low else high if value > high else value


def _slew(value: float, target: float, step: float) -> float:
    gap = target - value
    return value + (step if gap > step else -step if gap < -step else gap)


def limit_command(config: GaitConfig, command: Vec3) -> Vec3:
    """Clip (vx, vy, wz) to what this gait can do without falling.

    Above `run_mps` there is less and less room to go sideways, and the turn is bounded by its centripetal acceleration.
    """
    vx, vy, wz = command
    vx = _clip(vx, *config.vx_limits_mps)
    side, turn, speed = config.vy_limit_mps, config.wz_limit_radps, abs(vx)
    if speed > config.run_mps:
        side = max(side - 0.4 * (speed - config.run_mps), 0.0)
    if speed * turn > config.turn_mps2:
        turn = config.turn_mps2 / speed
    return (vx, _clip(vy, -side, side), _clip(wz, -turn, turn))


def step_gait(
    config: GaitConfig, state: GaitState, command: Vec3, body: BodyMotion, dt_s: float
) -> tuple[GaitState, GaitOutput]:
    """Advance the gait by dt_s under `command` (vx m/s, vy m/s, wz rad/s, body frame)."""
    yaw, roll, pitch, _, _, yaw_rate, vx, vy = body
    walking, phase, feet, lifted, smooth, filtered, expected, integral, lean, heading, idle_s = state
    wanted = _ZERO3 if command == _ZERO3 else limit_command(config, command)
    asked = wanted != _ZERO3
    tilt = abs(roll) + abs(pitch)
    restless = tilt > 0.25 or abs(vx) + abs(vy) > 0.25
    if not walking:
        if not asked and not restless:
            return _stand(config, state, body)
        # A fresh walk starts from where the feet stand and from the heading the robot has now.
        phase, lifted, heading, integral, idle_s = 0.0, feet, yaw, _ZERO2, 0.0

    speed = sqrt(smooth[0] * smooth[0] + smooth[1] * smooth[1])
    fast = _clip((speed - config.slow_mps) / (config.fast_mps - config.slow_mps), 0.0, 1.0)
    period_s = config.period_s + fast * (config.fast_period_s - config.period_s)
    ratio = config.stance_ratio + fast * (config.fast_stance_ratio - config.stance_ratio)
    height_m = config.swing_height_m + fast * (config.fast_swing_height_m - config.swing_height_m)
    # The body surges and rocks within a step: feedback must see the average over one, not the ripple.
    blend = 1.0 - exp(-dt_s / (0.35 * period_s))
    fx, fy, fw = filtered
    fx, fy, fw = fx + blend * (vx - fx), fy + blend * (vy - fy), fw + blend * (yaw_rate - fw)
    # A robot held by a wall must not push harder and harder: the wish stays near what is achieved, and it eases off as
    # the body tilts. On a free floor neither limit is ever reached, on a ramp of 8 degrees not the second.
    wx, wy, ww = wanted
    if tilt > 0.22:
        ease = _clip(1.0 - (tilt - 0.22) / 0.25, 0.0, 1.0)
        wx, wy, ww = wx * ease, wy * ease, ww * ease
    sx, sy, sw = smooth
    sx = _slew(sx, _clip(wx, fx - 0.4, fx + 0.4), config.accel_x_mps2 * dt_s)
    sy = _slew(sy, _clip(wy, fy - 0.3, fy + 0.3), config.accel_y_mps2 * dt_s)
    sw = _slew(sw, _clip(ww, fw - 0.8, fw + 0.8), config.alpha_radps2 * dt_s)
    lx, ly = lean
    lx += blend * ((sx - smooth[0]) / dt_s - sy * sw - lx)
    ly += blend * ((sy - smooth[1]) / dt_s + sx * sw - ly)
    ex, ey = expected
    ex, ey = ex + blend * (sx - ex), ey + blend * (sy - ey)
    error_x, error_y = ex - fx, ey - fy
    # A large error means being held, and must not be integrated.
    ix, iy = integral
    if -0.3 < error_x < 0.3:
        ix = _clip(ix + 0.9 * error_x * dt_s, -0.25, 0.25)
    if -0.2 < error_y < 0.2:
        iy = _clip(iy + 0.9 * error_y * dt_s, -0.2, 0.2)
    # Heading is followed rather than yaw rate: a straight command then stays straight over any distance. The lag is
    # bounded, so that a robot held by a wall does not spin when it comes free.
    lag = _clip(_wrap(heading + sw * dt_s - yaw), -0.18, 0.18)
    carry = (
        _CARRY_SHARE * sx + ix + 0.15 * error_x,
        _CARRY_SHARE * sy + iy + 0.15 * error_y,
        sw * 1.1 + 3.0 * lag + 0.1 * (sw - fw),
    )

    phase = (phase + dt_s / period_s) % 1.0
    # Where a swing foot lands relative to its home, without the part that the turning adds.
    half_stance_s, height_per_g = 0.5 * ratio * period_s, config.body_height_m / GRAVITY_MPS2
    step_x = sx * half_stance_s - error_x * half_stance_s + 0.06 * (vx - sx) - height_per_g * lx
    step_y = sy * half_stance_s - error_y * half_stance_s + 0.06 * (vy - sy) - height_per_g * ly
    feet, lifted, stance = _feet(config, feet, lifted, phase, period_s, ratio, height_m, carry, step_x, step_y, dt_s)
    still = not asked and sx == sy == sw == 0.0 and abs(fx) + abs(fy) < 0.08
    idle_s = idle_s + dt_s if still and abs(fw) < 0.3 and not restless else 0.0
    # Only after a whole quiet cycle, at the moment every foot is down, do the feet stay where they are.
    walking = not (idle_s > period_s and stance == _ALL_DOWN)
    drive_x = config.velocity_ns_per_m * (sx - vx) + TOTAL_MASS_KG * lx
    drive_y = config.velocity_ns_per_m * (sy - vy) + TOTAL_MASS_KG * ly
    return (
        GaitState(
            walking, phase, feet, lifted, (sx, sy, sw), (fx, fy, fw), (ex, ey), (ix, iy), (lx, ly), yaw + lag, idle_s
        ),
        GaitOutput(feet, _push(config, feet, stance, body, drive_x, drive_y)),
    )


def _stand(config: GaitConfig, state: GaitState, body: BodyMotion) -> tuple[GaitState, GaitOutput]:
    ground = FOOT_RADIUS_M - config.body_height_m
    feet = state.feet
    if any(foot[2] != ground for foot in feet):
        feet = tuple((x, y, ground) for x, y, _ in feet)
    state = GaitState(
        False, state.phase, feet, state.lifted, _ZERO3, _ZERO3, _ZERO2, state.integral, _ZERO2, body.yaw_rad,
        state.idle_s,
    )  # fmt: skip
    return state, GaitOutput(feet, _push(config, feet, _ALL_DOWN, body, 0.0, 0.0))


def _push(
    config: GaitConfig, feet: tuple[Vec3, ...], stance: tuple[bool, ...], body: BodyMotion,
    drive_x_n: float, drive_y_n: float,
) -> tuple[Vec3, ...]:  # fmt: skip
    """Share weight, attitude correction and the wanted horizontal force among the stance feet.

    Done in forces rather than in foot heights: a rate term in a position target would be differentiated once more by
    the joints' damping and make a standing robot shiver.
    """
    carrying, arms_x, arms_y = 0, 0.0, 0.0
    for foot, down in zip(feet, stance, strict=True):
        if down:
            x, y, _ = foot
            carrying += 1
            arms_x += x * x
            arms_y += y * y
    if carrying == 0:
        return (_ZERO3,) * len(feet)
    _, roll, pitch, roll_rate, pitch_rate, _, _, _ = body
    stiff, damp = config.attitude_nm_per_rad, config.attitude_nms_per_rad
    per_y = (-stiff * roll - damp * roll_rate) / arms_y
    per_x = (stiff * pitch + damp * pitch_rate) / arms_x
    weight = TOTAL_MASS_KG * GRAVITY_MPS2 / carrying
    most = 3.0 * weight
    back, right = -drive_x_n / carrying, -drive_y_n / carrying
    pushes = []
    for foot, down in zip(feet, stance, strict=True):
        if down:
            up = weight + per_y * foot[1] + per_x * foot[0]
            pushes.append((back, right, 0.0 if up < 0.0 else -most if up > most else -up))
        else:
            pushes.append(_ZERO3)
    return tuple(pushes)


def _feet(
    config: GaitConfig, feet: tuple[Vec3, ...], lifted: tuple[Vec3, ...], phase: float, period_s: float, ratio: float,
    height_m: float, carry: Vec3, step_x_m: float, step_y_m: float, dt_s: float,
) -> tuple[tuple[Vec3, ...], tuple[Vec3, ...], tuple[bool, ...]]:  # fmt: skip
    ground = FOOT_RADIUS_M - config.body_height_m
    height16 = 16.0 * height_m
    half_stance_s, swing_s = 0.5 * ratio * period_s, (1.0 - ratio) * period_s
    cx, cy, cw = carry
    new_feet, new_lifted, stances = [], [], []
    for leg, offset, home_x, home_y in config._legs:
        own = phase + offset
        if own >= 1.0:
            own -= 1.0
        stance = own < ratio
        if stance:
            x, y, _ = feet[leg]
            x, y = x - (cx - cw * y) * dt_s, y - (cy + cw * x) * dt_s
            x = _clip(x, home_x - _REACH_X_M, home_x + _REACH_X_M)
            y = _clip(y, home_y - _REACH_Y_M, home_y + _REACH_Y_M)
            foot = lift = (x, y, ground)
        else:
            lift = lifted[leg]
            u = (own - ratio) / (1.0 - ratio)
            rest = 1.0 - u
            turn_x, turn_y = cw * home_y, cw * home_x
            land_x = home_x + _clip(step_x_m - turn_x * half_stance_s, 0.01 - _REACH_X_M, _REACH_X_M - 0.01)
            land_y = home_y + _clip(step_y_m + turn_y * half_stance_s, 0.01 - _REACH_Y_M, _REACH_Y_M - 0.01)
            # A cubic that leaves and meets the ground at the ground's own speed: the foot does not slide.
            blend, match = u * u * (3.0 - 2.0 * u), u * rest * (1.0 - 2.0 * u) * swing_s
            foot = (
                lift[0] + (land_x - lift[0]) * blend - match * (cx - turn_x),
                lift[1] + (land_y - lift[1]) * blend - match * (cy + turn_y),
                ground + height16 * u * u * rest * rest,
            )
        new_feet.append(foot)
        new_lifted.append(lift)
        stances.append(stance)
    return tuple(new_feet), tuple(new_lifted), tuple(stances)
