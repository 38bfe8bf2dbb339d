"""Out of a stalemate: the plan stands for long while the words mean to go on.

Who has stood for a while sees the picture that it stood at, and may stand for good. The words that were said last tell
where the robot means to be: where that is at its side it is turned towards it on the spot, so that the next picture is
another one. Pure: no clock, no thread, no I/O.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, copysign, hypot
from typing import Final

import numpy as np
import numpy.typing as npt

from edge.core.geometry import SE2, wrap_angle
from edge.motion.controller import TARGET_TIME_S, VelocityCommand, arc_to
from edge.motion.stuck_recovery import MAX_STEP_S, OK, far_m

TURNING: Final = "turning-to-words"
"""What a command gives as its reason meanwhile."""


@dataclass(frozen=True)
class StalemateConfig:
    """When it is one, and how fast it is ended."""

    wz_max_radps: float
    """The robot file's limit."""
    after_s: float = 5.0
    within_m: float = 0.1
    slower_mps: float = 0.05
    slower_radps: float = 0.15
    drives_mps: float = 0.2
    """A plan this fast ends a turn: who dithers at less has still not decided."""
    meant_m: float = 1.5
    """Words whose last waypoint is nearer mean to stop."""
    point_m: float = 0.5
    """It turns towards the first waypoint that is so far away."""
    aside_rad: float = 0.35
    """A waypoint less far to the side is ahead: there is nothing to turn to."""
    there_rad: float = 0.15
    turn_radps: float = 0.5
    held_rad: float = 0.1
    held_s: float = 2.0
    """Who turns less in so long is held."""
    turns: int = 3
    """At one place."""
    apart_m: float = 0.5
    """So far away is another place."""

    def __post_init__(self) -> None:
        numbers = (
            self.wz_max_radps, self.after_s, self.within_m, self.slower_mps, self.slower_radps, self.drives_mps,
            self.point_m, self.there_rad, self.turn_radps, self.held_rad, self.held_s, self.turns, self.apart_m,
        )  # fmt: skip
        if min(numbers) <= 0 or self.aside_rad <= self.there_rad or self.meant_m < self.point_m:
            raise ValueError(f"stalemate: expected all above 0, aside above there, meant beyond point, found {self}")


@dataclass
class _Turn:
    """A turn under way."""

    heading_rad: float
    last_rad: float
    turned_ns: int


class Stalemate:
    """Watches how long the plan has stood, and knows what was meant."""

    def __init__(self, config: StalemateConfig) -> None:
        self._config = config
        self._stood_at: SE2 | None = None
        self._stood_ns = 0
        self._turn: _Turn | None = None
        self._place: SE2 | None = None
        self._turns = 0
        self._last_ns: int | None = None

    def step(
        self, wanted: VelocityCommand, meant: npt.NDArray[np.float32] | None, T_odom_base: SE2 | None, now_ns: int,
        speed_scale: float = 1.0,
    ) -> VelocityCommand:  # fmt: skip
        """`wanted`, or the turn in its place.

        `meant`: waypoints [points, 2], m in the robot's frame now; None while nothing is meant but to stand. Whatever
        forces zero, a plan that drives, and words to stand, come first and end a turn.
        """
        elapsed_ns = 0 if self._last_ns is None else min(max(now_ns - self._last_ns, 0), round(MAX_STEP_S * 1e9))
        self._last_ns = now_ns
        point = self._point(meant)
        if T_odom_base is None or wanted.reason != OK or wanted.target is None or not speed_scale > 0 or point is None:
            self._turn = None  # how long it has stood is counted on: some modes halt to think
            return wanted
        speed_mps, yaw_radps = arc_to(wanted.target, TARGET_TIME_S)
        if self._turn is not None:
            return self._go_on(self._turn, speed_mps, wanted, T_odom_base, now_ns, speed_scale)
        stands = speed_mps < self._config.slower_mps and abs(yaw_radps) < self._config.slower_radps
        if self._stood_at is None or not stands or far_m(self._stood_at, T_odom_base) > self._config.within_m:
            self._stood_at, self._stood_ns = T_odom_base, 0
        self._stood_ns += elapsed_ns
        bearing_rad = atan2(point[1], point[0])
        if self._stood_ns < self._config.after_s * 1e9 or abs(bearing_rad) < self._config.aside_rad:
            return wanted
        if self._place is None or far_m(self._place, T_odom_base) > self._config.apart_m:
            self._place, self._turns = T_odom_base, 0
        if self._turns >= self._config.turns:
            return wanted
        self._turns += 1
        heading_rad = wrap_angle(T_odom_base.theta_rad + bearing_rad)
        self._turn = _Turn(heading_rad, T_odom_base.theta_rad, now_ns)
        return self._go_on(self._turn, speed_mps, wanted, T_odom_base, now_ns, speed_scale)

    def _point(self, meant: npt.NDArray[np.float32] | None) -> tuple[float, float] | None:
        if meant is None or hypot(*map(float, meant[-1])) < self._config.meant_m:
            return None
        return next((float(x), float(y)) for x, y in meant if hypot(float(x), float(y)) >= self._config.point_m)

    def _go_on(
        self, turn: _Turn, speed_mps: float, wanted: VelocityCommand, pose: SE2, now_ns: int, speed_scale: float
    ) -> VelocityCommand:
        config = self._config
        left_rad = wrap_angle(turn.heading_rad - pose.theta_rad)
        if abs(wrap_angle(pose.theta_rad - turn.last_rad)) >= config.held_rad:
            turn.last_rad, turn.turned_ns = pose.theta_rad, now_ns
        held = now_ns - turn.turned_ns >= config.held_s * 1e9
        if held or abs(left_rad) < config.there_rad or speed_mps >= config.drives_mps:
            self._stood_at = self._turn = None
            return wanted
        most = min(config.turn_radps, config.wz_max_radps) * min(speed_scale, 1.0)
        turn_radps = copysign(min(most, 2.0 * abs(left_rad)), left_rad)
        return VelocityCommand(0.0, 0.0, turn_radps, wanted.target, TURNING)
