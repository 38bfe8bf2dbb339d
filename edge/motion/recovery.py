"""Recoveries: commands that replace the plan's when it makes no progress (ours).

* Back off: the robot is commanded forward and does not move, or was just stopped because its pose stayed. It drives
  back along its own trail of the last 30 s, the only space behind it that is proved free. The plan cannot do so: it
  does not sense contact, and its arc never reverses.
* Turn at a standstill: the plan has stood for long although the text's waypoints lead on. The robot turns on the spot
  towards them, so that the next picture differs.
* Stand at the goal: once past the goal the robot no longer sees it, and the text becomes unreliable. Texts that see the
  goal nearby place a stop (`edge.reasoning.instruction_state`), and the robot stands there until later texts move or
  drop it.

`--recovery off` switches all of them off, `--no-stay` the last one. All is pure: no clock, no thread, no I/O.
"""

from __future__ import annotations

import itertools
from collections import deque
from dataclasses import dataclass
from math import atan2, copysign, hypot, pi
from typing import Final

import numpy as np
import numpy.typing as npt

from edge.core.geometry import SE2, wrap_angle
from edge.motion.controller import TARGET_TIME_S, VelocityCommand, arc_to
from edge.motion.turn_on_the_spot import TOLD
from edge.state.switches import RecoverySwitch, Switches
from firmware_bridge.core.config import LimitsConfig

OK: Final = "ok"
BACKING_OFF: Final = "backing-off"
TURNING: Final = "turning-to-waypoints"
ARRIVED: Final = "arrived"
"""Reason of a command: the plan's own, or a recovery's."""
MOVING: Final = frozenset((BACKING_OFF, TURNING, TOLD))
"""Reasons of what moves the robot in the plan's place."""
HELD: Final = frozenset(("odometry-frozen", "robot-blocked"))
"""Reasons of a stop after which the robot backs off: its pose stayed although it was commanded to move."""

MAX_STEP_S: Final = 0.2
"""Largest duration counted for one late tick, s."""
_TRAIL_M, _TRAIL_RAD = 0.05, 0.1  # spacing of the trail's poses
_TRAIL_POSES: Final = 60
_TRAIL_NS: Final = 30_000_000_000  # an older pose does not prove that its place is still free
_STILL_M, _STILL_RAD = 0.03, 0.1  # less motion than this counts as none
_LOOK_BACK_M: Final = 0.15  # distance of the trail's pose whose heading is taken up
_FAILED_M: Final = 0.1  # backing off by less than this counts as failed
_HELD_NS: Final = 10_000_000_000  # longest time after a stop of HELD: later a pose that stays is a first time again
_TURN_FIRST_RAD: Final = 0.6  # above this the robot turns before it drives back
_REACH_S: Final = 0.5  # time in which the heading is corrected, within the limits

PASSED_M: Final = 4.0
"""Largest distance past the stop at which the robot has still arrived, m."""
SHORT_M: Final = 0.5
"""Distance before the stop from which the robot has arrived, m; odometry and text are no more exact."""
ASIDE_M: Final = 1.5
"""Largest lateral distance from the stop at which the robot has arrived, m."""


@dataclass(frozen=True)
class BackOffConfig:
    """Thresholds and speeds of the back-off; with the robot file's `vx_min_mps` of 0 the robot never reverses."""

    vx_min_mps: float
    wz_max_radps: float
    after_s: float = 2.0
    commanded_m: float = 0.3
    """Commanded forward this long and this far without progress, the robot counts as stuck."""
    share: float = 0.25
    """Progress is at least this share of the commanded distance."""
    speed_mps: float = 0.2
    turn_radps: float = 0.5
    distance_m: float = 0.3
    at_most_s: float = 3.0
    stands_s: float = 1.0
    """Time without motion after which the robot stops backing off, s."""
    further: int = 3
    """Largest multiple of the distance: stuck again at one place, it backs off twice as far, then three times."""
    failures: int = 3
    """Number of failures at one place after which the robot no longer backs off there."""
    apart_m: float = 1.0
    """Distance from the first stuck pose at which another place begins."""

    def __post_init__(self) -> None:
        positive = (value for name, value in vars(self).items() if name != "vx_min_mps")
        if self.vx_min_mps > 0 or min(positive) <= 0 or self.share >= 1:
            raise ValueError(f"back-off: expected vx_min_mps of 0 or below, share below 1, all above 0, found {self}")


@dataclass
class _Commanded:
    """Accumulated forward command since a pose."""

    start: SE2
    for_s: float = 0.0
    distance_m: float = 0.0


@dataclass
class _Retreat:
    """Drive back in progress, `times` as far as the first one at the same place."""

    start: SE2
    since_ns: int
    times: int
    last: SE2
    moved_ns: int


class BackOff:
    """Back-off recovery: detects a stuck robot and drives it back."""

    def __init__(self, config: BackOffConfig) -> None:
        self._config = config
        self._trail: deque[tuple[int, SE2]] = deque(maxlen=_TRAIL_POSES)  # (ns, pose)
        self._commanded: _Commanded | None = None
        self._retreat: _Retreat | None = None
        self._stuck_at: SE2 | None = None
        self._tries = self._failures = 0
        self._held: tuple[SE2, int] | None = None  # by a stop of HELD, after which no command has driven forward yet
        self._last_ns: int | None = None

    def step(
        self, command: VelocityCommand, T_odom_base: SE2 | None, now_ns: int, speed_scale: float = 1.0
    ) -> VelocityCommand:
        """Return `command`, or a drive back in its place. A zero command with a reason takes precedence and ends it."""
        elapsed_s = 0.0 if self._last_ns is None else min(max((now_ns - self._last_ns) / 1e9, 0.0), MAX_STEP_S)
        self._last_ns = now_ns
        scale = min(speed_scale, 1.0) if speed_scale > 0 else 0.0
        speed_mps = min(self._config.speed_mps, -self._config.vx_min_mps) * scale
        if T_odom_base is None or command.reason != OK or speed_mps <= 0:
            if command.reason in HELD and T_odom_base is not None:
                self._held = T_odom_base, now_ns
            self._end(T_odom_base)
            return command
        if self._retreat is None:
            if not self._trail or _gap(self._trail[-1][1], T_odom_base, _TRAIL_M, _TRAIL_RAD) >= 1.0:
                self._trail.append((now_ns, T_odom_base))
            if not self._is_stuck(command, T_odom_base, now_ns, elapsed_s):
                return command
            self._tries += 1
            times = min(self._tries, self._config.further)
            self._retreat = _Retreat(T_odom_base, now_ns, times, T_odom_base, now_ns)
            self._stuck_at = self._stuck_at or T_odom_base
            self._forget_before_a_turn_about(T_odom_base)
        back = self._drive_back(self._retreat, command, T_odom_base, now_ns, speed_mps, scale)
        if back is None:
            self._end(T_odom_base)
            self._commanded = None
            return command
        return back

    def _is_stuck(self, command: VelocityCommand, pose: SE2, now_ns: int, elapsed_s: float) -> bool:
        config = self._config
        if self._stuck_at is not None and distance_m(self._stuck_at, pose) > config.apart_m:
            self._stuck_at, self._tries, self._failures = None, 0, 0
        if command.vx_mps <= 0.0:
            return False
        held, self._held = self._held, None
        if held is not None and now_ns - held[1] <= _HELD_NS and _gap(held[0], pose, _FAILED_M, _STILL_RAD) < 1.0:
            self._commanded = None
            return self._failures < config.failures
        commanded = self._commanded = self._commanded or _Commanded(pose)
        commanded.for_s += elapsed_s
        commanded.distance_m += command.vx_mps * elapsed_s
        if commanded.for_s < config.after_s or commanded.distance_m < config.commanded_m:
            return False
        self._commanded = _Commanded(pose)  # each stretch is judged alone, so that a freed robot is not stuck
        moved_m = distance_m(commanded.start, pose)
        return moved_m < config.share * commanded.distance_m and self._failures < config.failures

    def _forget_before_a_turn_about(self, pose: SE2) -> None:
        """Shorten the trail to what was driven since a turn of more than 90°: the way before that lies ahead."""
        poses = list(reversed(self._trail))
        kept = list(
            itertools.takewhile(lambda each: abs(wrap_angle(each[1].theta_rad - pose.theta_rad)) <= pi / 2, poses)
        )
        if len(kept) < len(poses):
            while len(kept) > 1 and distance_m(kept[-1][1], kept[-2][1]) < _TRAIL_M / 2:
                kept.pop()  # of a turn on the spot only its end is a heading in which the robot drove
        self._trail = deque(reversed(kept), maxlen=_TRAIL_POSES)

    def _end(self, pose: SE2 | None) -> None:
        if self._retreat is not None:
            self._failures += pose is None or distance_m(self._retreat.start, pose) < _FAILED_M
        self._retreat = None

    def _drive_back(
        self, retreat: _Retreat, command: VelocityCommand, pose: SE2, now_ns: int, speed_mps: float, scale: float
    ) -> VelocityCommand | None:
        """Drive towards the previous pose of the trail; None where the retreat ends."""
        config = self._config
        if command.target is None or hypot(command.target.x_m, command.target.y_m) < _TRAIL_M:
            return None
        if _gap(retreat.last, pose, _STILL_M, _STILL_RAD) >= 1.0:
            retreat.last, retreat.moved_ns = pose, now_ns
        stands = now_ns - retreat.moved_ns >= config.stands_s * 1e9
        if stands or now_ns - retreat.since_ns >= retreat.times * config.at_most_s * 1e9:
            return None
        while self._trail and _ahead_m(self._trail[-1][1], pose) < _STILL_M:
            self._trail.pop()
        while self._trail and retreat.since_ns - self._trail[0][0] > _TRAIL_NS:
            self._trail.popleft()
        if not self._trail or distance_m(retreat.start, pose) >= retreat.times * config.distance_m:
            return None
        behind = (each for _, each in reversed(self._trail) if _ahead_m(each, pose) >= _LOOK_BACK_M)
        turn_rad = wrap_angle(next(behind, self._trail[0][1]).theta_rad - pose.theta_rad)
        most = min(config.turn_radps, config.wz_max_radps) * scale
        wz_radps = min(max(turn_rad / _REACH_S, -most), most)
        vx_mps = -speed_mps if abs(turn_rad) < _TURN_FIRST_RAD else 0.0
        return VelocityCommand(vx_mps, 0.0, wz_radps, command.target, BACKING_OFF)


@dataclass(frozen=True)
class StandstillConfig:
    """Thresholds and speed of the turn at a standstill."""

    wz_max_radps: float
    """The robot file's limit."""
    after_s: float = 5.0
    within_m: float = 0.1
    slower_mps: float = 0.05
    slower_radps: float = 0.15
    """Planned speeds below these count as standing still."""
    drives_mps: float = 0.2
    """Planned speed from which the turn ends, m/s."""
    leads_on_m: float = 1.5
    """Distance of the last waypoint below which the text plans to stop, m."""
    point_m: float = 0.5
    """The robot turns towards the first waypoint at this distance or beyond."""
    aside_rad: float = 0.35
    """Bearing below which a waypoint lies ahead, so that turning changes nothing."""
    done_rad: float = 0.15
    turn_radps: float = 0.5
    held_rad: float = 0.1
    held_s: float = 2.0
    """Rotation below which, in this time, the robot counts as blocked and ends the turn."""
    turns: int = 3
    """Largest number of turns at one place."""
    apart_m: float = 0.5
    """Distance at which another place begins."""

    def __post_init__(self) -> None:
        if min(vars(self).values()) <= 0 or self.aside_rad <= self.done_rad or self.leads_on_m < self.point_m:
            raise ValueError(
                f"standstill: expected all above 0, aside_rad above done_rad, leads_on_m from point_m, found {self}"
            )


@dataclass
class _Turn:
    """Turn in progress."""

    heading_rad: float
    last_rad: float
    turned_ns: int


class StandstillTurn:
    """Turn at a standstill: detects a plan that stands for long and turns the robot towards the waypoints."""

    def __init__(self, config: StandstillConfig) -> None:
        self._config = config
        self._stood_at: SE2 | None = None
        self._stood_ns = 0
        self._turn: _Turn | None = None
        self._place: SE2 | None = None
        self._turns = 0
        self._last_ns: int | None = None

    def step(
        self, command: VelocityCommand, waypoints: npt.NDArray[np.float32] | None, T_odom_base: SE2 | None,
        now_ns: int, speed_scale: float = 1.0,
    ) -> VelocityCommand:  # fmt: skip
        """Return `command`, or the turn in its place.

        `waypoints` [points, 2]: m in the robot's frame now; None while the text plans to stand. A command of zero with
        a reason, a plan that drives, and a text that plans to stand take precedence and end a turn.
        """
        elapsed_ns = 0 if self._last_ns is None else min(max(now_ns - self._last_ns, 0), round(MAX_STEP_S * 1e9))
        self._last_ns = now_ns
        config, point = self._config, self._point(waypoints)
        if T_odom_base is None or command.reason != OK or command.target is None or not speed_scale > 0 or not point:
            self._turn = None  # keep counting the standing time: sync mode halts while it reasons
            return command
        speed_mps, yaw_radps = arc_to(command.target, TARGET_TIME_S)
        if self._turn is None:
            stands = speed_mps < config.slower_mps and abs(yaw_radps) < config.slower_radps
            if self._stood_at is None or not stands or distance_m(self._stood_at, T_odom_base) > config.within_m:
                self._stood_at, self._stood_ns = T_odom_base, 0
            self._stood_ns += elapsed_ns
            bearing_rad = atan2(point[1], point[0])
            if self._stood_ns < config.after_s * 1e9 or abs(bearing_rad) < config.aside_rad:
                return command
            if self._place is None or distance_m(self._place, T_odom_base) > config.apart_m:
                self._place, self._turns = T_odom_base, 0
            if self._turns >= config.turns:
                return command
            self._turns += 1
            heading_rad = wrap_angle(T_odom_base.theta_rad + bearing_rad)
            self._turn = _Turn(heading_rad, T_odom_base.theta_rad, now_ns)
        return self._continue(self._turn, speed_mps, command, T_odom_base, now_ns, speed_scale)

    def _point(self, waypoints: npt.NDArray[np.float32] | None) -> tuple[float, float] | None:
        if waypoints is None or hypot(*map(float, waypoints[-1])) < self._config.leads_on_m:
            return None
        return next((float(x), float(y)) for x, y in waypoints if hypot(float(x), float(y)) >= self._config.point_m)

    def _continue(
        self, turn: _Turn, speed_mps: float, command: VelocityCommand, pose: SE2, now_ns: int, speed_scale: float
    ) -> VelocityCommand:
        config = self._config
        left_rad = wrap_angle(turn.heading_rad - pose.theta_rad)
        if abs(wrap_angle(pose.theta_rad - turn.last_rad)) >= config.held_rad:
            turn.last_rad, turn.turned_ns = pose.theta_rad, now_ns
        held = now_ns - turn.turned_ns >= config.held_s * 1e9
        if held or abs(left_rad) < config.done_rad or speed_mps >= config.drives_mps:
            self._stood_at = self._turn = None
            return command
        most = min(config.turn_radps, config.wz_max_radps) * min(speed_scale, 1.0)
        turn_radps = copysign(min(most, 2.0 * abs(left_rad)), left_rad)
        return VelocityCommand(0.0, 0.0, turn_radps, command.target, TURNING)


def has_arrived(T_odom_stop: SE2 | None, T_odom_base: SE2) -> bool:
    """Whether the robot is at the stop, or has passed it by no more than `PASSED_M`."""
    if T_odom_stop is None:
        return False
    beyond = T_odom_stop.inverse() @ T_odom_base
    return -SHORT_M <= beyond.x_m <= PASSED_M and abs(beyond.y_m) <= ASIDE_M


class Recovery:
    """All recoveries of one run, behind their switch."""

    def __init__(self, switches: Switches, limits: LimitsConfig) -> None:
        """`limits` are the robot file's."""
        self._enabled = switches.recovery is RecoverySwitch.ON
        self._stands_at_goal = switches.stand_at_goal
        self._standstill = StandstillTurn(StandstillConfig(limits.wz_max_radps))
        self._back_off = BackOff(BackOffConfig(limits.vx_min_mps, limits.wz_max_radps))

    def hold(self, T_odom_stop: SE2 | None, T_odom_base: SE2) -> str | None:
        """Return the reason for standing whatever the plan: ARRIVED, or None."""
        return ARRIVED if self._stands_at_goal and has_arrived(T_odom_stop, T_odom_base) else None

    def step(
        self, command: VelocityCommand, waypoints: npt.NDArray[np.float32] | None, T_odom_base: SE2 | None,
        now_ns: int, speed_scale: float,
    ) -> VelocityCommand:  # fmt: skip
        """Return `command`, or a recovery's in its place; `waypoints` as in `StandstillTurn.step`."""
        if not self._enabled:
            return command
        command = self._standstill.step(command, waypoints, T_odom_base, now_ns, speed_scale)
        return self._back_off.step(command, T_odom_base, now_ns, speed_scale)


def _ahead_m(before: SE2, pose: SE2) -> float:
    """Return how far a pose is ahead of another one along the other's heading, m."""
    return (before.inverse() @ pose).x_m


def distance_m(a: SE2, b: SE2) -> float:
    """Return the distance between two poses, m."""
    return hypot(b.x_m - a.x_m, b.y_m - a.y_m)


def _gap(a: SE2, b: SE2, one_m: float, one_rad: float) -> float:
    """Return the distance of two poses in the larger of two units."""
    return max(distance_m(a, b) / one_m, abs(wrap_angle(b.theta_rad - a.theta_rad)) / one_rad)
