"""All that the maker's services can make a Go2 do: the sport controller's actions, postures and shows, low level.

It takes the sport controller's place in the robot (`Go2.sport`), hands through what the controller knows, and drives
the joints itself while the robot sits, poses, dances or is in low-level mode.
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

MODE_IDLE: Final = 0  # nothing of the sport controller's: released
GAIT_TROT: Final = 1
GAIT_RUN: Final = 2
_STILL_RADPS: Final = 0.5
_STILL_S: Final = 0.25
_PATIENCE_S: Final = 4.0  # a robot that is held or pushed may never stand still
_AUTO_RECOVERY_S: Final = 2.0  # our choice: how long it lies before it gets up by itself
_WEIGHT: Final[Vec3] = (0.0, 0.0, -TOTAL_MASS_KG * GRAVITY_MPS2 / 4)
_KP, _KD = 90.0, 2.5  # what the sport controller stands with
_RETURN_S: Final = 0.6


@dataclass(frozen=True)
class Gait:
    """A gait of the sport service: the number that is reported while it walks, and how fast it walks at most."""

    gait_type: int = GAIT_TROT
    top_mps: float = math.inf


# All are the one trot that is simulated; a slow gait is its slow part. Limits are our choice.
GAITS: Final = {
    "ClassicWalk": Gait(),
    "FreeWalk": Gait(),
    "StaticWalk": Gait(top_mps=0.3),
    "EconomicGait": Gait(top_mps=0.6),
    "TrotRun": Gait(GAIT_RUN),
}
SPEED_SHARE: Final = {-1: 0.5, 0: 1.0, 1: 1.0}  # SpeedLevel: slow, normal, fast; the trot has no faster than normal


class Go2Behaviour:
    """Stands in for `SportController` in a Go2; call `step` once every `dt_s`. Deterministic, no physics inside."""

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
        """What a posture changes nothing about is the sport controller's to answer."""
        return getattr(self._sport, name)

    @property
    def time_s(self) -> float:
        """Simulated time since it was switched on, s."""
        return self._time_s

    @property
    def mode(self) -> int:
        """SportModeState.mode."""
        if self._released:
            return MODE_IDLE
        return self._sport.mode if self._script is None else self._script.mode

    @property
    def gait_type(self) -> int:
        """SportModeState.gait_type: the gait while it walks, else 0."""
        return self.gait.gait_type if self.mode == MODE_LOCOMOTION else 0

    @property
    def progress(self) -> float:
        """SportModeState.progress: 1 while a show runs, else 0."""
        return 1.0 if self._script is not None and not self._script.stays and self._afterwards is None else 0.0

    @property
    def released(self) -> bool:
        """Whether the sport controller is off and low commands drive the joints."""
        return self._released

    @property
    def commanded(self) -> Vec3:
        """The velocity command in force: zero while anything but walking goes on."""
        return (0.0, 0.0, 0.0) if self._busy or self._released else self._sport.commanded

    @property
    def ready(self) -> bool:
        """Whether a velocity would be obeyed now."""
        return not (self._busy or self._released) and self._sport.ready

    @property
    def _busy(self) -> bool:
        return self._script is not None or self._awaited is not None

    def request_move(self, vx_mps: float, vy_mps: float, wz_radps: float) -> None:
        """Take a velocity, as the controller does; in a posture it is not obeyed, a turned attitude it only ends."""
        if self._released:
            return
        moves = any((vx_mps, vy_mps, wz_radps))
        if self._script is not None and self._script.mode == MODE_BALANCE_STAND and moves:
            self._stand_again()  # kept until it stands level, a velocity would be in force for longer than its second
            return
        if self._busy:
            return
        top_mps = self.gait.top_mps
        share, speed_mps = SPEED_SHARE[self.speed_level], math.hypot(vx_mps, vy_mps)
        if speed_mps * share > top_mps:
            share = top_mps / speed_mps
        self._sport.request_move(share * vx_mps, share * vy_mps, wz_radps)

    def request(self, action: SportAction) -> int:
        """Start an action; 0 or the code of its refusal: 4202 where the posture, or the released mode, forbids it."""
        if self._released:
            return ERROR_NOT_STANDING
        if action is SportAction.DAMP:
            self._drop()
            return self._sport.request(action)
        if action is SportAction.STOP_MOVE:
            # It also sets back what the requests before it have set (the maker's page of the sport service).
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
        """Take a posture or begin a show, from a stand; 0, or 4202 where it does not stand balanced."""
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
        """The Euler request: turn the body over its feet; all zero ends it."""
        if self._script is not None and self._script.mode == MODE_BALANCE_STAND and not any(
            (roll_rad, pitch_rad, yaw_rad)
        ):  # fmt: skip
            self._stand_again()
            return 0
        posed = self.mode  # a pose stays a pose, however it is turned
        script = attitude(roll_rad, pitch_rad, yaw_rad)
        return self.show(script._replace(mode=posed) if self._script is not None else script)

    def stand_again(self) -> None:
        """End a posture or a show; without one there is nothing to do."""
        if self._busy:
            self._stand_again()

    def release(self) -> None:
        """Switch the sport controller off: from now on low commands drive the joints."""
        self._drop()
        self._sport.request(SportAction.DAMP)
        self.low_level.forget()
        self._released = True

    def engage(self) -> None:
        """Switch the sport controller on again: limp, until it is asked to stand up."""
        self._released = False

    def step(self, measured: Measured) -> tuple[float, ...]:
        """Advance by `dt_s`; the 12 joint torques, N.m."""
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
        if self._afterwards is not None:  # it is on its way: a request that is repeated does not begin anew
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
