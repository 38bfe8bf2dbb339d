"""Injector of the scheduled faults into a running stack, one at a time, with a record of each."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from sim_hil.protocols.fault_client import FaultError
from sim_hil.realtime.stack import Stack
from sim_hil.soak.drive.schedule import FaultSchedule, Injection

CLEAR_S = 2.0


class Injector:
    """Injector of scheduled faults; call `step` often. `note` records events."""

    def __init__(self, stack: Stack, schedule: FaultSchedule, note: Callable[..., None]) -> None:
        self._stack = stack
        self._schedule = schedule
        self._note = note
        self._next = schedule.next()
        self._due_ns: int | None = None
        self._end_ns: int | None = None
        self._number = 0
        self.newest: Injection | None = None
        """The last injection; `newest_ns` is the time until which it was active."""
        self.newest_ns = 0

    @property
    def active(self) -> str | None:
        """Name of the active fault; None if there is none."""
        return self._next.fault.name if self._end_ns is not None else None

    def step(self, now_ns: int) -> None:
        """Switch faults on and off when due; call only while the robot is driven. Raises FaultError on a failure."""
        for answer in self._stack.faults.answers() if self._stack.faults is not None else ():
            self._take(answer)
        if self._end_ns is not None:
            self.newest_ns = now_ns
            if now_ns >= self._end_ns:
                self._off(now_ns)
        elif self._due_ns is None:
            self._due_ns = now_ns + round(self._next.gap_s * 1e9)
        elif now_ns >= self._due_ns:
            self._on(now_ns)

    def clear(self) -> None:
        """Switch everything off after the end of a runner; the next gap begins when the robot is driven again."""
        if self._end_ns is not None:
            self._off(time.monotonic_ns(), send=False)
        self._due_ns = None
        if self._stack.faults is not None:
            with suppress(FaultError):  # the robot's side has ended, which the leg detects itself
                self._stack.faults.inject("clear", timeout_s=CLEAR_S)

    def _on(self, now_ns: int) -> None:
        injection, fault = self._next, self._next.fault
        self._number += 1
        self.newest, self.newest_ns = injection, now_ns
        self._end_ns = now_ns + round(injection.for_s * 1e9)
        about = {"name": fault.name, "inject": fault.inject, "fault": fault.fault, "expect": fault.expect}
        self._note("fault_on", number=self._number, for_s=round(injection.for_s, 3), **about)
        if fault.process is None:
            assert self._stack.faults is not None
            self._stack.faults.ask(fault.inject, on=True, **fault.values)
            return
        child = {"edge-run": self._stack.runner, "edge-bridge": self._stack.bridge}[fault.process[0]]
        if child is not None and child.running:
            child.process.send_signal(fault.signal())

    def _off(self, now_ns: int, *, send: bool = True) -> None:
        fault = self._next.fault
        self._note("fault_off", number=self._number, name=fault.name)
        if send and not fault.once:
            assert self._stack.faults is not None
            self._stack.faults.ask(fault.inject, on=False)
        self._next, self._end_ns, self._due_ns = self._schedule.next(), None, None

    def _take(self, answer: dict[str, Any]) -> None:
        if "error" in answer:
            raise FaultError(f"the robot's side refused a fault: {answer['error']}")
        if answer.get("on"):
            self._note("fault_effect", number=self._number, name=answer["fault"], effect_ns=answer["effect_ns"])
