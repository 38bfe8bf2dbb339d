"""The one thing that may be read out of VLM text: a waypoint line in a strict grammar.

Text is untrusted. It is capped, never evaluated, and nothing in it can reach a limit; whatever does not match is no
waypoints at all. The cost is bounded by construction: at most `MAX_TEXT_CHARS` are searched for the last line's start,
at most `MAX_LINE_CHARS` are matched, by an expression in which nothing can be matched in two ways.
"""

from __future__ import annotations

import re
from typing import TypeAlias

MAX_TEXT_CHARS = 4096
MAX_LINE_CHARS = len("waypoints: ") + 3 * len("(-99.99, -99.99) ") - 1
WAYPOINT_TIMES_S = (3.0, 6.0, 9.0)

Waypoints: TypeAlias = tuple[tuple[float, float], ...]

_NUMBER = r"(-?\d{1,2}\.\d{1,2})"
_POINT = rf"\({_NUMBER}, {_NUMBER}\)"
_LINE = re.compile(rf"waypoints: {_POINT} {_POINT} {_POINT}", re.ASCII)


def parse_waypoints(text: str) -> Waypoints | None:
    """(x m, y m) at 3, 6, 9 s after the anchor, in the anchor's robot frame, from the text's last line; else None."""
    if len(text) > MAX_TEXT_CHARS:
        return None
    line = text.rstrip("\n").rsplit("\n", 1)[-1]
    match = _LINE.fullmatch(line) if len(line) <= MAX_LINE_CHARS else None
    if match is None:
        return None
    values = [float(group) for group in match.groups()]
    return tuple(zip(values[::2], values[1::2], strict=True))


def format_waypoints(waypoints: Waypoints) -> str:
    """The line that `parse_waypoints` reads; what training data is written with."""
    return "waypoints: " + " ".join(f"({x:.2f}, {y:.2f})" for x, y in waypoints)
