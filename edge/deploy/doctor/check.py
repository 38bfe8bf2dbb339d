"""One result of `edge-doctor`: the check, the found and expected values, the advice."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from enum import Enum
from typing import Any

from rich.markup import escape
from rich.table import Table

from firmware_bridge.system.terminal import one_line


class Level(Enum):
    """Level of a check's result."""

    OK = "ok"
    WARN = "warn"
    """A warning; the robot may be driven."""
    FAIL = "fail"
    """A failure; the robot must not be driven or would refuse."""
    SKIP = "skip"
    """The check was not possible; `found` gives the reason."""


_STYLES = {Level.OK: "green", Level.WARN: "yellow", Level.FAIL: "bold red", Level.SKIP: "dim"}


@dataclass(frozen=True)
class Check:
    """Result of one check."""

    name: str
    level: Level
    found: str
    expected: str = ""
    advice: str = ""
    """The next step; required for a warning or a failure."""

    def __post_init__(self) -> None:
        if not self.name or not self.found:
            raise ValueError(f"check {self.name!r}: expected a name and what was found")
        if self.level in (Level.WARN, Level.FAIL) and not (self.advice and self.expected):
            raise ValueError(f"check {self.name!r}: {self.level.value} without what was expected or what to do")

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON form."""
        return {**asdict(self), "level": self.level.value}


def skipped(name: str, why: str) -> Check:
    """Return the result of a check that was not possible."""
    return Check(name, Level.SKIP, f"skipped: {why}")


def failed(checks: Iterable[Check]) -> bool:
    """Return whether any check failed."""
    return any(check.level is Level.FAIL for check in checks)


def table(checks: Iterable[Check]) -> Table:
    """Return a terminal's table of the checks, with advice below each warning and failure."""
    made = Table(box=None, show_header=False, pad_edge=False, padding=(0, 2, 0, 0))
    made.add_column(no_wrap=True)
    made.add_column(no_wrap=True)
    made.add_column(overflow="fold")
    for check in checks:
        style = _STYLES[check.level]
        # Names and paths from manifests and arguments may contain a terminal's control sequences.
        found, expected, advice = (escape(one_line(each)) for each in (check.found, check.expected, check.advice))
        text = found
        if check.level in (Level.WARN, Level.FAIL):
            text += f"\n  expected {expected}\n  [bold]do this:[/] {advice}"
        made.add_row(check.name, f"[{style}]{check.level.value}[/]", text)
    return made
