"""Out of a stalemate: the plan stands for long while the words mean to go on.

Who has stood for a while sees the picture that it stood at, and may stand for good. The words that were said last tell
where the robot means to be: it is turned towards that on the spot, and where that is ahead, or something holds it, it
is sent back a little, so that the next picture is another one. Pure: no clock, no thread, no I/O.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, copysign, hypot
from typing import Final

import numpy as np
import numpy.typing as npt

from edge.back_off import OK
from edge.controller import VelocityCommand
from edge.geometry import SE2, wrap_angle

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
    """Words whose last waypoint is nearer mean to stop, or to wait."""
    point_m: float = 0.5
    """It turns towards the first waypoint that is so far away."""
    aside_rad: float = 0.35
    """A waypoint less far to the side is ahead."""
    there_rad: float = 0.15
    turn_radps: float = 0.5
    held_rad: float = 0.1
    held_s: float = 2.0
    """Who turns less in so long is held, and sent back."""

    def __post_init__(self) -> None:
        numbers = (
            self.wz_max_radps, self.after_s, self.within_m, self.slower_mps, self.slower_radps, self.drives_mps,
            self.meant_m,             self.point_m, self.there_rad, self.turn_radps, self.held_rad, self.held_s,
        )  # fmt: skip
        if min(numbers) <= 0 or self.aside_rad <= self.there_rad or self.meant_m < self.point_m:
            raise ValueError(f"stalemate: expected all above 0, aside above there, meant beyond point, found {self}")


class Stalemate:
    """Watches how long the plan has stood, and knows what was meant."""

    def __init__(self, config: StalemateConfig) -> None:
        self._config = config
        self._stood_at: SE2 | None = None
        self._since_ns = 0
        self._heading_rad: float | None = None
        self._turned_at_rad = 0.0

    def step(
        self, wanted: VelocityCommand, meant: npt.NDArray[np.float32] | None, T_odom_base: SE2 | None, now_ns: int,
        speed_scale: float = 1.0,
    ) -> tuple[VelocityCommand, bool]:  # fmt: skip
        """`wanted` or the turn in its place, and whether the robot is to be sent back now.

        `meant`: waypoints [points, 2], m in the robot's frame now. What forces zero, or a plan that drives, ends it.
        """
        least_mps = self._config.slower_mps if self._heading_rad is None else self._config.drives_mps
        stands = abs(wanted.vx_mps) < least_mps
        if T_odom_base is None or wanted.reason != OK or not stands or speed_scale <= 0:
            self._stood_at = self._heading_rad = None
            return wanted, False
        if self._heading_rad is not None:
            return self._turn(self._heading_rad, wanted, T_odom_base, now_ns, speed_scale)
        turns = abs(wanted.wz_radps) >= self._config.slower_radps
        if self._stood_at is None or turns or _far_m(self._stood_at, T_odom_base) > self._config.within_m:
            self._stood_at, self._since_ns = T_odom_base, now_ns
        if now_ns - self._since_ns < self._config.after_s * 1e9:
            return wanted, False
        point = self._point(meant)
        if point is None:
            return wanted, False
        self._stood_at = None
        bearing_rad = atan2(point[1], point[0])
        if abs(bearing_rad) < self._config.aside_rad:
            return wanted, True
        self._heading_rad = wrap_angle(T_odom_base.theta_rad + bearing_rad)
        self._turned_at_rad, self._since_ns = T_odom_base.theta_rad, now_ns
        return self._turn(self._heading_rad, wanted, T_odom_base, now_ns, speed_scale)

    def _point(self, meant: npt.NDArray[np.float32] | None) -> tuple[float, float] | None:
        if meant is None or hypot(*map(float, meant[-1])) < self._config.meant_m:
            return None
        return next((float(x), float(y)) for x, y in meant if hypot(float(x), float(y)) >= self._config.point_m)

    def _turn(
        self, heading_rad: float, wanted: VelocityCommand, pose: SE2, now_ns: int, speed_scale: float
    ) -> tuple[VelocityCommand, bool]:
        config = self._config
        left_rad = wrap_angle(heading_rad - pose.theta_rad)
        if abs(left_rad) < config.there_rad:
            self._heading_rad = None
            return wanted, False
        if abs(wrap_angle(pose.theta_rad - self._turned_at_rad)) >= config.held_rad:
            self._turned_at_rad, self._since_ns = pose.theta_rad, now_ns
        if now_ns - self._since_ns >= config.held_s * 1e9:
            self._heading_rad = None
            return wanted, True
        most = min(config.turn_radps, config.wz_max_radps) * min(speed_scale, 1.0)
        turn_radps = copysign(min(most, 2.0 * abs(left_rad)), left_rad)
        return VelocityCommand(0.0, 0.0, turn_radps, wanted.target, TURNING), False


def _far_m(a: SE2, b: SE2) -> float:
    return hypot(b.x_m - a.x_m, b.y_m - a.y_m)
