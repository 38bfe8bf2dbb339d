"""What a soak is judged by: lines of a TOML file against what was measured. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sim_hil.soak.drive.schedule import SoakInputError, known, read_toml

DEFAULT: Final = Path(__file__).with_name("budget.toml")
FORMAT: Final = 1
PASS, FAIL, UNDECIDED = "PASS", "FAIL", "UNDECIDED"
FAULTS_UNANSWERED: Final = "faults_unanswered"


@dataclass(frozen=True)
class Measure:
    """One number that a soak has measured; `low` and `high` its 95 % interval where it has one, `count` its samples."""

    value: float | None
    unit: str
    count: int
    low: float | None = None
    high: float | None = None
    tagged: str = "measured"
    note: str = ""

    def as_json(self) -> dict[str, Any]:
        """For the result."""
        always = ("value", "unit")
        return {name: value for name, value in self.__dict__.items() if value not in (None, "") or name in always}


@dataclass(frozen=True)
class BudgetLine:
    """One limit, on one side."""

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
    """A line and what came of it; `why` says what an undecided one lacks."""

    line: BudgetLine
    measure: Measure
    verdict: str
    why: str = ""

    def as_json(self) -> dict[str, Any]:
        """For the result."""
        line = {key: value for key, value in self.line.__dict__.items() if value is not None}
        why = {"why": self.why} if self.why else {}
        return {**line, "verdict": self.verdict, **why, "found": self.measure.as_json()}


def judge_line(line: BudgetLine, measure: Measure) -> Judgement:
    """One line's verdict.

    A value beyond its limit fails, but for one whose interval reaches back to it: that is as likely noise, undecided.
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
    return Judgement(line, measure, UNDECIDED, "its interval reaches the limit: run longer")


def judge(lines: Sequence[BudgetLine], measures: Mapping[str, Measure]) -> list[Judgement]:
    """Every line's verdict; raises SoakInputError for a line about something that is not measured."""
    check_names(lines, measures)
    return [judge_line(line, measures[line.measure]) for line in lines]


def that_apply(lines: tuple[BudgetLine, ...], *, faults: bool) -> tuple[BudgetLine, ...]:
    """The lines to judge by: a soak that is asked to inject no fault has no answers to faults."""
    return tuple(line for line in lines if faults or line.measure != FAULTS_UNANSWERED)


def check_names(lines: Sequence[BudgetLine], names: Mapping[str, object] | Sequence[str]) -> None:
    """Raises SoakInputError for a line about something that is not measured."""
    for line in lines:
        if line.measure not in names:
            raise SoakInputError(f"budget: no measure {line.measure!r}, expected one of {', '.join(sorted(names))}")


def load_budget(path: Path) -> tuple[BudgetLine, ...]:
    """Lines of a TOML file; raises SoakInputError."""
    table = read_toml(path)
    try:
        known(table, {"format", "budget"}, "the file")
        if table["format"] != FORMAT:
            raise SoakInputError(f"format: expected {FORMAT}, found {table['format']!r}")
        lines = []
        for item in table["budget"]:
            known(item, {"measure", "max", "min", "source"}, f"budget {item.get('measure')!r}")
            limits = {key: float(item[key]) for key in ("max", "min") if key in item}
            lines.append(BudgetLine(str(item["measure"]), str(item["source"]), **limits))
        return tuple(lines)
    except SoakInputError as error:
        raise SoakInputError(f"{path}: {error}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise SoakInputError(f"{path}: expected format and [[budget]] ({error!r})") from error
