"""The Go2's sport controller: sport actions and velocity commands -> joint torques; pure, no physics engine inside.

Mode numbers are those of SportModeState. A mode is reported when the robot has arrived in it; while it is still getting
up or lying down it reports the mode it left (recovery reports 8 until it stands). A request repeated while its motion
runs changes nothing: a client that repeats a call faster than the robot moves still gets it done.

What the trot can do without falling (measured: tools/bench/locomotion.py) is less than the real robot's range, and
commands are clipped to it: see GaitConfig.
"""

from __future__ import annotations

from enum import Enum
from math import cos, pi
from typing import NamedTuple

from sim_hil.robots.go2.gait import GRAVITY_MPS2, BodyMotion, GaitConfig, GaitState, start_gait, step_gait
from sim_hil.robots.go2.kinematics import Vec3, joint_angles, joint_torque
from sim_hil.robots.go2.urdf import LEG_GEOMETRY, TORQUE_LIMITS_NM, TOTAL_MASS_KG, VELOCITY_LIMITS_RADPS

MODE_BALANCE_STAND, MODE_LOCOMOTION, MODE_LIE_DOWN, MODE_JOINT_LOCK = 1, 3, 5, 6
MODE_DAMPING, MODE_RECOVERY_STAND = 7, 8
STANDING_MODES = frozenset((MODE_BALANCE_STAND, MODE_LOCOMOTION, MODE_JOINT_LOCK))
ERROR_NOT_STANDING = 4202  # the sport controller is not in a state that allows the action

# Ranges of the real Move request.
VX_RANGE_MPS, VY_RANGE_MPS, WZ_RANGE_RADPS = (-2.5, 3.8), (-1.0, 1.0), (-4.0, 4.0)
HOLD_S = 1.0  # firmware from V1.1.6 keeps the latest Move for one second
_BALANCED = (MODE_BALANCE_STAND, MODE_LOCOMOTION)
_STOPPING_S = 4.0  # a robot held or pushed may never come to rest: then the awaited motion starts all the same
# Proportional and damping gain, N.m/rad and N.m.s/rad.
_WALK_GAINS, _HOLD_GAINS, _LIE_GAINS, _LIMP_DAMPING = (70.0, 2.0), (90.0, 2.5), (25.0, 2.0), 2.0
# Damping that acts a step late overshoots the more, the longer the step: what a joint bears falls with the rate.
# Without the rotor's inertia a swinging calf is so light that it bears less.
_DAMPING_PER_HZ, _CALF_DAMPING_PER_HZ = 0.005, 0.0024
_CALF_DAMPING_SHARE = 0.6
_FADE_SHARE = 0.2  # our choice: over the last fifth of its speed range a motor's driving torque falls to zero

LYING_RAD = (-0.25, 1.32, -2.70, 0.25, 1.32, -2.70, -0.25, 1.32, -2.70, 0.25, 1.32, -2.70)
_NO_FORCE: Vec3 = (0.0, 0.0, 0.0)
_NO_PUSH: tuple[Vec3, ...] = (_NO_FORCE,) * 4
_WEIGHT: tuple[Vec3, ...] = ((0.0, 0.0, -TOTAL_MASS_KG * GRAVITY_MPS2 / 4),) * 4

# Self-righting from the back, found by search in simulation. The right legs reach over to the floor beside the trunk
# and push it onto its left side; the left hips, spread, carry it on to the belly. (seconds, right leg, left leg)
_RIGHTING: tuple[tuple[float, Vec3, Vec3], ...] = (
    (0.6, (-0.9, 3.1, -2.7), (1.0, 1.3, -2.7)),
    (0.2, (-0.9, 3.1, -2.7), (1.0, 1.3, -2.7)),
    (0.3, (-0.9, 3.1, -0.9), (1.0, 1.3, -2.7)),
    (0.2, (-0.9, 3.1, -0.9), (1.0, 1.3, -2.7)),
    (0.4, (0.0, 1.3, -2.7), (1.0, 1.3, -2.0)),
    (0.2, (0.0, 1.3, -2.7), (1.0, 1.3, -2.0)),
    (0.5, (0.0, 1.3, -2.7), (0.0, 1.3, -2.7)),
    (0.3, (0.0, 1.3, -2.7), (0.0, 1.3, -2.7)),
)
_RIGHTING_ATTEMPTS = 4


# Per joint: its angle's limits, its torque limit, the speed from which its driving torque fades, whether it is a calf.
_JOINTS = tuple(
    (*leg.limits_rad[joint], TORQUE_LIMITS_NM[joint], (1.0 - _FADE_SHARE) * VELOCITY_LIMITS_RADPS[joint], joint)
    for leg in LEG_GEOMETRY
    for joint in range(3)
)


class SportAction(Enum):
    """Requests of the sport service that change the robot's motion."""

    DAMP = "Damp"
    BALANCE_STAND = "BalanceStand"
    STOP_MOVE = "StopMove"
    STAND_UP = "StandUp"
    STAND_DOWN = "StandDown"
    RECOVERY_STAND = "RecoveryStand"


class Measured(NamedTuple):
    """Inputs of one controller step: joints (FR, FL, RR, RL x hip, thigh, calf) and the body."""

    q_rad: tuple[float, ...]
    dq_radps: tuple[float, ...]
    body: BodyMotion
    up: float  # world z of the base's up axis: 1 upright, -1 on its back


class _Motion(NamedTuple):
    """A scripted motion: joint targets reached one after the other, then a mode."""

    keyframes: tuple[tuple[float, tuple[float, ...]], ...]  # (seconds to get there, joint angles)
    mode: int


def _clip(value: float, low: float, high: float) -> float:
    return low if value < low else high if value > high else value


def motor_torque(joint: int, wanted_nm: float, speed_radps: float) -> float:
    """Return the torque that the motor of hip, thigh or calf (0, 1, 2) reaches at a speed, N.m.

    Braking is bounded by the torque limit alone; driving fades to zero towards the velocity limit.
    """
    limit = TORQUE_LIMITS_NM[joint]
    if wanted_nm * speed_radps > 0.0:
        spare = 1.0 - abs(speed_radps) / VELOCITY_LIMITS_RADPS[joint]
        if spare < _FADE_SHARE:
            limit *= max(spare, 0.0) / _FADE_SHARE
    return _clip(wanted_nm, -limit, limit)


class SportController:
    """The mode machine and its torques. Deterministic; call `step` once every dt_s."""

    def __init__(self, dt_s: float) -> None:
        self._dt_s, self._inverse_dt = dt_s, 1.0 / dt_s
        self._config = GaitConfig()
        self.mode = MODE_LIE_DOWN  # SportModeState.mode
        self._time_s = 0.0
        self._motion: _Motion | None = None
        self._awaited: _Motion | None = None  # starts as soon as the trot has come to rest
        self._motion_start_s = 0.0
        self._motion_from: tuple[float, ...] = LYING_RAD
        self._gait: GaitState = start_gait(self._config, 0.0)
        self._command: Vec3 = (0.0, 0.0, 0.0)
        self._command_s = -HOLD_S
        self._targets: tuple[float, ...] = LYING_RAD
        self._latest: Measured | None = None
        self._attempts = 0

    @property
    def trotting(self) -> bool:
        """Whether the legs are stepping, or about to: a standing robot that is pushed over steps too."""
        return self._motion is None and self._gait.walking and self.mode in _BALANCED

    @property
    def gait_type(self) -> int:
        """SportModeState.gait_type: 1 while trotting, else 0."""
        return 1 if self.mode == MODE_LOCOMOTION else 0

    @property
    def commanded(self) -> Vec3:
        """The velocity command in force, (vx m/s, vy m/s, wz rad/s): zero unless the robot may move."""
        expired = self._time_s - self._command_s >= HOLD_S - 1e-9
        if expired or not self.ready:
            return (0.0, 0.0, 0.0)
        return self._command

    @property
    def ready(self) -> bool:
        """Whether the robot would follow a velocity: it stands balanced, and no motion runs or is awaited."""
        return self.mode in _BALANCED and self._bound_for is None

    @property
    def _bound_for(self) -> int | None:
        """The mode that a motion, running or awaited, ends in."""
        motion = self._motion if self._motion is not None else self._awaited
        return None if motion is None else motion.mode

    def request_move(self, vx_mps: float, vy_mps: float, wz_radps: float) -> None:
        """Command a velocity for one second, clipped to the robot's range; ignored unless the robot stands balanced."""
        if not self.ready:
            return
        self._command = (
            _clip(vx_mps, *VX_RANGE_MPS),
            _clip(vy_mps, *VY_RANGE_MPS),
            _clip(wz_radps, *WZ_RANGE_RADPS),
        )
        self._command_s = self._time_s

    def request(self, action: SportAction) -> int:
        """Start an action; return 0, or 4202 where the robot's posture does not allow it."""
        bound_for = self._bound_for
        arrived = self.mode if bound_for is None else None
        if action is SportAction.DAMP:
            self._go_limp()
        elif action is SportAction.STOP_MOVE:
            self._forget_command()
        elif action is SportAction.BALANCE_STAND:
            if arrived not in STANDING_MODES:
                return ERROR_NOT_STANDING
            if arrived == MODE_JOINT_LOCK:
                self._enter_balance()
        elif action is SportAction.STAND_UP:
            if MODE_JOINT_LOCK not in (arrived, bound_for):
                self._start(((0.4, self._folded()), (1.2, self._standing())), MODE_JOINT_LOCK)
        elif action is SportAction.STAND_DOWN:
            if MODE_LIE_DOWN not in (arrived, bound_for):
                self._start(((1.5, LYING_RAD),), MODE_LIE_DOWN)
        elif action is SportAction.RECOVERY_STAND:
            recovering = bound_for in (MODE_BALANCE_STAND, MODE_RECOVERY_STAND)
            if arrived not in _BALANCED and not recovering:
                self.mode, self._attempts = MODE_RECOVERY_STAND, 0
                self._recover()
        return 0

    def _recover(self) -> None:
        """Stand up, or turn over first; a robot that cannot turn over goes limp after a few attempts."""
        if self._latest is None or self._latest.up > 0.7:
            self._start(((0.8, LYING_RAD), (1.2, self._standing())), MODE_BALANCE_STAND)
        elif self._attempts < _RIGHTING_ATTEMPTS:
            self._attempts += 1
            frames = tuple((seconds, right + left + right + left) for seconds, right, left in _RIGHTING)
            self._start(frames, MODE_RECOVERY_STAND)
        else:
            self._go_limp()

    def _go_limp(self) -> None:
        self._forget_command()
        self._motion, self._awaited, self.mode = None, None, MODE_DAMPING

    def _forget_command(self) -> None:
        self._command, self._command_s = (0.0, 0.0, 0.0), -HOLD_S

    def _standing(self) -> tuple[float, ...]:
        feet = start_gait(self._config, 0.0).feet
        return tuple(angle for leg, foot in enumerate(feet) for angle in joint_angles(leg, foot))

    def _folded(self) -> tuple[float, ...]:
        # A robot that already stands goes straight up or stays; only a collapsed one folds its legs first.
        if self.mode in _BALANCED:
            return self._standing()
        return LYING_RAD

    def _start(self, keyframes: tuple[tuple[float, tuple[float, ...]], ...], mode: int) -> None:
        self._forget_command()
        self._motion_start_s = self._time_s
        if self.mode in _BALANCED and self._motion is None and self._gait.walking:
            # A trot at speed that is broken off topples the robot: it comes to rest first.
            self._awaited = _Motion(keyframes, mode)
        else:
            self._begin(_Motion(keyframes, mode))

    def _begin(self, motion: _Motion) -> None:
        self._motion, self._awaited = motion, None
        self._motion_start_s = self._time_s
        self._motion_from = self._latest.q_rad if self._latest is not None else LYING_RAD

    def _enter_balance(self) -> None:
        self.mode = MODE_BALANCE_STAND
        yaw = self._latest.body.yaw_rad if self._latest is not None else 0.0
        self._gait = start_gait(self._config, yaw)

    def step(self, measured: Measured) -> tuple[float, ...]:
        """Advance by dt_s; return the 12 joint torques, N.m, within the motors' limits."""
        self._latest = measured
        fallen = measured.up < 0.5 and self.mode in STANDING_MODES
        if fallen:
            # A robot that has lost its balance goes limp, as the real one does: flailing breaks it.
            self._go_limp()
        stopped = not self._gait.walking or self._time_s - self._motion_start_s >= _STOPPING_S
        if self._awaited is not None and stopped:
            self._begin(self._awaited)
        if self._motion is not None:
            torques = self._scripted(measured)
        elif self.mode == MODE_DAMPING:
            self._targets = measured.q_rad
            damping = min(_LIMP_DAMPING, _DAMPING_PER_HZ * self._inverse_dt)
            torques = tuple(motor_torque(i % 3, -damping * dq, dq) for i, dq in enumerate(measured.dq_radps))
        elif self.mode in _BALANCED:
            torques = self._walk(measured)
        elif self.mode == MODE_JOINT_LOCK:
            torques = self._track(measured, self._targets, _HOLD_GAINS, _WEIGHT)
        else:
            torques = self._track(measured, LYING_RAD, _LIE_GAINS, _NO_PUSH)
        self._time_s += self._dt_s
        return torques

    def _walk(self, measured: Measured) -> tuple[float, ...]:
        command = self.commanded
        self._gait, output = step_gait(self._config, self._gait, command, measured.body, self._dt_s)
        self.mode = MODE_LOCOMOTION if command != (0.0, 0.0, 0.0) else MODE_BALANCE_STAND
        f0, f1, f2, f3 = output.feet
        targets = (*joint_angles(0, f0), *joint_angles(1, f1), *joint_angles(2, f2), *joint_angles(3, f3))
        gains = _WALK_GAINS if self._gait.walking else _HOLD_GAINS
        return self._track(measured, targets, gains, output.push)

    def _scripted(self, measured: Measured) -> tuple[float, ...]:
        motion = self._motion
        assert motion is not None
        elapsed = self._time_s - self._motion_start_s
        begin = self._motion_from
        for duration, end in motion.keyframes:
            if elapsed < duration:
                blend = 0.5 * (1.0 - cos(pi * elapsed / duration))
                targets = tuple(a + (b - a) * blend for a, b in zip(begin, end, strict=True))
                return self._track(measured, targets, _HOLD_GAINS, _NO_PUSH)
            elapsed, begin = elapsed - duration, end
        self._motion = None
        self._targets = begin
        self.mode = motion.mode
        if motion.mode == MODE_BALANCE_STAND:
            self._enter_balance()
        elif motion.mode == MODE_RECOVERY_STAND:
            self._recover()
        return self._track(measured, begin, _HOLD_GAINS, _NO_PUSH)

    def _track(
        self, measured: Measured, targets: tuple[float, ...], gains: tuple[float, float], push: tuple[Vec3, ...]
    ) -> tuple[float, ...]:
        """PD on the joints plus the torque of each foot's push on the ground (without it the knees sag)."""
        stiffness, damping = gains
        inverse_dt = self._inverse_dt
        calf_damping = min(_CALF_DAMPING_SHARE * damping, _CALF_DAMPING_PER_HZ * inverse_dt)
        damping = min(damping, _DAMPING_PER_HZ * inverse_dt)
        angles, speeds = measured.q_rad, measured.dq_radps
        carry: list[float] = []
        for leg, force in enumerate(push):
            hip, thigh, calf = angles[3 * leg : 3 * leg + 3]
            carry += _NO_FORCE if force == _NO_FORCE else joint_torque(leg, (hip, thigh, calf), force)
        torques = []
        for target, previous, q, dq, extra, (lower, upper, limit, fading, joint) in zip(
            targets, self._targets, angles, speeds, carry, _JOINTS, strict=True
        ):
            # Swing targets move fast: the damping term must not fight the motion it is asked for.
            rate = (target - previous) * inverse_dt
            rate = -15.0 if rate < -15.0 else 15.0 if rate > 15.0 else rate
            wanted = lower if target < lower else upper if target > upper else target
            torque = stiffness * (wanted - q) + (calf_damping if joint == 2 else damping) * (rate - dq) + extra
            if not (-limit < torque < limit and -fading < dq < fading):
                torque = motor_torque(joint, torque, dq)
            torques.append(torque)
        self._targets = targets
        return tuple(torques)
