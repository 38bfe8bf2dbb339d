"""A row of the fault table: a fault, what the robot does then, how soon, and the test that injects it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from types import MappingProxyType


class Action(Enum):
    """Action of a fault, from least to most severe."""

    NOTHING = "nothing"
    """Control does not change: the input is dropped or counted."""
    LIMIT = "limit"
    """Lower speed limit on the same arc."""
    ZERO = "zero"
    """Zero velocity until the fault has been absent for its clear time."""
    STOP = "stop"
    """Latched zero velocity: only a new arming ends it."""


PLACES = ("runner", "bridge", "robot", "start")


@dataclass(frozen=True)
class Escalation:
    """`count` findings within `window_ms` raise the fault `to` as well."""

    to: str
    count: int
    window_ms: int

    def __post_init__(self) -> None:
        if self.count < 2 or self.window_ms <= 0:
            raise ValueError(f"escalation to {self.to}: expected a count of 2 or more within a positive time")


@dataclass(frozen=True)
class Fault:
    """One row of the table."""

    name: str
    row: int
    """Row of the fault matrix."""
    action: Action
    bound_ms: int
    """Longest time from the fault's effect at our input to its velocity on the wire, ms; 0: the robot never moves."""
    where: str
    """The acting part: the runner, the bridge, the robot itself, or the start-up checks, which refuse to arm."""
    message: str
    """The failure, one sentence for the operator."""
    advice: str
    """The next step, one sentence for the operator."""
    test_id: str
    """pytest node id of the test that injects the fault."""
    clear_ms: int = 1000
    """Time without the fault after which an unlatched fault ends."""
    speed_scale: float = 1.0
    """A limit's share of the speed limit; 1 keeps the speed and only shows the message."""
    escalation: Escalation | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.row <= LAST_ROW:
            raise ValueError(f"fault {self.name}: row {self.row} is not in the matrix")
        if self.where not in PLACES:
            raise ValueError(f"fault {self.name}: expected where in {PLACES}, found {self.where!r}")
        if self.bound_ms < 0 or self.clear_ms < 0:
            raise ValueError(f"fault {self.name}: times must not be negative")
        if not 0 < self.speed_scale <= 1 or (self.action is not Action.LIMIT and self.speed_scale != 1):
            raise ValueError(f"fault {self.name}: expected a speed scale in (0, 1], of a limit only")
        if not (self.message.endswith(".") and self.advice.endswith(".") and "::" in self.test_id):
            raise ValueError(f"fault {self.name}: expected two sentences and a test id")

    @property
    def latch(self) -> bool:
        """Whether only a new arming ends it."""
        return self.action is Action.STOP


LAST_ROW = 64


def table(*groups: tuple[Fault, ...]) -> Mapping[str, Fault]:
    """Return the faults by name; raises ValueError for a duplicate name or an escalation to an unknown name."""
    rows: dict[str, Fault] = {}
    for fault in (fault for group in groups for fault in group):
        if fault.name in rows:
            raise ValueError(f"fault {fault.name} is in the table twice")
        rows[fault.name] = fault
    for fault in rows.values():
        if fault.escalation is not None and fault.escalation.to not in rows:
            raise ValueError(f"fault {fault.name} escalates to {fault.escalation.to}, which is not in the table")
    return MappingProxyType(rows)
