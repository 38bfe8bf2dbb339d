"""Budget of a soak: limits from a TOML file, and their comparison with the measures. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sim_hil.soak.drive.schedule import SoakInputError, check_keys, read_toml

DEFAULT: Final = Path(__file__).with_name("budget.toml")
FORMAT: Final = 1
PASS, FAIL, UNDECIDED = "PASS", "FAIL", "UNDECIDED"
FAULTS_UNANSWERED: Final = "faults_unanswered"


@dataclass(frozen=True)
class Measure:
    """One measured number; `low` and `high`: its 95 % interval if known, `count`: number of samples."""

    value: float | None
    unit: str
    count: int
    low: float | None = None
    high: float | None = None
    tagged: str = "measured"
    note: str = ""

    def as_json(self) -> dict[str, Any]:
        """Return the measure as JSON values for the result."""
        always = ("value", "unit")
        return {name: value for name, value in self.__dict__.items() if value not in (None, "") or name in always}


@dataclass(frozen=True)
class BudgetLine:
    """One limit on a measure, either `max` or `min`."""

    measure: str
    source: str
    max: float | None = None
    min: float | None = None

    def __post_init__(self) -> None:
        limits = [limit for limit in (self.max, self.min) if limit is not None]
        if len(limits) != 1 or not math.isfinite(limits[0]):
            raise SoakInputError(f"budget {self.measure!r}: expected max or min, a finite number")
        if not self.source:
            raise SoakInputError(f"budget {self.measure!r}: expected a source, found none")


@dataclass(frozen=True)
class Judgement:
    """Verdict on a budget line; `why` explains an undecided one."""

    line: BudgetLine
    measure: Measure
    verdict: str
    why: str = ""

    def as_json(self) -> dict[str, Any]:
        """Return the judgement as JSON values for the result."""
        line = {key: value for key, value in self.line.__dict__.items() if value is not None}
        why = {"why": self.why} if self.why else {}
        return {**line, "verdict": self.verdict, **why, "found": self.measure.as_json()}


def judge_line(line: BudgetLine, measure: Measure) -> Judgement:
    """Judge one line.

    A value beyond the limit fails. If its interval includes the limit, it may be noise, so the line is undecided.
    """
    if measure.value is None:
        return Judgement(line, measure, UNDECIDED, measure.note or "not measured")
    if line.max is not None:
        beyond, sure = measure.value > line.max, measure.low is None or measure.low > line.max
    else:
        assert line.min is not None
        beyond, sure = measure.value < line.min, measure.high is None or measure.high < line.min
    if not beyond:
        return Judgement(line, measure, PASS)
    if sure:
        return Judgement(line, measure, FAIL)
    return Judgement(line, measure, UNDECIDED, "the interval includes the limit: run longer")


def judge(lines: Sequence[BudgetLine], measures: Mapping[str, Measure]) -> list[Judgement]:
    """Judge every line. Raises SoakInputError for a line about an unknown measure."""
    check_names(lines, measures)
    return [judge_line(line, measures[line.measure]) for line in lines]


def applicable(lines: tuple[BudgetLine, ...], *, faults: bool) -> tuple[BudgetLine, ...]:
    """Return the lines that apply: without injected faults, there are no answers to faults to judge."""
    return tuple(line for line in lines if faults or line.measure != FAULTS_UNANSWERED)


def check_names(lines: Sequence[BudgetLine], names: Mapping[str, object] | Sequence[str]) -> None:
    """Check that every line names a known measure. Raises SoakInputError."""
    for line in lines:
        if line.measure not in names:
            raise SoakInputError(f"budget: no measure {line.measure!r}, expected one of {', '.join(sorted(names))}")


def load_budget(path: Path) -> tuple[BudgetLine, ...]:
    """Read the lines of a TOML file. Raises SoakInputError."""
    table = read_toml(path)
    try:
        check_keys(table, {"format", "budget"}, "the file")
        if table["format"] != FORMAT:
            raise SoakInputError(f"format: expected {FORMAT}, found {table['format']!r}")
        lines = []
        for item in table["budget"]:
            check_keys(item, {"measure", "max", "min", "source"}, f"budget {item.get('measure')!r}")
            limits = {key: float(item[key]) for key in ("max", "min") if key in item}
            lines.append(BudgetLine(str(item["measure"]), str(item["source"]), **limits))
        return tuple(lines)
    except SoakInputError as error:
        raise SoakInputError(f"{path}: {error}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise SoakInputError(f"{path}: expected format and [[budget]] ({error!r})") from error
