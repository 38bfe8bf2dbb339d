"""Measures of a soak, computed from the analyses and samples of its legs, and their budget from a TOML file. Pure."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.stats import theilslopes

from edge.core.stats import percentiles
from sim_hil.realtime.host_stall import STALL_PRIORITY
from sim_hil.scene.table import Table
from sim_hil.soak.faults import MOVED_M, FaultMenu, SoakFault, SoakInputError, read_file
from sim_hil.soak.trends import BRIDGE_PERIOD_MS, SERIES, jitter_ms, stalls_of, trends

DEFAULT_BUDGET: Final = Path(__file__).with_name("budget.toml")
PASS, FAIL, UNDECIDED = "PASS", "FAIL", "UNDECIDED"
FAILED_LEG: Final = "failed: "
"""Beginning of why a leg ended that could not be driven."""
_WORSE: Final = (PASS, UNDECIDED, FAIL)
FAULTS_UNANSWERED: Final = "faults_unanswered"
LEGS_FAILED: Final = "legs_failed"
GROWING: Final = ("stops", LEGS_FAILED, FAULTS_UNANSWERED, "log_records_dropped", "memory_slope", "descriptor_slope")
"""Beginnings of the names of measures that no later leg can lower."""


class Slope(NamedTuple):
    """Growth per hour with its 95 % interval."""

    per_h: float
    low: float
    high: float


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
    each: tuple[Slope, ...] = ()
    """The growth of every life, of which the worst is judged; empty: the measure itself is judged."""

    def as_json(self) -> dict[str, Any]:
        """Return the measure as JSON values for the result."""
        shown = {name: value for name, value in self.__dict__.items() if name != "each"}
        return {name: value for name, value in shown.items() if value not in (None, "") or name in ("value", "unit")}


@dataclass(frozen=True)
class BudgetLine:
    """One limit on a measure, either `max` or `min`."""

    measure: str
    source: str
    max: float | None = None
    min: float | None = None

    def __post_init__(self) -> None:
        limits = [limit for limit in (self.max, self.min) if limit is not None]
        if len(limits) != 1:
            raise SoakInputError(f"budget {self.measure!r}: expected max or min, a finite number")
        if not self.source:
            raise SoakInputError(f"budget {self.measure!r}: expected a source, found none")


def judge(line: BudgetLine, measure: Measure) -> dict[str, Any]:
    """Judge one line and return the JSON values for the result; `why` explains an undecided line.

    A value beyond the limit fails. If its interval includes the limit, it may be noise, so the line is undecided. Of
    several lives, the one with the worst verdict counts.
    """
    lives = [replace(measure, value=life.per_h, low=life.low, high=life.high, each=()) for life in measure.each]
    if lives:
        return max((judge(line, life) for life in lives), key=lambda judged: _WORSE.index(judged["verdict"]))
    if measure.value is None:
        verdict, why = UNDECIDED, measure.note or "not measured"
    else:
        if line.max is not None:
            beyond, sure = measure.value > line.max, measure.low is None or measure.low > line.max
        else:
            assert line.min is not None
            beyond, sure = measure.value < line.min, measure.high is None or measure.high < line.min
        verdict, why = FAIL if beyond else PASS, ""
        if beyond and not sure:
            verdict, why = UNDECIDED, "the interval includes the limit: run longer"
    limits = {key: value for key, value in vars(line).items() if value is not None}
    return {**limits, "verdict": verdict, **({"why": why} if why else {}), "found": measure.as_json()}


def is_lost(judged: Mapping[str, Any]) -> bool:
    """Return whether a failed line stays failed whatever follows: an extreme, a count, or the worst life's slope."""
    name = str(judged["measure"])
    only_grows = name.startswith(GROWING) or name.endswith(".max" if "max" in judged else ".min")
    return judged["verdict"] == FAIL and only_grows


def applicable(lines: tuple[BudgetLine, ...], *, faults: bool) -> tuple[BudgetLine, ...]:
    """Return the lines that apply: without injected faults, there are no answers to faults to judge."""
    return tuple(line for line in lines if faults or line.measure != FAULTS_UNANSWERED)


def load_budget(path: Path) -> tuple[BudgetLine, ...]:
    """Read the lines of a TOML file. Raises SoakInputError."""
    lines = read_file(path, lambda table: tuple(map(_budget_line, table.tables("budget"))))
    names = measures([], [])
    for line in lines:
        if line.measure not in names:
            raise SoakInputError(f"{path}: no measure {line.measure!r}, expected one of {', '.join(sorted(names))}")
    return lines


def _budget_line(table: Table) -> BudgetLine:
    limits = {key: table.number(key) for key in ("max", "min") if key in table}
    line = BudgetLine(table.text("measure"), table.text("source"), **limits)
    table.done()
    return line


WARM_UP_S: Final = 3600.0
"""Warm-up of a process, s, in which caches, histories and arenas fill (nano, 2 cores: the runner's growth was 5.6 MiB/h
over minutes 5 to 15, 2.6 over minutes 15 to 36, 2.0 over the last six of these)."""
SHORTEST_S: Final = 1800.0
"""Least time after the warm-up for a meaningful slope per hour, s."""
BLOCK_S: Final = 10.0
"""Length of a block of samples that is reduced to its median, s."""


def slope(times_s: Sequence[float], values: Sequence[float]) -> Slope | None:
    """Return the slope of `values` [n] over `times_s` [n], s since the process began; None if it ran too shortly.

    The Theil-Sen estimator is robust to steps and spikes. Samples within seconds of each other are correlated, so an
    interval from all of them would be too narrow: they are first reduced to the median of each block.
    """
    times, found = np.asarray(times_s, float), np.asarray(values, float)
    kept = times >= WARM_UP_S
    times, found = times[kept], found[kept]
    if len(times) < 2 or times[-1] - times[0] < SHORTEST_S:
        return None
    blocks = np.floor((times - times[0]) / BLOCK_S).astype(int)
    chosen = [blocks == block for block in np.unique(blocks)]
    middles, medians = [times[one].mean() for one in chosen], [np.median(found[one]) for one in chosen]
    per_s, _, low, high = (float(v) for v in theilslopes(medians, middles, 0.95))
    return Slope(3600 * per_s, 3600 * low, 3600 * high)


PROCESSES: Final = ("edge-run", "edge-bridge", "edge-hil")
MIB: Final = 2.0**20

Analysis = Mapping[str, Any]
Samples = Sequence[Mapping[str, Any]]


def process_lives(samples: Samples, name: str, key: str) -> list[tuple[list[float], list[float]]]:
    """Return (times since the leg's start s, values) of each process called `name` in one leg."""
    lives: dict[int, tuple[list[float], list[float]]] = {}
    for sample in samples:
        row = sample["processes"].get(name)
        if row is not None:
            times, values = lives.setdefault(row["pid"], ([], []))
            times.append(sample["elapsed_s"])
            values.append(row[key])
    return list(lives.values())


def measures(legs: Sequence[Analysis], samples: Sequence[Samples], menu: FaultMenu | None = None) -> dict[str, Measure]:
    """Return every measure by name; `menu`: the faults that may be injected."""
    found: dict[str, Measure] = {}
    for name in PROCESSES:
        found[f"memory_slope_mib_per_h.{name}"] = _slope(samples, name, "rss_bytes", MIB, "MiB/h")
        found[f"descriptor_slope_per_h.{name}"] = _slope(samples, name, "fds", 1.0, "per h")
        rows = [sample["processes"][name] for leg in samples for sample in leg if name in sample["processes"]]
        found[f"memory_mib.{name}.max"] = _reduced([row["rss_bytes"] / MIB for row in rows], max, "MiB")
        found[f"cpu_percent.{name}.mean"] = _reduced([row["cpu_percent"] for row in rows], np.mean, "% of a core")
    lives = [life for leg in legs for life in leg["lives"]]
    _points(found, "tick_ms", [v for life in lives for v in life["tick_ms"]], "ms", "p50", "p99", "p999", "max")
    _points(found, "delay_s", [v for life in lives for v in life["delay_s"] if v is not None], "s", "p50", "p99", "max")
    ages = [v for life in lives for v in life["frame_age_ms"] if v is not None]
    _points(found, "frame_age_ms", ages, "ms", "p50", "p99", "max")
    _points(found, "generation_ms", [v for life in lives for v in life["generation_ms"]], "ms", "p50", "p99", "max")
    jitter = [off for leg in legs for off in jitter_ms(leg).tolist()]
    _points(found, "bridge_jitter_ms", jitter, "ms", "p50", "p99", "p999", "max")
    stalled = [abs(gap - BRIDGE_PERIOD_MS) for leg in legs for gap in leg["command_gap_ms"]]
    _points(found, "bridge_jitter_with_stalls_ms", stalled, "ms", "max")
    stalls = [float(woken_ns - due_ns) / 1e6 for leg in legs for due_ns, woken_ns in stalls_of(leg)]
    unmeasured = sum(leg.get("stalls") is None for leg in legs)
    note = f"not measured in {unmeasured} legs: needs real-time priority {STALL_PRIORITY}" if unmeasured else ""
    for point, value in percentiles(stalls, "p50", "max").items():
        found[f"machine_stall_ms.{point}"] = Measure(value, "ms", len(stalls), note=note)
    ticks, missed = sum(life["ticks"] for life in lives), sum(life["missed"] for life in lives)
    found["missed_percent"] = Measure(100 * missed / (ticks + missed) if ticks else None, "%", ticks + missed)
    errors = [life["delay_error_ms_max"] for life in lives if life["delay_error_ms_max"] is not None]
    found["delay_error_ms.max"] = Measure(max(errors, default=None), "ms", len(errors))
    found["log_records_dropped"] = Measure(sum(life["dropped"] for life in lives), "", len(lives))
    _tasks(found, [task for leg in legs for task in leg["tasks"] if task["end"] != "cut"])
    _stops(found, legs)
    found[LEGS_FAILED] = Measure(sum(is_failed(leg) for leg in legs) if legs else None, "", len(legs))
    _faults(found, [fault for leg in legs for fault in leg["faults"]], () if menu is None else menu.faults)
    factors = [leg["real_time_factor"] for leg in legs if leg["real_time_factor"]]
    found["real_time_factor.min"] = Measure(min(factors, default=None), "", len(factors))
    drift = [100 * error / path for leg in legs for error, path in leg["drift"]]
    _points(found, "drift_percent", drift, "% of the path", "p50", "p99", "max")
    _power(found, lives)
    for name, line in trends(legs).items():
        low, high = (None, None) if line is None else (round(line.low, 3), round(line.high, 3))
        value, count = (None, 0) if line is None else (round(line.per_h, 3), line.number)
        found[f"trend_per_h.{name}"] = Measure(value, f"{SERIES[name].unit}/h", count, low, high)
    gaps = [leg["nearest_person"][1] for leg in legs if leg["nearest_person"] is not None]
    found["nearest_person_m.min"] = Measure(min(gaps, default=None), "m", len(gaps))
    return found


def _slope(samples: Sequence[Samples], name: str, key: str, scale: float, unit: str) -> Measure:
    """Return the growth of all sufficiently long lives."""
    lives = [life for leg in samples for life in process_lives(leg, name, key)]
    slopes = [slope([t - times[0] for t in times], [v / scale for v in values]) for times, values in lives]
    found = [one for one in slopes if one is not None]
    if not found:
        least_s = WARM_UP_S + SHORTEST_S
        note = f"no process ran for {least_s:.0f} s, including {WARM_UP_S:.0f} s of warm-up"
        return Measure(None, unit, 0, note=note)
    # The surest growth first: of two lives with one verdict it is shown.
    each = sorted((Slope(*(round(value, 3) for value in one)) for one in found), key=lambda one: one.low, reverse=True)
    worst = each[0]
    return Measure(worst.per_h, unit, len(each), worst.low, worst.high, note="the worst life", each=tuple(each))


def _reduced(
    values: Sequence[float], reduce: Callable[[Sequence[float]], float], unit: str, digits: int = 2
) -> Measure:
    return Measure(round(float(reduce(values)), digits) if values else None, unit, len(values))


def _points(found: dict[str, Measure], name: str, values: Sequence[float], unit: str, *points: str) -> None:
    for point, value in percentiles(values, *points).items():
        found[f"{name}.{point}"] = Measure(value, unit, len(values))


def _tasks(found: dict[str, Measure], tasks: Sequence[Mapping[str, Any]]) -> None:
    found["success_percent"] = _reduced([100.0 * task["success"] for task in tasks], np.mean, "%")
    # The benchmark's robots face their routes; a robot that has just arrived seldom faces the next one.
    ahead = [100.0 * task["success"] for task in tasks if task.get("first") == ""]
    found["success_ahead_percent"] = _reduced(ahead, np.mean, "%")
    found["collision_percent"] = _reduced([100.0 * bool(task["collisions"]) for task in tasks], np.mean, "%")
    found["spl_percent"] = _reduced([task["spl"] for task in tasks], np.mean, "%")
    found["navigation_error_m.mean"] = _reduced([task["ne_m"] for task in tasks], np.mean, "m", 3)


def is_failed(leg: Analysis) -> bool:
    """Return whether a leg could not be driven, so that its time counts as none."""
    return str(leg["why"]).startswith(FAILED_LEG)


def _stops(found: dict[str, Measure], legs: Sequence[Analysis]) -> None:
    ends = [end for leg in legs for end in leg["life_ends"] if end["cause"] != "leg"]
    found["stops"] = Measure(len(ends), "", len(ends))
    ran = bool(ends) or any(leg["lives"] for leg in legs)
    unexplained = sum(not end["explained"] for end in ends) if ran else None
    found["stops_unexplained"] = Measure(unexplained, "", len(ends), note="" if ran else "no runner has driven")


def _faults(found: dict[str, Measure], injected: Sequence[Mapping[str, Any]], menu: Sequence[SoakFault]) -> None:
    found["faults_injected"] = Measure(len(injected), "", len(injected))
    least_m = {fault.name: fault.moved_m for fault in menu}
    faults = [
        fault
        for fault in injected
        if fault["fault"] and fault["end_ns"] is not None and fault["moved_m"] >= least_m.get(fault["name"], MOVED_M)
    ]
    silent = sum(fault["raised_ns"] is None and fault["other_ns"] is None for fault in faults)
    found["faults_unanswered"] = Measure(silent if faults else None, "", len(faults), note="" if faults else "no fault")
    covered = len({fault["name"] for fault in injected} & set(least_m))
    percent = round(100 * covered / len(menu), 1) if menu else None
    found["faults_covered_percent"] = Measure(percent, "% of the menu", len(menu))


def _power(found: dict[str, Measure], lives: Sequence[Mapping[str, Any]]) -> None:
    """Add mean power and energy, by the trapezoidal rule between samples of one life; gaps of 10 s are left out."""
    energy_j, seconds, tags = 0.0, 0.0, set()
    for life in lives:
        rows = life["power"]
        for (a_ns, a_w, tag), (b_ns, b_w, _) in itertools.pairwise(rows):
            dt_s = (b_ns - a_ns) / 1e9
            if dt_s < 10.0:
                energy_j += dt_s * (a_w + b_w) / 2
                seconds += dt_s
                tags.add(tag)
    tagged = " and ".join(sorted(tags)) or "measured"
    found["power_w.mean"] = Measure(round(energy_j / seconds, 3) if seconds else None, "W", len(lives), tagged=tagged)
    found["energy_wh"] = Measure(round(energy_j / 3600, 4) if seconds else None, "Wh", len(lives), tagged=tagged)
