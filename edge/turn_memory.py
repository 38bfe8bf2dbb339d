"""The next turn, by more than one look: how far it is, and whether the robot can have made it (both ours).

Pictures alone place a turn late, and one that is said late is missed. A look's distance less what the robot has come
since is another estimate of the same; the median of the last few counts where it is nearer than what is said now. It
never moves a turn further away: who sees the opening beside him is right.

Who waits for people before a turn says after a while that it is done. Odometry knows better: a turn that was to the
left or right is done by who has turned that way.
"""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass
from math import copysign, hypot
from statistics import median
from typing import Final

from edge.geometry import SE2, wrap_angle
from edge.reasoning_text import PLAN_HEAD, Progress

MOST_LOOKS: Final = 4
"""Beside the newest."""
TURNED_RAD: Final = 0.44
"""Who has turned less, 25°, has not made a turn: they are of 90° as a rule."""
EARLIER_NS: Final = 3_000_000_000
"""A turn may begin so long before the words say that it is the next one."""
MOST_REFUSED: Final = 4
"""Claimed so often in a row, a turn counts as made: some need no turning."""
MOST_HEADINGS: Final = 600
"""A minute of the ring's poses."""
NOW_M: Final = 1.0
"""Nearer than this is "now", as in the texts that are learned from."""
_TURN: Final = re.compile(rf"({PLAN_HEAD}.*\b(left|right)\b.*) (?:now|in (\d{{1,2}}) m)\.", re.ASCII)


@dataclass(frozen=True)
class Look:
    """A turn as one answer said it."""

    side: str
    """"left" or "right"."""
    distance_m: float


@dataclass(frozen=True)
class TurnLeft:
    """What earlier looks say of the turn that is next: its side, and how far it is by each, m."""

    side: str
    left_m: tuple[float, ...]


def look_of(line: str) -> Look | None:
    """What a plan's line says of a turn; None where it plans none, or says not how far it is."""
    found = _TURN.fullmatch(line)
    return None if found is None else Look(found.group(2), float(found.group(3) or 0.0))


def nearer(line: str, turn: TurnLeft) -> str:
    """The plan's line with its turn no further away than the looks have it; the same line where they say nothing."""
    look, found = look_of(line), _TURN.fullmatch(line)
    if look is None or found is None or look.side != turn.side:
        return line
    distance_m = median((*turn.left_m, look.distance_m))
    told_m = round(distance_m) if distance_m >= NOW_M else 0
    if told_m >= look.distance_m:
        return line
    return f"{found.group(1)} {f'in {told_m} m' if told_m else 'now'}."


class TurnMemory:
    """The last looks at one turn, in the odometry's frame, and how the robot has turned since it was to make it.

    For one thread.
    """

    def __init__(self) -> None:
        self._of: tuple[Progress, str] | None = None
        self._looks: list[tuple[SE2, float]] = []
        self._headings: deque[tuple[int, float]] = deque(maxlen=MOST_HEADINGS)
        self._step: tuple[int, int] | None = None
        self._since_ns = 0
        self._side: str | None = None
        self._most_rad = {"left": 0.0, "right": 0.0}
        self._low_rad = self._high_rad = 0.0
        self._refused = 0

    def put(self, stamp_ns: int, T_odom_base: SE2) -> None:
        """See a pose; one that is not newer than the newest changes nothing."""
        if self._headings and stamp_ns <= self._headings[-1][0]:
            return
        last_rad = self._headings[-1][1] if self._headings else T_odom_base.theta_rad
        heading_rad = last_rad + wrap_angle(T_odom_base.theta_rad - last_rad)
        self._headings.append((stamp_ns, heading_rad))
        self._turn_to(heading_rad)

    def left(self, T_odom_base: SE2) -> TurnLeft | None:
        """How far the turn is from a pose, by each look; None without any."""
        if self._of is None:
            return None
        return TurnLeft(self._of[1], tuple(distance_m - _come_m(pose, T_odom_base) for pose, distance_m in self._looks))

    @property
    def may_be_done(self) -> bool:
        """Whether the robot has turned to the side that was said; also where no side was, or it is claimed for long."""
        return self._side is None or self._refused >= MOST_REFUSED or self._most_rad[self._side] >= TURNED_RAD

    def heard(
        self, progress: Progress | None, look: Look | None, T_odom_base: SE2, stamp_ns: int, *, overruled: bool
    ) -> None:
        """Remember what an answer to that pose's picture said itself: who says no turn looks for none.

        `overruled`: it would have said another progress.
        """
        self._refused = self._refused + 1 if overruled and not self.may_be_done else 0
        if progress is not None and (step := (progress.step, progress.steps)) != self._step:
            self._step, self._side, self._refused = step, None, 0
            self._begin(stamp_ns - EARLIER_NS)
        of = None if progress is None or look is None else (progress, look.side)
        if of is None or of != self._of:
            self._of, self._looks = of, []
        if look is not None and of is not None:
            self._looks = [*self._looks[1 - MOST_LOOKS :], (T_odom_base, look.distance_m)]
            self._side = look.side

    def _begin(self, since_ns: int) -> None:
        """Count turns from then on."""
        self._most_rad = {"left": 0.0, "right": 0.0}
        headings = [heading_rad for stamp_ns, heading_rad in self._headings if stamp_ns >= since_ns]
        self._low_rad = self._high_rad = headings[0] if headings else 0.0
        for heading_rad in headings:
            self._turn_to(heading_rad)

    def _turn_to(self, heading_rad: float) -> None:
        self._low_rad, self._high_rad = min(self._low_rad, heading_rad), max(self._high_rad, heading_rad)
        self._most_rad["left"] = max(self._most_rad["left"], heading_rad - self._low_rad)
        self._most_rad["right"] = max(self._most_rad["right"], self._high_rad - heading_rad)


def _come_m(T_odom_then: SE2, T_odom_now: SE2) -> float:
    """How far the robot has come: back counts as less."""
    moved = T_odom_then.inverse() @ T_odom_now
    return copysign(hypot(moved.x_m, moved.y_m), moved.x_m)
