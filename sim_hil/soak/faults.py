"""Random faults of a soak: a menu from a TOML file, a seeded schedule drawn from it, and their injector."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from edge.safety.faults.table import FAULTS
from firmware_bridge.system.input_file import read_toml
from sim_hil.protocols.fault_socket import FaultError
from sim_hil.protocols.unitree.fault_commands import KINDS, FaultCommandError, Value, parse
from sim_hil.realtime.robots import StackRobot
from sim_hil.realtime.stack import Stack
from sim_hil.scene.table import Table

T = TypeVar("T")

DEFAULT_MENU: Final = Path(__file__).with_name("faults.toml")
EXPECTED: Final = ("limit", "zero", "stop", "nothing")
PROCESSES: Final = ("edge-run", "edge-bridge")
SIGNALS: Final = ("SIGKILL", "SIGTERM")
LONGEST_S: Final = 600.0
MOVED_M: Final = 0.1
"""Default of `moved_m` of a fault: the pictures of a robot that stands still may repeat."""
FORMAT: Final = 1


class SoakInputError(ValueError):
    """An invalid file or argument of a soak; one line: what, expected, found."""


@dataclass(frozen=True)
class SoakFault:
    """One kind of fault; `inject` and `expect` as in the default file, `for_s`: range of its duration, s.

    `moved_m`: least path during the fault, m, on which the runner must find it.
    """

    name: str
    inject: str
    for_s: tuple[float, float]
    weight: float
    fault: str
    expect: str
    values: Mapping[str, Value] = field(default_factory=dict)
    moved_m: float = MOVED_M

    def __post_init__(self) -> None:
        what = f"fault {self.name!r}"
        low, high = self.for_s
        if not self.name or not 0 < low <= high <= LONGEST_S:
            raise SoakInputError(f"{what}: expected ascending for_s up to {LONGEST_S:g} s, found {self.for_s}")
        if self.weight <= 0:
            raise SoakInputError(f"{what}: expected a weight above 0, found {self.weight}")
        if self.moved_m < 0:
            raise SoakInputError(f"{what}: expected moved_m of 0 m or more, found {self.moved_m:g}")
        if self.expect not in EXPECTED:
            raise SoakInputError(f"{what}: expected one of {', '.join(EXPECTED)}, found {self.expect!r}")
        if self.fault and self.fault not in FAULTS:
            raise SoakInputError(f"{what}: {self.fault!r} is not in the runner's fault table")
        if self.process is not None:
            name, number = self.process
            if name not in PROCESSES or number not in SIGNALS or self.values:
                raise SoakInputError(
                    f"{what}: expected process:NAME:SIGNAL of {', '.join(PROCESSES)} and {', '.join(SIGNALS)}"
                )
        elif self.inject not in KINDS:
            raise SoakInputError(f"{what}: expected process:NAME:SIGNAL or one of {', '.join(KINDS)}")
        else:
            try:
                parse(json.dumps({"fault": self.inject, "on": True, **self.values}).encode())
            except (FaultCommandError, TypeError) as error:  # TypeError: no table, or a value such as a date
                raise SoakInputError(f"{what}: values: {error}") from error

    @property
    def process(self) -> tuple[str, str] | None:
        """(process, signal) of a fault that ends a process; None for a fault of the robot's side."""
        kind, _, rest = self.inject.partition(":")
        if kind != "process":
            return None
        name, _, number = rest.partition(":")
        return name, number

    @property
    def once(self) -> bool:
        """Whether the fault need not be switched off."""
        return self.process is not None or KINDS[self.inject].once


@dataclass(frozen=True)
class FaultMenu:
    """The faults that may occur, and the range of the gap between two, s."""

    gap_s: tuple[float, float]
    faults: tuple[SoakFault, ...]

    def __post_init__(self) -> None:
        low, high = self.gap_s
        if not 0 < low <= high <= 3600.0:
            raise SoakInputError(f"gap_s: expected two ascending times above 0 s, found {self.gap_s}")
        names = [fault.name for fault in self.faults]
        if not names or len(set(names)) != len(names):
            raise SoakInputError("faults: expected one or more, with different names")

    def for_robot(self, robot: StackRobot) -> FaultMenu:
        """Return the faults that edge-hil or a signal can inject for this robot."""
        faults = tuple(fault for fault in self.faults if fault.process is not None or robot.protocol == "unitree")
        return replace(self, faults=faults)


@dataclass(frozen=True)
class Injection:
    """A fault that begins `gap_s` after the end of the previous one and lasts `for_s`."""

    fault: SoakFault
    gap_s: float
    for_s: float


class FaultSchedule:
    """Endless random sequence of injections; the same seed and leg give the same sequence."""

    def __init__(self, menu: FaultMenu, seed: int, leg: int) -> None:
        self._menu = menu
        self._rng = np.random.default_rng((seed, 61, leg))
        weights = np.array([fault.weight for fault in menu.faults])
        self._shares = weights / weights.sum()

    def next(self) -> Injection:
        """Return the next injection."""
        gap_s = float(self._rng.uniform(*self._menu.gap_s))
        fault = self._menu.faults[int(self._rng.choice(len(self._shares), p=self._shares))]
        return Injection(fault, gap_s, float(self._rng.uniform(*fault.for_s)))


def load_menu(path: Path) -> FaultMenu:
    """Read a menu from a TOML file. Raises SoakInputError."""
    return read_file(
        path, lambda table: FaultMenu(table.vector("gap_s", 2), tuple(map(_fault, table.tables("faults"))))
    )


def _fault(table: Table) -> SoakFault:
    name, inject, fault_name, expect = (table.text(key) for key in ("name", "inject", "fault", "expect"))
    for_s, weight, values = table.vector("for_s", 2), table.number("weight"), table.take("values", {})
    moved_m = table.number("moved_m", MOVED_M)
    fault = SoakFault(name, inject, for_s, weight, fault_name, expect, values, moved_m)
    table.done()
    return fault


def read_file(path: Path, read: Callable[[Table], T]) -> T:
    """Read a TOML file of FORMAT and return `read(table)`. Raises SoakInputError."""
    try:
        table = Table("the file", read_toml(path), SoakInputError)
        if table.whole("format") != FORMAT:
            raise SoakInputError(f"expected format {FORMAT}")
        content = read(table)
        table.done()
        return content
    except (OSError, ValueError) as error:
        raise SoakInputError(f"{path}: expected a TOML file as sim_hil/soak contains: {error}") from error


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
        self._put_off: list[Injection] = []
        self.stops_from_ns = 0
        """Faults that end a run and are due before this time are put off until it."""
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
            if self._next.fault.expect == "stop" and now_ns < self.stops_from_ns:
                self._put_off.append(self._next)
                self._draw(now_ns)
            else:
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
            child.process.send_signal(signal.Signals[fault.process[1]])

    def _off(self, now_ns: int, *, send: bool = True) -> None:
        fault = self._next.fault
        self._note("fault_off", number=self._number, name=fault.name)
        if send and not fault.once:
            assert self._stack.faults is not None
            self._stack.faults.ask(fault.inject, on=False)
        self._draw(now_ns)

    def _draw(self, now_ns: int) -> None:
        ready = self._put_off and now_ns >= self.stops_from_ns
        self._next = self._put_off.pop(0) if ready else self._schedule.next()
        self._end_ns = self._due_ns = None

    def _take(self, answer: dict[str, Any]) -> None:
        if "error" in answer:
            raise FaultError(f"the robot's side refused a fault: {answer['error']}")
        if answer.get("on"):
            self._note("fault_effect", number=self._number, name=answer["fault"], effect_ns=answer["effect_ns"])
