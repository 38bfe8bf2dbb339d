"""One line of `edge-doctor`: what was checked, what was found, what was expected, what to do."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from enum import Enum
from typing import Any

from rich.markup import escape
from rich.table import Table


class Level(Enum):
    """How a check ended."""

    OK = "ok"
    WARN = "warn"
    """Worth knowing; the robot may be driven."""
    FAIL = "fail"
    """The robot must not be driven like this, or would refuse to."""
    SKIP = "skip"
    """Could not be checked here; `found` tells why."""


_STYLES = {Level.OK: "green", Level.WARN: "yellow", Level.FAIL: "bold red", Level.SKIP: "dim"}


@dataclass(frozen=True)
class Check:
    """Result of one check."""

    name: str
    level: Level
    found: str
    expected: str = ""
    advice: str = ""
    """What to do; for every check that warns or fails."""

    def __post_init__(self) -> None:
        if not self.name or not self.found:
            raise ValueError(f"check {self.name!r}: expected a name and what was found")
        if self.level in (Level.WARN, Level.FAIL) and not (self.advice and self.expected):
            raise ValueError(f"check {self.name!r}: {self.level.value} without what was expected or what to do")

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON form."""
        return {**asdict(self), "level": self.level.value}


def skipped(name: str, why: str) -> Check:
    """A check that could not be made."""
    return Check(name, Level.SKIP, f"skipped: {why}")


def failed(checks: Iterable[Check]) -> bool:
    """Whether any of them failed."""
    return any(check.level is Level.FAIL for check in checks)


def table(checks: Iterable[Check]) -> Table:
    """The checks for a terminal: what was found, and below it what to do where there is something to do."""
    made = Table(box=None, show_header=False, pad_edge=False, padding=(0, 2, 0, 0))
    made.add_column(no_wrap=True)
    made.add_column(no_wrap=True)
    made.add_column(overflow="fold")
    for check in checks:
        style = _STYLES[check.level]
        text = escape(check.found)
        if check.level in (Level.WARN, Level.FAIL):
            text += f"\n  expected {escape(check.expected)}\n  [bold]do this:[/] {escape(check.advice)}"
        made.add_row(check.name, f"[{style}]{check.level.value}[/]", text)
    return made
