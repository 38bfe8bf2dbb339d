"""Rows of any robot: faults inside the runner, and signals to runner and bridge."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from dataclasses import replace

from sim_hil.realtime.robots import GO2, StackRobot
from tools.faults.rig.processes import Rig
from tools.faults.rows.row import Judge, Row, clear, own_stop_ms

_INSIDE_S = 30.0
"""Timeout of an injection into the runner, s: a fault of reasoning takes effect in the next generation."""


def _inside(name: str, fault: str, injected: str, **values: float | str) -> Row:
    return Row(name, fault, lambda rig: rig.inside.inject(injected, on=True, timeout_s=_INSIDE_S, **values), clear)


def _wall_clock(seconds_s: float) -> Callable[[Rig], int]:
    def inject(rig: Rig) -> int:
        # No onboard code reads the date, so there is no effect to wait for.
        rig.inside.ask("wall-clock", seconds_s=seconds_s)
        return time.monotonic_ns()

    return inject


def _bridge(name: str, fault: str, number: signal.Signals, robot: StackRobot) -> Row:
    """Create the row of a bridge that sends nothing more: then only the robot's own timeout stops it."""
    bound = None if robot is GO2 else own_stop_ms(robot)
    return Row(name, fault, lambda rig: rig.send(rig.bridge, number), bound=bound, by_bridge=True)


def live() -> tuple[Row, ...]:
    """Return the rows that leave the run alive."""
    return (
        _inside("plan is NaN", "output-not-finite", "nan-output"),
        _inside("action expert fails", "output-not-finite", "act-error"),
        _inside("plan never changes", "output-constant", "constant-output"),
        _inside("plan swings at every tick", "output-oscillating", "oscillating-output"),
        _inside("encoder fails", "camera-stopped", "encoder-error"),
        _inside("action expert takes 0.1 s more", "tick-late", "tick-slow", seconds_s=0.1),
        _inside("action expert takes 0.6 s", "tick-overrun", "tick-slow", seconds_s=0.6),
        replace(_inside("reasoning hangs", "semantic-expired", "reasoning-hang"), share=0.25),
        replace(_inside("reasoning's third bad text", "semantic-text-invalid", "garbage-text", after=3.0), share=0.4),
        replace(_inside("flight log's disk stalls", "log-disk-stalled", "disk-stall", seconds_s=3.0), share=0.4),
        replace(Row("date jumps an hour ahead", "wall-clock-moved", _wall_clock(3600.0), clear), share=0.4),
        replace(Row("date jumps an hour back", "wall-clock-moved", _wall_clock(-3600.0), clear), share=0.4),
    )  # fmt: skip


def ending(robot: StackRobot) -> tuple[Row, ...]:
    """Return the rows that end the run."""
    return (
        Row("runner SIGKILL", "runner-killed", lambda rig: rig.send(rig.runner, signal.SIGKILL)),
        Row("runner SIGSTOP, SIGCONT", "runner-frozen", lambda rig: rig.send(rig.runner, signal.SIGSTOP), thaw=True),
        Row("runner SIGTERM", None, lambda rig: rig.send(rig.runner, signal.SIGTERM), judge=Judge.ZERO, ends_run=True),
        _inside("control thread dies", "control-thread-dead", "control-death"),
        replace(_inside("flight log's disk full", "log-disk-full", "disk-full"), ends_run=True, share=0.4),
        _inside("action expert takes 2 s", "commands-late", "tick-slow", seconds_s=2.0),
        _inside("graph does not come back", "graph-hung", "control-hang"),
        replace(_inside("reasoning thread dies", "semantic-expired", "reasoning-death"), ends_run=True, share=0.5),
        _inside("reasoning fails five times", "reasoning-failing", "reasoning-error", after=5.0),
        _inside("plan ten times too long", "output-out-of-range-often", "scaled-output"),
        Row("bridge SIGTERM", None, lambda rig: rig.send(rig.bridge, signal.SIGTERM), judge=Judge.ZERO, ends_run=True),
        _bridge("bridge SIGKILL", "bridge-killed", signal.SIGKILL, robot),
        replace(_bridge("bridge SIGSTOP", "bridge-hung", signal.SIGSTOP, robot), share=0.5),
    )  # fmt: skip
