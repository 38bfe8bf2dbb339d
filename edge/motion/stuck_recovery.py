"""Out of a wedge: a robot that is told to drive on and does not come on goes back the way that it has come.

A plan made from pictures does not feel the doorpost that the robot's side rests against, and the arc to a point ahead
never reverses. The poses that the robot has just been in are the only ones behind it that are known to be free: it goes
back through these, heading by heading, and no further. Pure: no clock, no thread, no I/O.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import hypot
from typing import Final

from edge.core.geometry import SE2, wrap_angle
from edge.motion.controller import VelocityCommand

BACKING_OFF: Final = "backing-off"
"""What a command gives as its reason meanwhile."""
OK: Final = "ok"
MAX_STEP_S: Final = 0.2
"""Of a tick that came late no more is counted."""
_TRAIL_M, _TRAIL_RAD = 0.05, 0.1  # between two poses of the trail
_TRAIL: Final = 60  # poses
_AT_M, _AT_RAD = 0.03, 0.1  # who has come no further, or turned no further, has not moved
_LOOK_BACK_M: Final = 0.15  # it turns to how it looked there
_VAIN_M: Final = 0.1  # who has not come so far back could not go back
_TURN_RAD: Final = 0.6  # before it goes back
_REACH_S: Final = 0.5  # in which it would have turned, but for the limits


@dataclass(frozen=True)
class BackOffConfig:
    """When and how far. `vx_min_mps` and `wz_max_radps` are the robot file's limits: where `vx_min_mps` is 0 the robot
    never reverses.
    """

    vx_min_mps: float
    wz_max_radps: float
    after_s: float = 2.0
    told_m: float = 0.3
    """So long it must have been told to drive on, and so far, before its not having come on is a wedge."""
    share: float = 0.25
    """Of what it was told; who has come further is not held by anything."""
    speed_mps: float = 0.2
    turn_radps: float = 0.5
    distance_m: float = 0.3
    at_most_s: float = 3.0
    stands_s: float = 1.0
    """A way back on which odometry sees nothing for so long is given up."""
    further: int = 3
    """Held at one place again it goes back twice as far, then so many times as far, and so on."""
    vain: int = 3
    """Tries at one place on which it could not go back either: then it is let be."""
    apart_m: float = 1.0
    """So far from where it first was held is another place."""

    def __post_init__(self) -> None:
        numbers = (
            self.after_s, self.told_m, self.share, self.speed_mps, self.turn_radps, self.distance_m, self.at_most_s,
            self.stands_s, self.further, self.vain, self.apart_m, self.wz_max_radps,
        )  # fmt: skip
        if self.vx_min_mps > 0 or min(numbers) <= 0 or self.share >= 1:
            raise ValueError(f"back-off: expected vx_min_mps of 0 or below, share below 1, all above 0, found {self}")


@dataclass
class _Told:
    """What it was told to drive since it was at a pose."""

    start: SE2
    for_s: float = 0.0
    far_m: float = 0.0


@dataclass
class _Back:
    """A way back under way; `times` as far as the first."""

    start: SE2
    since_ns: int
    times: int
    last: SE2
    moved_ns: int


class BackOff:
    """Watches whether the robot comes on when it is told to."""

    def __init__(self, config: BackOffConfig) -> None:
        self._config = config
        self._trail: deque[SE2] = deque(maxlen=_TRAIL)
        self._told: _Told | None = None
        self._back: _Back | None = None
        self._held_at: SE2 | None = None
        self._tries = self._in_vain = 0
        self._last_ns: int | None = None

    def step(
        self, wanted: VelocityCommand, T_odom_base: SE2 | None, now_ns: int, speed_scale: float = 1.0
    ) -> VelocityCommand:
        """`wanted`, or the way back in its place. Whatever forces zero, and a plan to stand, come first and end it."""
        elapsed_s = 0.0 if self._last_ns is None else min(max((now_ns - self._last_ns) / 1e9, 0.0), MAX_STEP_S)
        self._last_ns = now_ns
        scale = min(speed_scale, 1.0) if speed_scale > 0 else 0.0
        speed_mps = min(self._config.speed_mps, -self._config.vx_min_mps) * scale
        if T_odom_base is None or wanted.reason != OK or speed_mps <= 0:
            self._end(T_odom_base)
            return wanted
        if self._back is None:
            self._remember(T_odom_base)
            if not self._is_wedged(wanted, T_odom_base, elapsed_s):
                return wanted
            self._begin(T_odom_base, now_ns)
        command = self._way_back(wanted, T_odom_base, now_ns, speed_mps, scale)
        if command is None:
            self._end(T_odom_base)
            self._told = None
            return wanted
        return command

    def _remember(self, pose: SE2) -> None:
        if not self._trail or _gap(self._trail[-1], pose, _TRAIL_M, _TRAIL_RAD) >= 1.0:
            self._trail.append(pose)

    def _is_wedged(self, wanted: VelocityCommand, pose: SE2, elapsed_s: float) -> bool:
        config = self._config
        if self._held_at is not None and far_m(self._held_at, pose) > config.apart_m:
            self._held_at, self._tries, self._in_vain = None, 0, 0
        if wanted.vx_mps <= 0.0:
            return False
        if self._told is None:
            self._told = _Told(pose)
        told = self._told
        told.for_s += elapsed_s
        told.far_m += wanted.vx_mps * elapsed_s
        if told.for_s < config.after_s or told.far_m < config.told_m:
            return False
        self._told = _Told(pose)  # each stretch is judged by itself: who comes free is not held by what was before
        return far_m(told.start, pose) < config.share * told.far_m and self._in_vain < config.vain

    def _end(self, pose: SE2 | None) -> None:
        if self._back is not None:
            self._in_vain += pose is None or far_m(self._back.start, pose) < _VAIN_M
        self._back = None

    def _begin(self, pose: SE2, now_ns: int) -> None:
        self._tries += 1
        self._back = _Back(pose, now_ns, min(self._tries, self._config.further), pose, now_ns)
        self._held_at = self._held_at or pose

    def _way_back(
        self, wanted: VelocityCommand, pose: SE2, now_ns: int, speed_mps: float, scale: float
    ) -> VelocityCommand | None:
        """Towards the pose before, or None where the way back ends."""
        config, back = self._config, self._back
        if back is None or wanted.target is None or hypot(wanted.target.x_m, wanted.target.y_m) < _TRAIL_M:
            return None
        if _gap(back.last, pose, _AT_M, _AT_RAD) >= 1.0:
            back.last, back.moved_ns = pose, now_ns
        if (
            now_ns - back.moved_ns >= config.stands_s * 1e9
            or now_ns - back.since_ns >= back.times * config.at_most_s * 1e9
        ):
            return None
        while self._trail and _beyond_m(self._trail[-1], pose) < _AT_M:
            self._trail.pop()
        if not self._trail or far_m(back.start, pose) >= back.times * config.distance_m:
            return None
        turn_rad = wrap_angle(self._behind(pose).theta_rad - pose.theta_rad)
        most = min(config.turn_radps, config.wz_max_radps) * scale
        wz_radps = min(max(turn_rad / _REACH_S, -most), most)
        return VelocityCommand(
            -speed_mps if abs(turn_rad) < _TURN_RAD else 0.0, 0.0, wz_radps, wanted.target, BACKING_OFF
        )

    def _behind(self, pose: SE2) -> SE2:
        """The newest pose of the trail that is a look back away, or the oldest that there is."""
        return next((each for each in reversed(self._trail) if _beyond_m(each, pose) >= _LOOK_BACK_M), self._trail[0])


def _beyond_m(before: SE2, pose: SE2) -> float:
    """How far a pose lies ahead of another one, as that one looks."""
    return (before.inverse() @ pose).x_m


def far_m(a: SE2, b: SE2) -> float:
    """Metres from one pose to another."""
    return hypot(b.x_m - a.x_m, b.y_m - a.y_m)


def _gap(a: SE2, b: SE2, one_m: float, one_rad: float) -> float:
    """How far apart two poses are, in the larger of two units."""
    return max(far_m(a, b) / one_m, abs(wrap_angle(b.theta_rad - a.theta_rad)) / one_rad)
