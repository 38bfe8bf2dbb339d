"""A row of `make faults`: fault of the table, injection, required reaction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum

from edge.safety.faults.table import FAULTS, Action
from sim_hil.protocols.fault_socket import TIMEOUT_S
from sim_hil.realtime.robots import StackRobot
from tools.faults.rig.processes import Rig

BRIDGE_STOP_MS = 300
"""Bound on the stop after SIGTERM to the bridge or the runner, ms: as after a dead runner."""

SCENE_MS = 1000
"""A scene that stays the same is found by distance: 0.25 m or 12° take 0.4 s on the circle, more where it slows."""

UNCHANGED_GAP_MS = 100.0
"""Largest gap between two commands, ms: five periods of the bridge and one tick."""

OWN_MARGIN_MS = 100
"""Margin on a robot's own timeout, ms: two periods of the bridge and the robot's own step, three times."""


class Judge(Enum):
    """Criterion of a row."""

    ZERO = "zero"
    """Time to the lasting zero velocity."""
    LIMIT = "limit"
    """Time to commands that stay within the limit's share of the speed limit."""
    ROBOT = "robot"
    """Time until the robot obeys no velocity."""
    UNCHANGED = "unchanged"
    """Longest time without a moving command; nothing else may change."""
    FRESH = "fresh"
    """Longest age of the newest accepted command while the robot obeys it; the run may go on or end."""


@dataclass(frozen=True)
class Row:
    """One kind of injection. `inject` returns the time of the effect, ns; `undo` ends it."""

    name: str
    fault: str | None
    inject: Callable[[Rig], int]
    undo: Callable[[Rig], None] | None = None
    judge: Judge | None = None
    """None: derived from the fault's action."""
    bound: float | None = None
    """Bound, ms; None: the fault's."""
    share: float = 1.0
    """Share of --per-row; slow injections are made less often."""
    ends_run: bool = False
    """Whether the run ends and a new runner is started, even if the fault does not latch."""
    spacing_s: float = 0.0
    """Time between two injections, for faults that escalate when repeated, s."""
    operator_arms: bool = False
    """Whether an operator must then permit the next runner to arm (`edge-bridge arm`)."""
    starts_anew: bool = False
    """Whether a new runner is started afterwards, whether or not the old one has stopped for good."""
    by_bridge: bool = False
    """Whether bridge and robot alone react, so that the runner's stand-in may drive (`tools/faults/rig/driver.py`)."""
    thaw: bool = False
    """Whether to send SIGCONT to the runner afterwards, which must not move the robot."""

    def __post_init__(self) -> None:
        if self.fault is None and self.judge is None:
            raise ValueError(f"row {self.name}: expected a fault of the table or a judge")
        if self.fault is not None and self.fault not in FAULTS:
            raise ValueError(f"row {self.name}: {self.fault!r} is not in the fault table")

    @property
    def judged_by(self) -> Judge:
        """The given judge, or the one of the fault's action."""
        if self.judge is not None:
            return self.judge
        assert self.fault is not None
        fault = FAULTS[self.fault]
        if fault.action is Action.LIMIT:
            return Judge.LIMIT
        if fault.action is Action.NOTHING:
            return Judge.UNCHANGED
        return Judge.ROBOT if fault.where == "robot" else Judge.ZERO

    @property
    def bound_ms(self) -> float:
        """Longest time from the effect to the judged event, ms; for UNCHANGED the longest gap between two commands."""
        if self.bound is not None:
            return self.bound
        if self.judged_by is Judge.UNCHANGED:
            return UNCHANGED_GAP_MS
        return FAULTS[self.fault].bound_ms if self.fault is not None else BRIDGE_STOP_MS

    @property
    def speed_scale(self) -> float:
        """Remaining share of the speed limit under a limiting fault."""
        return FAULTS[self.fault].speed_scale if self.fault is not None else 1.0

    @property
    def kills_bridge(self) -> bool:
        """Whether the bridge has ended or hangs afterwards."""
        return self.name.startswith("bridge ")

    @property
    def latches(self) -> bool:
        """Whether the fault ends the run."""
        return self.ends_run or (self.fault is not None and FAULTS[self.fault].latch)


def robot_fault(
    name: str, fault: str | None, injected: str, *, judge: Judge | None = None, **values: float | str
) -> Row:
    """Create the row of a fault that edge-hil injects."""
    return Row(
        name,
        fault,
        lambda rig: rig.robot.inject(injected, on=True, timeout_s=TIMEOUT_S, **values),
        lambda rig: switch_off(rig, injected),
        judge=judge,
    )


def harmless(name: str, injected: str, **values: float | str) -> Row:
    """Create the row of a robot-side fault that must change nothing."""
    row = robot_fault(name, None, injected, judge=Judge.UNCHANGED, **values)
    return replace(row, share=0.4)


def own_stop_ms(robot: StackRobot) -> float:
    """Return the bound on a robot that gets no command any more, ms: its own timeout and the margin."""
    return 1000 * robot.own_timeout_s + OWN_MARGIN_MS


def clear(rig: Rig) -> None:
    """End all faults."""
    rig.clear()


def switch_off(rig: Rig, injected: str) -> None:
    """End one fault of edge-hil."""
    rig.robot.inject(injected, on=False)
