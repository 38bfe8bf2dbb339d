"""Strata of `dynanav-fresh`: kind of building, path length, number of turns, crowd and robot.

Its episodes are not for reading one by one: reports of this suite contain rates, intervals and counts by stratum alone.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Final

FRESH: Final = "dynanav-fresh"
LENGTHS_M: Final[Mapping[str, tuple[float, float]]] = MappingProxyType(
    {"short": (7.0, 12.0), "middle": (12.0, 19.0), "long": (19.0, 32.0)}
)
"""Bands of the shortest path's length by name, m; the upper end is excluded."""
_LAYOUT: Final = re.compile(r"(hospital|office|warehouse|sidewalk)-\d+", re.ASCII)
_TASK: Final = re.compile(r"[a-z]+-\d+-(\d)-turns?-[a-z-]+-\d+", re.ASCII)


def is_fresh(suite: str) -> bool:
    """Return whether a suite, by name or file, reports strata instead of episodes."""
    return Path(suite).stem == FRESH


def task_name(scene: str, turns: int, goal: str, number: int) -> str:
    """Return the name of a layout's task, from which `turns_of` reads; `goal` is a kind of object."""
    return f"{scene}-{turns}-turn{'s' if turns != 1 else ''}-{goal.replace('_', '-')}-{number}"


def kind_of(scene: str) -> str:
    """Return the kind of building of a layout such as office-60; another scene's own name."""
    found = _LAYOUT.fullmatch(scene)
    return scene if found is None else found[1]


def turns_of(task: str) -> int | None:
    """Return the number of turns in a task's name; None for a task of another suite."""
    found = _TASK.fullmatch(task)
    return None if found is None else int(found[1])


def band_of(length_m: float) -> str | None:
    """Return the name of the band that contains a length, m; None outside all bands."""
    return next((name for name, (low, high) in LENGTHS_M.items() if low <= length_m < high), None)
