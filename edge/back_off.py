"""Out of a wedge: a robot that is told to drive and does not come on steps back a little, and is driven on from there.

A plan made from pictures does not feel the doorpost that the robot's side rests against, and the arc to a point 1 s
ahead never reverses. What lies just behind is where the robot has come from. Pure: no clock, no thread, no I/O.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot
from typing import Final

from edge.controller import VelocityCommand
from edge.geometry import SE2, wrap_angle

BACKING_OFF: Final = "backing-off"
"""What a command gives as its reason meanwhile."""
OK: Final = "ok"


@dataclass(frozen=True)
class BackOffConfig:
    """When and how far. `vx_min_mps` is the robot file's limit: where it is 0 the robot never reverses."""

    vx_min_mps: float
    after_s: float = 2.0
    told_mps: float = 0.1
    told_radps: float = 0.3
    """A command from which on the robot ought to move."""
    moved_m: float = 0.1
    moved_rad: float = 0.2
    """Odometry that has seen as much since then has seen it move."""
    speed_mps: float = 0.2
    distance_m: float = 0.3
    at_most_s: float = 2.5

    def __post_init__(self) -> None:
        times = (self.after_s, self.at_most_s, self.speed_mps, self.distance_m, self.told_mps, self.told_radps)
        if self.vx_min_mps > 0 or min(*times, self.moved_m, self.moved_rad) <= 0:
            raise ValueError(f"back-off: expected vx_min_mps of 0 or below and all else above 0, found {self}")


class BackOff:
    """Watches whether the robot does what it is told."""

    def __init__(self, config: BackOffConfig) -> None:
        self._config = config
        self._told: tuple[int, SE2] | None = None
        """Since when, and from where on, it has been told to move without moving."""
        self._back: tuple[int, SE2] | None = None
        """Since when, and from where on, it steps back."""

    def step(
        self, wanted: VelocityCommand, T_odom_base: SE2 | None, now_ns: int, speed_scale: float = 1.0
    ) -> VelocityCommand:
        """`wanted`, or the step back in its place. Whatever forces zero comes first and ends it."""
        config = self._config
        speed_mps = min(config.speed_mps * min(speed_scale, 1.0), -config.vx_min_mps)
        if wanted.reason != OK or T_odom_base is None or not speed_mps > 0:
            self._told = self._back = None
            return wanted
        if self._back is None and self._is_wedged(wanted, T_odom_base, now_ns):
            self._back = (now_ns, T_odom_base)
        if self._back is None:
            return wanted
        since_ns, start = self._back
        if now_ns - since_ns >= config.at_most_s * 1e9 or _gap_m(start, T_odom_base) >= config.distance_m:
            self._told = self._back = None
            return wanted
        return VelocityCommand(-speed_mps, 0.0, 0.0, wanted.target, BACKING_OFF)

    def _is_wedged(self, wanted: VelocityCommand, pose: SE2, now_ns: int) -> bool:
        config = self._config
        if abs(wanted.vx_mps) < config.told_mps and abs(wanted.wz_radps) < config.told_radps:
            self._told = None
            return False
        if self._told is not None:
            since_ns, start = self._told
            turned_rad = abs(wrap_angle(pose.theta_rad - start.theta_rad))
            if _gap_m(start, pose) < config.moved_m and turned_rad < config.moved_rad:
                return now_ns - since_ns >= config.after_s * 1e9
        self._told = (now_ns, pose)
        return False


def _gap_m(a: SE2, b: SE2) -> float:
    return hypot(b.x_m - a.x_m, b.y_m - a.y_m)
