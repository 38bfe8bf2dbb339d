"""What may be read out of VLM text: a waypoint line and a progress line, each in a strict grammar.

Text is untrusted. It is capped, never evaluated, and nothing in it can reach a limit; whatever does not match is not
there. The cost is bounded by construction: at most `MAX_TEXT_CHARS` are searched for the lines' starts, at most a
line's longest form is matched, by expressions in which nothing can be matched in two ways.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TypeAlias

MAX_TEXT_CHARS = 4096
MAX_LINE_CHARS = len("waypoints: ") + 3 * len("(-99.99, -99.99) ") - 1
WAYPOINT_TIMES_S = (3.0, 6.0, 9.0)
FARTHEST_M = 99.9
"""What is written of a waypoint that is farther."""
MAX_COUNT = 99
"""Of turns and of openings that are counted."""
PLAN_HEAD = "Plan: "
WAIT = "wait, then "
"""What a plan begins with that lets somebody pass first; the waypoints say where to go all the same."""
PROGRESS_HEAD = "Progress: "
MAX_PROGRESS_CHARS = len("last leg of 99, passed 99.")

Waypoints: TypeAlias = tuple[tuple[float, float], ...]

_NUMBER = r"(-?\d{1,2}\.\d{1,2})"
_POINT = rf"\({_NUMBER}, {_NUMBER}\)"
_LINE = re.compile(rf"waypoints: {_POINT} {_POINT} {_POINT}", re.ASCII)
_COUNT = r"(0|[1-9]\d?)"
_TURN = re.compile(rf"turn {_COUNT} of {_COUNT}, passed {_COUNT}\.", re.ASCII)
_LAST_LEG = re.compile(rf"last leg of {_COUNT}, passed 0\.", re.ASCII)


@dataclass(frozen=True)
class Progress:
    """How far along the told way the robot is (the paper's "task progress", appendix B)."""

    step: int
    """Which of the way's turns is next, from 1; `steps` + 1: all are done, the last leg."""
    steps: int
    """Turns that the told way has; 0: it has none."""
    passed: int
    """Openings of the next turn's kind that were passed on its side since the last turn; 0 on the last leg."""

    def __post_init__(self) -> None:
        if not 0 <= self.steps <= MAX_COUNT:
            raise ValueError(f"steps must be 0 to {MAX_COUNT}, found {self.steps}")
        if not 1 <= self.step <= self.steps + 1:
            raise ValueError(f"step must be 1 to {self.steps + 1} (the last leg), found {self.step}")
        if not 0 <= self.passed <= (0 if self.is_last_leg else MAX_COUNT):
            raise ValueError(f"passed must be 0 to {MAX_COUNT}, on the last leg 0, found {self.passed}")

    @property
    def is_last_leg(self) -> bool:
        """Whether all turns are done."""
        return self.step > self.steps


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


def means_to_wait(text: str) -> bool:
    """Whether the text's plan begins with waiting."""
    lines = text[:MAX_TEXT_CHARS].split("\n")
    return any(line.startswith(PLAN_HEAD + WAIT) for line in lines)


def format_waypoints(waypoints: Waypoints) -> str:
    """The line that `parse_waypoints` reads, with one decimal; what training data is written with."""
    return "waypoints: " + " ".join(f"({_tenths(x)}, {_tenths(y)})" for x, y in waypoints)


def parse_progress(text: str) -> Progress | None:
    """What the text's `Progress:` line says; None without one, with two, or with one that is not of the grammar."""
    if len(text) > MAX_TEXT_CHARS:
        return None
    lines = [line for line in text.split("\n") if line.startswith(PROGRESS_HEAD)]
    if len(lines) != 1 or len(lines[0]) > len(PROGRESS_HEAD) + MAX_PROGRESS_CHARS:
        return None
    said = lines[0][len(PROGRESS_HEAD) :]
    if (turn := _TURN.fullmatch(said)) is not None:
        step, steps, passed = (int(group) for group in turn.groups())
        return Progress(step, steps, passed) if 1 <= step <= steps else None
    if (last := _LAST_LEG.fullmatch(said)) is not None:
        steps = int(last.group(1))
        return Progress(steps + 1, steps, 0)
    return None


def format_progress(progress: Progress) -> str:
    """The canonical words after `Progress: `: "turn 2 of 3, passed 1." or "last leg of 3, passed 0."."""
    if progress.is_last_leg:
        return f"last leg of {progress.steps}, passed 0."
    return f"turn {progress.step} of {progress.steps}, passed {progress.passed}."


def _tenths(value: float) -> str:
    """One decimal, without a negative zero, and no more digits than are read."""
    return f"{round(min(max(value, -FARTHEST_M), FARTHEST_M), 1) + 0.0:.1f}"
