"""Where the words mean to stop, kept in the odometry's frame, and whether the robot is there (ours).

Who passes the goal by a step no longer sees it, and words without it in view say anything. So answers that see near
what the instruction names, and mean to stop near it, leave a place, and the robot stands once it is there, until such
answers place it further on, or most answers mean something else than to stop soon.
"""

from __future__ import annotations

import re
from collections import deque
from statistics import median
from typing import Final

from edge.core.geometry import SE2, wrap_angle
from edge.state.reasoning_text import MAX_TEXT_CHARS, PLAN_HEAD, WAIT, Progress

NEAR_M: Final = 4.0
"""The thing and the stop are no further away in an answer that counts."""
LOOKS: Final = 3
"""So many answers, the newest ones, are weighed."""
AGREEING: Final = 2
"""So many of them have to count."""
ALONG_RAD: Final = 0.7
"""A place that was looked at by who headed 40° elsewhere is another one."""
NOW_M: Final = 0.5
""""Stop now" is said of less than a metre."""
SHORT_M: Final = 0.5
"""So much before the place is there: odometry and words are no better."""
ASIDE_M: Final = 1.5
"""Who is further to a side of it is not there."""
AFTER: Final = 5
"""So many answers, the newest ones, tell whether it was the wrong place,"""
OTHERS: Final = 4
"""and so many of them have to mean something else."""
ARRIVED: Final = "arrived"
"""Why the robot stands there."""
OBJECTS_HEAD: Final = "Objects: "
MOST_THINGS: Final = 8
"""Of one answer that are looked at; no more are learned than three."""
COLOURS: Final = frozenset(("red", "orange", "yellow", "green", "blue", "purple", "white", "black", "grey", "brown"))
_PLAN: Final = re.compile(rf"^{PLAN_HEAD}(.*)$", re.MULTILINE)
_STOP: Final = re.compile(rf"(?:{WAIT})?stop (?:now|in (\d{{1,2}}) m)\.", re.ASCII)
_SEEN: Final = re.compile(r"([a-z][a-z -]{2,40}) (?:left|ahead|right) (\d{1,2}) m", re.ASCII)


class Arrival:
    """The place of one instruction; for one thread."""

    def __init__(self, instruction: str) -> None:
        """`instruction`: what names the thing to stop at."""
        self._words = _words(instruction)
        self._answers: deque[SE2 | None] = deque(maxlen=LOOKS)
        self._others: deque[bool] = deque(maxlen=AFTER)
        self.T_odom_stop: SE2 | None = None
        """Where to stop, heading as the robot came; None while nothing is known of it."""

    def heard(self, text: str, progress: Progress | None, T_odom_anchor: SE2) -> None:
        """Take a whole answer, as the model itself meant it, to a frame that was captured there."""
        text = text[:MAX_TEXT_CHARS]
        seen_m, stop_m = self._seen_m(text), _stop_m(text)
        soon = stop_m is not None and stop_m <= NEAR_M and progress is not None and progress.is_last_leg
        self._others.append(not soon or (seen_m is not None and seen_m > NEAR_M))
        counts = soon and seen_m is not None and seen_m <= NEAR_M
        self._answers.append(T_odom_anchor @ SE2(stop_m, 0.0, 0.0) if counts and stop_m is not None else None)
        places = [
            place
            for place in self._answers
            if place is not None and abs(wrap_angle(place.theta_rad - T_odom_anchor.theta_rad)) <= ALONG_RAD
        ]
        if counts and len(places) >= AGREEING:
            x_m, y_m = median(place.x_m for place in places), median(place.y_m for place in places)
            self.T_odom_stop = SE2(x_m, y_m, T_odom_anchor.theta_rad)
            self._others.clear()
        elif sum(self._others) >= OTHERS:
            self.T_odom_stop = None

    def _seen_m(self, text: str) -> float | None:
        """How far the first thing in view is that the instruction names; None: there is none."""
        lines = (line for line in text.split("\n") if line.startswith(OBJECTS_HEAD))
        said = next(lines, OBJECTS_HEAD)[len(OBJECTS_HEAD) :].rstrip(".")
        found = (_SEEN.fullmatch(thing) for thing in said.split(", ")[:MOST_THINGS])
        named = (match for match in found if match is not None and self._names(match.group(1)))
        return next((float(match.group(2)) for match in named), None)

    def _names(self, thing: str) -> bool:
        """Whether the instruction has those words; a colour that it leaves out need not be there."""
        words = _words(thing)
        if self._has(words):
            return True
        return words[0] in COLOURS and self._has(words[1:], uncoloured=True)

    def _has(self, words: tuple[str, ...], *, uncoloured: bool = False) -> bool:
        count = len(words)
        return count > 0 and any(
            self._words[start : start + count] == words
            and not (uncoloured and start > 0 and self._words[start - 1] in COLOURS)
            for start in range(len(self._words) - count + 1)
        )


def is_there(T_odom_stop: SE2 | None, T_odom_base: SE2) -> bool:
    """Whether the robot is at the place, or has passed it by less than `NEAR_M`."""
    if T_odom_stop is None:
        return False
    beyond = T_odom_stop.inverse() @ T_odom_base
    return -SHORT_M <= beyond.x_m <= NEAR_M and abs(beyond.y_m) <= ASIDE_M


def _words(text: str) -> tuple[str, ...]:
    return tuple(re.findall(r"[a-z]+", text.lower()))


def _stop_m(text: str) -> float | None:
    """How far ahead a text's plan means to stop; None: it means something else."""
    plan = _PLAN.search(text)
    found = None if plan is None else _STOP.fullmatch(plan.group(1))
    return None if found is None else float(found.group(1) or NOW_M)
