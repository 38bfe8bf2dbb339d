"""The turn on the spot that an instruction asks for (`edge.reasoning.told_turn`), by odometry. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from math import copysign
from typing import Final

from edge.core.geometry import SE2, wrap_angle
from edge.motion.controller import NO_SEMANTIC_STATE, VelocityCommand
from edge.state.semantic import ToldTurn

TOLD: Final = "turning-as-told"
"""Reason of the command."""
_REPLACED: Final = frozenset(("ok", "arrived", "reasoning", NO_SEMANTIC_STATE))
"""Reasons of a command in whose place the robot turns: every other one holds the robot for safety."""

_SLOWEST: Final = 0.4  # share of the speed with which the turn ends


@dataclass(frozen=True)
class TurnConfig:
    """Speeds and limits of the turn."""

    wz_max_radps: float
    """The robot file's limit."""
    turn_radps: float = 0.5
    done_rad: float = 0.1
    slower_rad: float = 0.5
    """Remaining angle below which the robot turns more slowly."""
    held_rad: float = 0.1
    held_ns: int = 3_000_000_000
    """Rotation below which, in this time, the robot counts as blocked: it turns no further."""

    def __post_init__(self) -> None:
        if min(vars(self).values()) <= 0:
            raise ValueError(f"turn on the spot: expected all above 0, found {self}")


@dataclass
class _Progress:
    """A turn in progress."""

    turn: ToldTurn
    left_rad: float
    heading_rad: float
    moved_rad: float = 0.0
    held_ns: int = 0
    last_ns: int | None = None


class TurnOnTheSpot:
    """Turns the robot as told, one turn after the other."""

    def __init__(self, config: TurnConfig) -> None:
        self._config = config
        self._now: _Progress | None = None

    def step(
        self, turn: ToldTurn, command: VelocityCommand, T_odom_base: SE2 | None, now_ns: int, speed_scale: float
    ) -> VelocityCommand | None:
        """Return the command of this tick; None once the turn is done, or the robot no longer turns.

        A command that holds the robot for safety is returned as it is, and the turn goes on after it.
        """
        config = self._config
        if T_odom_base is None or command.reason not in _REPLACED or not speed_scale > 0:
            if self._now is not None:
                self._now.last_ns = None
            return command
        if self._now is None or self._now.turn is not turn:
            self._now = _Progress(turn, turn.turn_rad, T_odom_base.theta_rad)
        now = self._now
        step_rad = wrap_angle(T_odom_base.theta_rad - now.heading_rad)
        now.heading_rad, now.left_rad = T_odom_base.theta_rad, now.left_rad - step_rad
        now.moved_rad += step_rad
        if abs(now.moved_rad) >= config.held_rad:
            now.moved_rad, now.held_ns = 0.0, 0
        elif now.last_ns is not None:
            now.held_ns += max(now_ns - now.last_ns, 0)
        now.last_ns = now_ns
        # Past the angle by a little is done as well: the robot does not turn back and forth.
        done = abs(now.left_rad) < config.done_rad or now.left_rad * turn.turn_rad < 0
        if done or now.held_ns >= config.held_ns:
            self._now = None
            return None
        most = min(config.turn_radps, config.wz_max_radps) * min(speed_scale, 1.0)
        turn_radps = copysign(most * min(max(abs(now.left_rad) / config.slower_rad, _SLOWEST), 1.0), now.left_rad)
        return VelocityCommand(0.0, 0.0, turn_radps, command.target, TOLD)
