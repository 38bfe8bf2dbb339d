"""Random faults of a soak: a menu from a TOML file, and a seeded schedule drawn from it. Pure."""

from __future__ import annotations

import json
import math
import signal
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from edge.safety.faults.table import FAULTS
from sim_hil.protocols.unitree.fault_commands import KINDS, FaultCommandError, Value, parse

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

DEFAULT: Final = Path(__file__).with_name("faults.toml")
EXPECTED: Final = ("limit", "zero", "stop", "nothing")
PROCESSES: Final = ("edge-run", "edge-bridge")
SIGNALS: Final = ("SIGKILL", "SIGTERM")
LONGEST_S: Final = 600.0
FORMAT: Final = 1


class SoakInputError(ValueError):
    """An invalid file or argument of a soak; one line: what, expected, found."""


@dataclass(frozen=True)
class SoakFault:
    """One kind of fault; `inject` and `expect` as in the default file, `for_s`: range of its duration, s."""

    name: str
    inject: str
    for_s: tuple[float, float]
    weight: float
    fault: str
    expect: str
    values: Mapping[str, Value] = field(default_factory=dict)

    def __post_init__(self) -> None:
        what = f"fault {self.name!r}"
        low, high = self.for_s
        if not self.name or not 0 < low <= high <= LONGEST_S:
            raise SoakInputError(
                f"{what}: expected for_s of two ascending times up to {LONGEST_S:g} s, found {self.for_s}"
            )
        if not 0 < self.weight < math.inf:
            raise SoakInputError(f"{what}: expected a weight above 0, found {self.weight}")
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
            except FaultCommandError as error:
                raise SoakInputError(f"{what}: {error}") from error

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

    def signal(self) -> signal.Signals:
        """Return the signal of a fault that ends a process."""
        assert self.process is not None
        return signal.Signals[self.process[1]]


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
    table = read_toml(path)
    try:
        check_keys(table, {"format", "gap_s", "faults"}, "the file")
        if table["format"] != FORMAT:
            raise SoakInputError(f"format: expected {FORMAT}, found {table['format']!r}")
        faults = [_fault(item) for item in table["faults"]]
        return FaultMenu(_range(table["gap_s"]), tuple(faults))
    except SoakInputError as error:
        raise SoakInputError(f"{path}: {error}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise SoakInputError(f"{path}: expected format, gap_s and [[faults]] ({error!r})") from error


def _fault(item: dict[str, Any]) -> SoakFault:
    check_keys(item, {"name", "inject", "for_s", "weight", "fault", "expect", "values"}, f"fault {item.get('name')!r}")
    return SoakFault(**{**item, "for_s": _range(item["for_s"])})


def _range(value: Any) -> tuple[float, float]:
    low, high = value
    return float(low), float(high)


def check_keys(table: Mapping[str, object], keys: set[str], what: str) -> None:
    """Check that a table has no unknown keys. Raises SoakInputError."""
    unknown = sorted(set(table) - keys)
    if unknown:
        raise SoakInputError(f"{what}: unknown key {unknown[0]!r}, expected {', '.join(sorted(keys))}")


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file. Raises SoakInputError."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise SoakInputError(f"{path}: expected a TOML file ({error})") from error
