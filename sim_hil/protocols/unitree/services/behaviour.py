"""Behaviour of a Go2 under the maker's services: sport actions, postures, shows and low-level mode.

It replaces the sport controller in the robot (`Go2.sport`) and delegates to it. It drives the joints itself while the
robot sits, poses, dances or is in low-level mode.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from math import cos, pi
from typing import Any, Final

from sim_hil.protocols.unitree.services.low_level import LowLevel
from sim_hil.protocols.unitree.services.postures import Joints, Keyframe, Script, attitude
from sim_hil.robots.go2.gait import GRAVITY_MPS2
from sim_hil.robots.go2.kinematics import Vec3, joint_torque
from sim_hil.robots.go2.sport import (
    ERROR_NOT_STANDING,
    MODE_BALANCE_STAND,
    MODE_DAMPING,
    MODE_LOCOMOTION,
    STANDING_MODES,
    Measured,
    SportAction,
    SportController,
    motor_torque,
)
from sim_hil.robots.go2.urdf import TOTAL_MASS_KG

MODE_IDLE: Final = 0  # sport controller released
GAIT_TROT: Final = 1
GAIT_RUN: Final = 2
_STILL_RADPS: Final = 0.5
_STILL_S: Final = 0.25
_PATIENCE_S: Final = 4.0  # longest wait for standing still, s: a robot that is pushed may never stand still
_AUTO_RECOVERY_S: Final = 2.0  # our choice: time on the ground before the robot stands up by itself
_WEIGHT: Final[Vec3] = (0.0, 0.0, -TOTAL_MASS_KG * GRAVITY_MPS2 / 4)
_KP, _KD = 90.0, 2.5  # joint gains of the sport controller's stand
_RETURN_S: Final = 0.6


@dataclass(frozen=True)
class Gait:
    """Gait of the sport service: reported number and top speed."""

    gait_type: int = GAIT_TROT
    top_mps: float = math.inf


# All gaits use the one simulated trot; slow gaits limit its speed. The limits are our choice.
GAITS: Final = {
    "ClassicWalk": Gait(),
    "FreeWalk": Gait(),
    "StaticWalk": Gait(top_mps=0.3),
    "EconomicGait": Gait(top_mps=0.6),
    "TrotRun": Gait(GAIT_RUN),
}
SPEED_SHARE: Final = {-1: 0.5, 0: 1.0, 1: 1.0}  # SpeedLevel: slow, normal, fast; the trot has no fast level


class Go2Behaviour:
    """Replacement of `SportController` in a Go2; call `step` every `dt_s`. Deterministic, without physics."""

    def __init__(self, sport: SportController, dt_s: float) -> None:
        self.low_level = LowLevel()
        self.auto_recovery = False
        self.gait = GAITS["ClassicWalk"]
        self.speed_level = 0
        self._sport = sport
        self._dt_s = dt_s
        self._time_s = 0.0
        self._released = False
        self._script: Script | None = None
        self._awaited: Script | None = None  # begins when the robot stands still
        self._since_s = 0.0  # when the script began, or the wait for it
        self._still_s = 0.0
        self._from: Joints = ()
        self._home: Joints = ()  # how it stood before the script
        self._targets: Joints = ()
        self._afterwards: Callable[[], int] | None = None
        self._fell_s: float | None = None

    def __getattr__(self, name: str) -> Any:
        """Delegate everything that postures do not change to the sport controller."""
        return getattr(self._sport, name)

    @property
    def time_s(self) -> float:
        """Simulated time since switch-on, s."""
        return self._time_s

    @property
    def mode(self) -> int:
        """Value of SportModeState.mode."""
        if self._released:
            return MODE_IDLE
        return self._sport.mode if self._script is None else self._script.mode

    @property
    def gait_type(self) -> int:
        """Value of SportModeState.gait_type: the gait while walking, else 0."""
        return self.gait.gait_type if self.mode == MODE_LOCOMOTION else 0

    @property
    def progress(self) -> float:
        """Value of SportModeState.progress: 1 during a show, else 0."""
        return 1.0 if self._script is not None and not self._script.stays and self._afterwards is None else 0.0

    @property
    def released(self) -> bool:
        """Whether the sport controller is off and low commands drive the joints."""
        return self._released

    @property
    def commanded(self) -> Vec3:
        """Velocity command in force; zero unless the robot walks or stands."""
        return (0.0, 0.0, 0.0) if self._busy or self._released else self._sport.commanded

    @property
    def ready(self) -> bool:
        """Whether the robot would obey a velocity now."""
        return not (self._busy or self._released) and self._sport.ready

    @property
    def _busy(self) -> bool:
        return self._script is not None or self._awaited is not None

    def request_move(self, vx_mps: float, vy_mps: float, wz_radps: float) -> None:
        """Request a velocity; ignored in a posture, and in a turned attitude it only ends the attitude."""
        if self._released:
            return
        moves = any((vx_mps, vy_mps, wz_radps))
        if self._script is not None and self._script.mode == MODE_BALANCE_STAND and moves:
            self._stand_again()  # not stored until the robot stands level: a velocity is valid for 1 s only
            return
        if self._busy:
            return
        top_mps = self.gait.top_mps
        share, speed_mps = SPEED_SHARE[self.speed_level], math.hypot(vx_mps, vy_mps)
        if speed_mps * share > top_mps:
            share = top_mps / speed_mps
        self._sport.request_move(share * vx_mps, share * vy_mps, wz_radps)

    def request(self, action: SportAction) -> int:
        """Start an action; return 0 or an error code: 4202 if the posture or the released mode forbids it."""
        if self._released:
            return ERROR_NOT_STANDING
        if action is SportAction.DAMP:
            self._drop()
            return self._sport.request(action)
        if action is SportAction.STOP_MOVE:
            # It also resets speed level and gait (the maker's page of the sport service).
            self.speed_level, self.gait = 0, GAITS["ClassicWalk"]
            if self._script is not None and self._script.mode == MODE_BALANCE_STAND:
                self._stand_again()
            return self._sport.request(action)
        if not self._busy:
            return self._sport.request(action)
        then = None if action is SportAction.BALANCE_STAND else action
        self._stand_again(None if then is None else lambda: self._sport.request(then))
        return 0

    def show(self, script: Script) -> int:
        """Start a posture or a show from a stand; return 0, or 4202 if the robot does not stand balanced."""
        if self._released or self._sport.mode not in (MODE_BALANCE_STAND, MODE_LOCOMOTION):
            return ERROR_NOT_STANDING
        if self._script is not None:
            if not self._script.stays:
                return ERROR_NOT_STANDING  # one show at a time
            self._begin(script)
        else:
            self._sport.request(SportAction.STOP_MOVE)
            self._awaited, self._since_s, self._still_s = script, self._time_s, 0.0
        return 0

    def turn_body(self, roll_rad: float, pitch_rad: float, yaw_rad: float) -> int:
        """Execute the Euler request: turn the body over its feet; three zeros end it."""
        if self._script is not None and self._script.mode == MODE_BALANCE_STAND and not any(
            (roll_rad, pitch_rad, yaw_rad)
        ):  # fmt: skip
            self._stand_again()
            return 0
        posed = self.mode  # turning does not change the mode of a pose
        script = attitude(roll_rad, pitch_rad, yaw_rad)
        return self.show(script._replace(mode=posed) if self._script is not None else script)

    def stand_again(self) -> None:
        """End a posture or a show, if there is one."""
        if self._busy:
            self._stand_again()

    def release(self) -> None:
        """Switch the sport controller off, so that low commands drive the joints."""
        self._drop()
        self._sport.request(SportAction.DAMP)
        self.low_level.forget()
        self._released = True

    def engage(self) -> None:
        """Switch the sport controller on; the joints are damped until a stand-up request."""
        self._released = False

    def step(self, measured: Measured) -> tuple[float, ...]:
        """Advance by `dt_s` and return the 12 joint torques, N.m."""
        self._time_s += self._dt_s
        if self._released:
            return self.low_level.torques(measured, self._time_s)
        if self._script is not None and measured.up < 0.5:
            self._drop()
            self._sport.request(SportAction.DAMP)
        if self._script is not None:
            return self._play(measured)
        before = self._sport.mode
        torques = self._sport.step(measured)
        if self._awaited is not None:
            self._await_stillness(measured)
        self._get_up(before, measured)
        return torques

    def _get_up(self, before: int, measured: Measured) -> None:
        if before in STANDING_MODES and self._sport.mode == MODE_DAMPING and measured.up < 0.5:
            self._fell_s = self._time_s
        if self._fell_s is None:
            return
        if self._sport.mode != MODE_DAMPING:
            self._fell_s = None
        elif self.auto_recovery and self._time_s - self._fell_s >= _AUTO_RECOVERY_S:
            self._fell_s = None
            self._sport.request(SportAction.RECOVERY_STAND)

    def _await_stillness(self, measured: Measured) -> None:
        moving = max(map(abs, measured.dq_radps)) > _STILL_RADPS
        self._still_s = 0.0 if moving else self._still_s + self._dt_s
        script = self._awaited
        assert script is not None
        if self._sport.mode not in (MODE_BALANCE_STAND, MODE_LOCOMOTION):
            self._awaited = None
        elif self._still_s >= _STILL_S or self._time_s - self._since_s >= _PATIENCE_S:
            self._awaited = None
            self._home = self._targets = measured.q_rad
            self._begin(script)

    def _begin(self, script: Script) -> None:
        self._script, self._since_s, self._from = script, self._time_s, self._targets
        self._afterwards = None

    def _stand_again(self, afterwards: Callable[[], int] | None = None) -> None:
        if self._script is None:
            self._awaited = None
            if afterwards is not None:
                afterwards()
            return
        if self._afterwards is not None:  # already returning to the stand: a repeated request does not restart it
            self._afterwards = afterwards if afterwards is not None else self._afterwards
            return
        back: tuple[Keyframe, ...] = ((_RETURN_S, self._home),)
        self._begin(self._script._replace(keyframes=back, stays=False))
        self._afterwards = afterwards if afterwards is not None else lambda: 0

    def _drop(self) -> None:
        self._script = self._awaited = self._afterwards = None

    def _play(self, measured: Measured) -> tuple[float, ...]:
        script = self._script
        assert script is not None
        elapsed, begin = self._time_s - self._since_s, self._from
        for seconds, end in script.keyframes:
            if elapsed < seconds:
                blend = 0.5 * (1.0 - cos(pi * elapsed / seconds))
                return self._track(measured, tuple(a + (b - a) * blend for a, b in zip(begin, end, strict=True)))
            elapsed, begin = elapsed - seconds, end
        if not script.stays:
            then = self._afterwards
            self._drop()
            if then is not None:
                then()
        return self._track(measured, begin)

    def _track(self, measured: Measured, targets: Joints) -> tuple[float, ...]:
        before, self._targets = self._targets, targets
        torques = []
        for leg in range(4):
            base = 3 * leg
            q = measured.q_rad[base : base + 3]
            carry = joint_torque(leg, (q[0], q[1], q[2]), _WEIGHT)
            for joint in range(3):
                i = base + joint
                rate = (targets[i] - before[i]) / self._dt_s
                wanted = _KP * (targets[i] - q[joint]) + _KD * (rate - measured.dq_radps[i]) + carry[joint]
                torques.append(motor_torque(joint, wanted, measured.dq_radps[i]))
        return tuple(torques)
