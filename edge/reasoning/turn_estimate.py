"""The next turn, by more than one look: how far it is, and whether the robot can have made it (both ours).

Pictures alone place a turn late, and one that is said late is missed. A look's distance less what the robot has come
since is another estimate of the same; the median of the last few counts where it is nearer than what is said now. It
never moves a turn further away: who sees the opening beside him is right.

Who waits for people before a turn says after a while that it is done. Odometry knows better: a turn that was to the
left or right is done by who has turned that way.
"""

from __future__ import annotations

import math
import re
from collections import Counter, deque
from dataclasses import dataclass
from statistics import median
from typing import Final

from edge.core.geometry import SE2, wrap_angle
from edge.state.reasoning_text import PLAN_HEAD, WAIT, Progress
from edge.state.ring import EncodedFrame

MOST_LOOKS: Final = 8
"""Beside the newest."""
ALONG_RAD: Final = 0.7
"""A look of who heads 40° elsewhere now is of another leg: what he has come since says nothing of the turn."""
OVERDUE_M: Final = 1.0
"""Who has come so much further than a look had it, and not turned, has looked wrongly."""
NOW_M: Final = 1.0
"""Nearer than this is "now", as in the texts that are learned from."""
TURNED_RAD: Final = 0.44
"""Who heads less far to that side than he has at any time since it was to be made, 25°, has not made a turn: they are
of 90° as a rule."""
ONCE_TURNED_RAD: Final = 0.79
"""Who has once done so by 45° has made it, wherever he heads now: words may be late."""
EARLIER_NS: Final = 3_000_000_000
"""A turn may begin so long before the words say that it is the next one."""
SETTLED_RAD: Final = 0.09
"""Who turns by less in a second, 5°, has ended a turn; what comes before belongs to that, and not to another one to the
same side."""
SECOND_NS: Final = 1_000_000_000
MOST_REFUSED: Final = 6
"""Claimed so often in a row, a turn counts as made."""
MOST_HEADINGS: Final = 600
"""A minute of the ring's poses."""
LEFT, RIGHT, AHEAD = "left", "right", "ahead"
_PLAN: Final = re.compile(rf"({PLAN_HEAD}(?!(?:{WAIT})?stop ).*) (?:now|in (\d{{1,2}}) m)\.", re.ASCII)
_SIDE: Final = re.compile(r"\b(left|right)\b", re.ASCII)


@dataclass(frozen=True)
class Look:
    """A turn as one answer said it."""

    side: str
    """LEFT, RIGHT; AHEAD: an opening to go through without turning."""
    distance_m: float


@dataclass(frozen=True)
class TurnLeft:
    """What earlier looks say of the turn that is next: its side, LEFT or RIGHT, and how far it is by each, m."""

    side: str
    left_m: tuple[float, ...]


def look_of(line: str) -> Look | None:
    """What a plan's line says of a turn; None where it plans none, or says not how far it is."""
    found = _PLAN.fullmatch(line)
    if found is None:
        return None
    side = _SIDE.search(found.group(1))
    return Look(AHEAD if side is None else side.group(), float(found.group(2) or 0.0))


def nearer(line: str, turn: TurnLeft) -> str:
    """The plan's line with its turn no further away than the looks have it; the same line where they say nothing."""
    look, found = look_of(line), _PLAN.fullmatch(line)
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
        self._turned = _Turned(None, 0)
        self._step: tuple[int, int] | None = None
        self._farthest = 0
        self._sides: deque[str] = deque(maxlen=MOST_LOOKS + 1)
        self._claims = 0
        self._granted = False

    def put(self, stamp_ns: int, T_odom_base: SE2) -> None:
        """See a pose; one that is not newer than the newest changes nothing."""
        if self._headings and stamp_ns <= self._headings[-1][0]:
            return
        last_rad = self._headings[-1][1] if self._headings else T_odom_base.theta_rad
        self._headings.append((stamp_ns, last_rad + wrap_angle(T_odom_base.theta_rad - last_rad)))
        self._turned.put(*self._headings[-1])

    def left(self, T_odom_base: SE2) -> TurnLeft | None:
        """How far the turn is from a pose, by each look that still can be right; None without any."""
        left_m = tuple(
            left_m
            for pose, distance_m in self._looks
            if abs(wrap_angle(T_odom_base.theta_rad - pose.theta_rad)) <= ALONG_RAD
            and (left_m := distance_m - _come_m(pose, T_odom_base)) >= -OVERDUE_M
        )
        return TurnLeft(self._of[1], left_m) if self._of is not None and left_m else None

    @property
    def may_be_done(self) -> bool:
        """Whether the robot can have made the turn that is next: who has to turn to a side has turned that way.

        Also a turn that was made before, and one that is claimed on and on.
        """
        if self._granted or (self._step is not None and self._step[0] < self._farthest):
            return True
        side = self._side()
        return side is None or self._turned.to(side)

    def heard(
        self, progress: Progress | None, look: Look | None, anchor: EncodedFrame, *, overruled: bool, claimed: bool
    ) -> None:
        """Remember what an answer to that frame said itself: who says no turn looks for none.

        `overruled`: it would have said another progress, or was cut short: nothing of its plan is known; `claimed`:
        that a turn is done which cannot be.
        """
        self._claims = self._claims + 1 if claimed else 0
        self._granted = self._granted or self._claims >= MOST_REFUSED
        if progress is not None and (step := (progress.step, progress.steps)) != self._step:
            onward = self._step is not None and step[0] > self._step[0]
            settling, from_ns = self._turned.made(self._side()) if onward else (None, None)
            since_ns = anchor.stamp_ns if from_ns is None else min(from_ns, anchor.stamp_ns)
            self._turned = _Turned(settling, since_ns)
            for stamp_ns, heading_rad in self._headings:
                if stamp_ns >= anchor.stamp_ns - EARLIER_NS:
                    self._turned.put(stamp_ns, heading_rad)
            self._step, self._farthest = step, max(step[0], self._farthest)
            self._sides.clear()
            self._claims, self._granted = 0, False
        if progress is not None and self._of is not None and progress != self._of[0]:
            self._of, self._looks = None, []
        if overruled:
            return
        aside = look is not None and look.side != AHEAD
        of = (progress, look.side) if progress is not None and look is not None and aside else None
        if of is None or of != self._of:
            self._of, self._looks = of, []
        if of is not None and look is not None:
            self._looks = [*self._looks[1 - MOST_LOOKS :], (anchor.T_odom_base, look.distance_m)]
        if look is not None:
            self._sides.append(look.side)

    def _side(self) -> str | None:
        """The side that the last answers said most often of this turn; None: none, or not more often than another."""
        found = Counter(self._sides).most_common(2)
        if not found or found[0][0] == AHEAD or (len(found) > 1 and found[0][1] == found[1][1]):
            return None
        return found[0][0]


class _Turned:
    """How a robot has turned since some instant: furthest from where it headed, to each side."""

    def __init__(self, settling: str | None, from_ns: int) -> None:
        """`settling`: to this side it may still be making the turn before, from then on."""
        self._settling, self._from_ns = settling, from_ns
        self._before: deque[tuple[int, float]] = deque()
        self._from_rad = {LEFT: math.inf, RIGHT: math.inf}
        self._now_rad = {LEFT: 0.0, RIGHT: 0.0}
        self._most_rad = {LEFT: 0.0, RIGHT: 0.0}
        self._made_ns: dict[str, int] = {}

    def put(self, stamp_ns: int, heading_rad: float) -> None:
        """See a heading, counted on beyond half a turn."""
        self._before.append((stamp_ns, heading_rad))
        while len(self._before) > 1 and self._before[1][0] <= stamp_ns - SECOND_NS:
            self._before.popleft()
        then_ns, then_rad = self._before[0]
        if self._from_ns <= then_ns <= stamp_ns - SECOND_NS and abs(heading_rad - then_rad) < SETTLED_RAD:
            self._settling = None
        for side, aside_rad in ((LEFT, heading_rad), (RIGHT, -heading_rad)):
            # Once it is still settling, it begins where it is.
            start_rad = aside_rad if side == self._settling else min(self._from_rad[side], aside_rad)
            self._from_rad[side], self._now_rad[side] = start_rad, aside_rad - start_rad
            self._most_rad[side] = max(self._most_rad[side], aside_rad - start_rad)
            if self._most_rad[side] >= ONCE_TURNED_RAD:
                self._made_ns.setdefault(side, stamp_ns)

    def made(self, said: str | None) -> tuple[str | None, int | None]:
        """(side, since when) of the turn that was made: the side that was said, unless only the other one was seen.

        None: by what was seen it may be going on.
        """
        side = said
        if len(self._made_ns) == 1 and said not in self._made_ns:
            side = next(iter(self._made_ns))
        return side, None if side is None else self._made_ns.get(side)

    def to(self, side: str) -> bool:
        """Whether that is a turn to that side."""
        return self._now_rad[side] >= TURNED_RAD or self._most_rad[side] >= ONCE_TURNED_RAD


def _come_m(T_odom_then: SE2, T_odom_now: SE2) -> float:
    """How far the robot has come: back counts as less."""
    moved = T_odom_then.inverse() @ T_odom_now
    return math.copysign(math.hypot(moved.x_m, moved.y_m), moved.x_m)
