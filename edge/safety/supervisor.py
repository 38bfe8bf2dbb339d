"""Turns findings into a share of the speed limit, zero velocity, or a latched stop.

`Supervisor.step(inputs, now_ns)` has no clock, thread or I/O. States:
* starting: an input that driving needs is missing.
* ready: all inputs are present, the robot is not armed.
* running: armed, no fault.
* degraded: armed, with at least one fault: a lower speed limit, or zero velocity until it has cleared.
* stopped: latched. A supervisor never leaves it: a new arming starts with a new supervisor and fresh inputs.
It can only lower the speed: its output is a share of the limit, at most 1, and no input can raise a limit.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import Enum

from edge.safety.faults.findings import Finding
from edge.safety.faults.table import FAULTS, Action, Fault

_NS_PER_MS = 1_000_000


class State(Enum):
    """State of the runner."""

    STARTING = "STARTING"
    READY = "READY"
    RUNNING = "RUNNING"
    DEGRADED = "DEGRADED"
    STOPPED = "STOPPED"


@dataclass(frozen=True)
class SupervisorInputs:
    """The findings of one step, and whether the robot is armed."""

    findings: tuple[Finding, ...]
    armed: bool


@dataclass(frozen=True)
class FaultEvent:
    """A fault began or ended; a row of `/fault` in the flight log."""

    stamp_ns: int
    fault: Fault
    raised: bool
    detail: str


@dataclass(frozen=True)
class SupervisorOutputs:
    """The permitted speed, and the line for the operator."""

    state: State
    speed_scale: float
    """Share of the speed limit, 0..1; 0 is zero velocity in this very step."""
    stop: bool
    """The run is over: stop the robot and end the run."""
    active: tuple[str, ...]
    """Names of the active faults, the worst first."""
    events: tuple[FaultEvent, ...]
    """Faults that began or ended in this step."""
    message: str
    """One line for the operator: the worst fault and what to do next; empty while there is none."""


@dataclass
class _Active:
    fault: Fault
    detail: str
    speed_scale: float
    seen_ns: int


_ORDER = (Action.STOP, Action.ZERO, Action.LIMIT, Action.NOTHING)


class Supervisor:
    """State machine with the active faults, at most one entry each, and the instants that escalations count."""

    def __init__(self) -> None:
        self._active: dict[str, _Active] = {}
        self._instants: dict[str, deque[int]] = {
            fault.name: deque(maxlen=fault.escalation.count) for fault in FAULTS.values() if fault.escalation
        }
        self._stopped = False
        self._ordered: tuple[_Active, ...] = ()

    def step(self, inputs: SupervisorInputs, now_ns: int) -> SupervisorOutputs:
        """Take this step's findings. A fault ends once it is absent for its clear time; a latched one stays."""
        events: list[FaultEvent] = []
        for finding in inputs.findings:
            self._found(finding, now_ns, events)
        if self._active:
            self._clear(now_ns, events)
        if events:
            entries = sorted(self._active.values(), key=lambda entry: _ORDER.index(entry.fault.action))
            self._ordered = tuple(entries)
        worst = self._ordered[0] if self._ordered else None
        zero = worst is not None and worst.fault.action in (Action.STOP, Action.ZERO)
        scale = 0.0 if zero else min((entry.speed_scale for entry in self._ordered), default=1.0)
        return SupervisorOutputs(
            state=self._state(inputs.armed, zero),
            speed_scale=scale,
            stop=self._stopped,
            active=tuple(entry.fault.name for entry in self._ordered),
            events=tuple(events),
            message="" if worst is None else _sentence(worst),
        )

    def _state(self, armed: bool, zero: bool) -> State:
        if self._stopped:
            return State.STOPPED
        if not armed:
            return State.STARTING if zero else State.READY
        return State.DEGRADED if self._active else State.RUNNING

    def _found(self, finding: Finding, now_ns: int, events: list[FaultEvent]) -> None:
        fault = FAULTS[finding.name]
        if fault.action is Action.NOTHING:
            return
        scale = fault.speed_scale if finding.speed_scale is None else finding.speed_scale
        entry = self._active.get(fault.name)
        if entry is None:
            self._active[fault.name] = _Active(fault, finding.detail, scale, now_ns)
            events.append(FaultEvent(now_ns, fault, True, finding.detail))
            self._stopped = self._stopped or fault.latch
        else:
            # Keep the first detail: the operator reads one line a fault, not one a tick.
            entry.speed_scale, entry.seen_ns = scale, now_ns
        if fault.escalation is not None:
            instants = self._instants[fault.name]
            instants.append(now_ns)
            window_ns = fault.escalation.window_ms * _NS_PER_MS
            if len(instants) == fault.escalation.count and instants[-1] - instants[0] <= window_ns:
                self._found(Finding(fault.escalation.to, finding.detail), now_ns, events)

    def _clear(self, now_ns: int, events: list[FaultEvent]) -> None:
        for name, entry in list(self._active.items()):
            if not entry.fault.latch and now_ns - entry.seen_ns >= entry.fault.clear_ms * _NS_PER_MS:
                del self._active[name]
                events.append(FaultEvent(now_ns, entry.fault, False, entry.detail))


def _sentence(entry: _Active) -> str:
    detail = f" ({entry.detail})" if entry.detail else ""
    return f"{entry.fault.message.removesuffix('.')}{detail}. {entry.fault.advice}"
