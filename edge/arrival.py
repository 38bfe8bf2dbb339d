"""Where the words mean to stop, kept in the odometry's frame, and whether the robot is there (ours).

Who passes the goal by a step no longer sees it, and words without it in view say anything. So answers that name what
the instruction names, near, and mean to stop near it, leave a place; the robot stands once it is there, whatever is
said afterwards, until such an answer places it further on, or several tell of another leg or of the thing far away.
"""

from __future__ import annotations

import math
import re
from collections import deque
from statistics import median
from typing import Final

from edge.geometry import SE2
from edge.reasoning_text import MAX_TEXT_CHARS, PLAN_HEAD, WAIT, Progress

NEAR_M: Final = 4.0
"""The thing and the stop are no further away in an answer that counts."""
FAR_M: Final = 6.0
"""A thing at least so far away is not where one has arrived."""
LOOKS: Final = 3
"""So many answers, the newest ones, are weighed."""
AGREEING: Final = 2
"""So many of them have to count."""
SHORT_M: Final = 0.5
"""So much before the place is there: odometry and words are no better."""
ARRIVED: Final = "arrived"
"""Why the robot stands there."""
OBJECTS_HEAD: Final = "Objects: "
_STOP: Final = re.compile(rf"^{PLAN_HEAD}(?:{WAIT})?stop (?:now|in (\d{{1,2}}) m)\.$", re.ASCII | re.MULTILINE)
_SEEN: Final = re.compile(r"([a-z -]{1,40}) (?:left|ahead|right) (\d{1,2}) m", re.ASCII)


class Arrival:
    """The place of one instruction; for one thread."""

    def __init__(self, instruction: str) -> None:
        """`instruction`: what names the thing to stop at."""
        self._instruction = instruction.lower()
        self._answers: deque[SE2 | None] = deque(maxlen=LOOKS)
        self._elsewhere = 0
        self.T_odom_stop: SE2 | None = None
        """Where to stop, heading as the robot came; None while nothing is known of it."""

    def heard(self, text: str, progress: Progress | None, T_odom_anchor: SE2) -> None:
        """Take an answer to a frame that was captured there."""
        seen_m = self._seen_m(text)
        stop_m = _stop_m(text) if progress is not None and progress.is_last_leg else None
        counts = seen_m is not None and stop_m is not None and max(seen_m, stop_m) <= NEAR_M
        self._answers.append(T_odom_anchor @ SE2(stop_m, 0.0, 0.0) if counts and stop_m is not None else None)
        places = [place for place in self._answers if place is not None]
        if counts and len(places) >= AGREEING:
            x_m, y_m = median(place.x_m for place in places), median(place.y_m for place in places)
            self.T_odom_stop = SE2(x_m, y_m, T_odom_anchor.theta_rad)
        another = (progress is not None and not progress.is_last_leg) or (seen_m is not None and seen_m >= FAR_M)
        self._elsewhere = self._elsewhere + 1 if another else 0
        if self._elsewhere >= LOOKS:
            self.T_odom_stop = None

    def _seen_m(self, text: str) -> float | None:
        """How far the nearest thing in view is that the instruction names; None: there is none."""
        lines = (line for line in text[:MAX_TEXT_CHARS].split("\n") if line.startswith(OBJECTS_HEAD))
        said = next(lines, OBJECTS_HEAD)[len(OBJECTS_HEAD) :].rstrip(".")
        found = (_SEEN.fullmatch(thing) for thing in said.split(", "))
        named = (match for match in found if match is not None and self._names(match.group(1)))
        return min((float(match.group(2)) for match in named), default=None)

    def _names(self, thing: str) -> bool:
        return re.search(rf"\b{re.escape(thing)}\b", self._instruction) is not None


def is_there(T_odom_stop: SE2 | None, T_odom_base: SE2) -> bool:
    """Whether the robot is at the place, or has passed it by less than `NEAR_M`."""
    if T_odom_stop is None:
        return False
    beyond = T_odom_stop.inverse() @ T_odom_base
    return beyond.x_m >= -SHORT_M and math.hypot(beyond.x_m, beyond.y_m) <= NEAR_M


def _stop_m(text: str) -> float | None:
    """How far ahead a text's plan means to stop, 0: now; None: it means something else."""
    found = _STOP.search(text[:MAX_TEXT_CHARS])
    return None if found is None else float(found.group(1) or 0.0)
