"""Results of the injections: per row n, p50, p95, max, bound and verdict, on a quiet and on a loaded machine."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from edge.safety.faults.table import FAULTS
from firmware_bridge.core.config import BRIDGE_PRIORITY
from tools.faults.measure import Sample
from tools.faults.rows import Judge, Row

PROTECTED_BY: Mapping[str, str] = MappingProxyType(
    {
        "runner": "its control thread's real-time priority (LimitRTPRIO in the runner's service) or cores of its own "
        "(runtime.control_cores of the target)",
        "bridge": f"its service's real-time priority {BRIDGE_PRIORITY} (edge-install units)",
        "robot": "nothing of ours: the robot's own timer",
    }
)
"""What keeps the bound of a fault on a loaded machine, by the process that reacts."""

_WHAT = {
    Judge.ZERO: "zero",
    Judge.LIMIT: "limit",
    Judge.ROBOT: "robot stands",
    Judge.UNCHANGED: "unchanged",
    Judge.FRESH: "command's age",
}


@dataclass(frozen=True)
class RowResult:
    """Samples of one row and their verdict.

    A bound holds if the 99.9th percentile is within it, no sample exceeds twice the bound, every sample has a reaction
    and there is no other problem. On a quiet machine, its stalls are subtracted and counted. An injection is
    `repeated` and counted if the robot stood before the fault, or did not drive on after it.
    """

    row: Row
    samples: Sequence[Sample]
    repeated: int = 0
    load: float = 0.0
    """Load average of the machine over the last minute, at the end of the row."""
    busy: int = 0
    """Busy processes beside the row. With any, stalls are not subtracted: they are the load's effect."""

    @property
    def latencies_ms(self) -> list[float]:
        """Measured latencies, ms."""
        return [sample.latency_ms for sample in self.samples if sample.latency_ms is not None]

    @property
    def ended(self) -> int:
        """Number of runs that ended although they might have gone on."""
        return sum(sample.ended for sample in self.samples)

    @property
    def granted(self) -> int:
        """Number of samples that exceed the bound by no more than the machine's stall."""
        if self.busy:
            return 0
        bound = self.row.bound_ms
        return sum(1 for s in self.samples if s.latency_ms is not None and bound < s.latency_ms <= bound + s.stall_ms)

    @property
    def problems(self) -> list[str]:
        """Reasons for the row's failure; empty if it passed."""
        if not self.samples:
            return ["no injection"]
        bound = self.row.bound_ms
        missing = sum(s.latency_ms is None for s in self.samples)
        found = [f"{missing} never came"] if missing else []
        judged = [s.latency_ms - s.stall_ms if s.latency_ms > bound and not self.busy else s.latency_ms
                  for s in self.samples if s.latency_ms is not None]  # fmt: skip
        if judged and percentile(judged, 99.9) > bound:
            found.append(f"p99.9 above {bound:.0f} ms")
        if judged and max(judged) > 2 * bound:
            found.append(f"max above {2 * bound:.0f} ms")
        return found + sorted({wrong for sample in self.samples for wrong in sample.wrong})

    @property
    def protected_by(self) -> str:
        """What keeps this bound on a loaded machine."""
        if self.row.judged_by is Judge.ROBOT:
            return PROTECTED_BY["robot"]
        by_runner = self.row.fault is not None and FAULTS[self.row.fault].where == "runner"
        return PROTECTED_BY["runner" if by_runner else "bridge"]

    def as_json(self) -> dict[str, Any]:
        """Return the entry of the result file, including raw samples."""
        values = self.latencies_ms
        return {
            "fault": self.row.fault,
            "judged_by": self.row.judged_by.value,
            "n": len(self.samples),
            "p50_ms": percentile(values, 50) if values else None,
            "p95_ms": percentile(values, 95) if values else None,
            "max_ms": max(values) if values else None,
            "bound_ms": self.row.bound_ms,
            "granted": self.granted,
            "repeated": self.repeated,
            "ended": self.ended,
            "load": self.load,
            "busy": self.busy,
            "protected_by": self.protected_by,
            "problems": self.problems,
            "pass": not self.problems,
            "samples": [asdict(sample) for sample in self.samples],
        }


def read_results(path: Path, rows: Sequence[Row]) -> list[RowResult]:
    """Read the results of an earlier call; none without the file. Raises ValueError if it cannot be used."""
    if not path.exists():
        return []
    by_name = {row.name: row for row in rows}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))["rows"]
        return [
            RowResult(
                by_name[name],
                [Sample(**sample) for sample in one["samples"]],
                one["repeated"],
                one["load"],
                one.get("busy", 0),
            )
            for name, one in found.items()
            if name in by_name
        ]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path}: expected a result of this command ({error!r}); delete it or leave out --resume"
        ) from error


def markdown(results: Sequence[Mapping[str, Any]]) -> str:
    """Return the table of robots and faults: for each robot bound, p50, p95, max and n of a row, ms.

    `results`: contents of result files, for each robot one of the quiet machine and one for each load. Bounds that a
    load breaks are listed below the table with what protects them.
    """
    names = list(dict.fromkeys(name for one in results for name in one["rows"]))
    lines = ["| fault | judged | " + " | ".join(map(_heading, results)) + " |"]
    lines.append("|---|---|" + "---|" * len(results))
    for name in names:
        found = [one["rows"].get(name) for one in results]
        judged = next(_WHAT[Judge(row["judged_by"])] for row in found if row)
        lines.append(f"| {name} | {judged} | " + " | ".join(map(_cell, found)) + " |")
    loads = [f"{_heading(one)} {low:.1f} to {high:.1f}" for one in results for low, high in [_loads(one)]]
    lines += ["", f"Load of the machine (1 min): {', '.join(loads)}."]
    broken = [
        f"- {name} ({_heading(one)}): {'; '.join(row['problems'])}; protected by {row['protected_by']}"
        for one in results
        for name, row in one["rows"].items()
        if one.get("busy") and not row["pass"]
    ]
    if any(one.get("busy") for one in results):
        lines += ["", "Bounds that do not hold under load:" if broken else "Every bound holds under load.", *broken]
    return "\n".join([*lines, ""])


def _heading(one: Mapping[str, Any]) -> str:
    busy = one.get("busy", 0)
    return f"{one['robot']}, {busy} busy processes" if busy else str(one["robot"])


def _cell(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return "–"
    if row["p50_ms"] is None:
        return f"none of {row['n']}"
    ended = f", {row['ended']} ended" if row["ended"] else ""
    failed = "" if row["pass"] else " **failed**"
    figures = " / ".join(f"{row[name]:.0f}" for name in ("p50_ms", "p95_ms", "max_ms") if row.get(name) is not None)
    return f"≤ {row['bound_ms']:.0f}: {figures}, n {row['n']}{ended}{failed}"


def _loads(one: Mapping[str, Any]) -> tuple[float, float]:
    loads = [row["load"] for row in one["rows"].values()]
    return min(loads), max(loads)


def percentile(values: Sequence[float], share: float) -> float:
    """Return a percentile of at least one value; never more than the largest one."""
    return float(np.percentile(np.array(values), share, method="higher"))


def result(rows: Sequence[RowResult], machine: Mapping[str, object], robot: str, busy: int = 0) -> dict[str, Any]:
    """Return the JSON result; `busy`: number of busy processes beside the injections."""
    return {
        "robot": robot,
        "busy": busy,
        "injections": sum(len(row.samples) for row in rows),
        "pass": bool(rows) and all(not row.problems for row in rows),
        "tagged": "measured",
        "machine": dict(machine),
        "rows": {row.row.name: row.as_json() for row in rows},
    }


def _counted(row: RowResult) -> tuple[tuple[int, str], ...]:
    return (row.granted, "granted"), (row.repeated, "repeated"), (row.ended, "ended")


def show(rows: Sequence[RowResult], console: Console) -> None:
    """Print the table: times in ms from the fault's effect to the judged event, as the sniffer received it."""
    table = Table(title="Faults: from effect to judged event, ms, received on the robot's side", title_justify="left")
    table.add_column("injected")
    table.add_column("fault of the table")
    table.add_column("judged")
    for name in ("n", "p50", "p95", "max", "bound"):
        table.add_column(name, justify="right")
    table.add_column("verdict")
    for row in rows:
        values = row.latencies_ms
        figures = [f"{percentile(values, share):.0f}" for share in (50, 95, 100)] if values else ["–"] * 3
        counted = [f"{n} {what}" for n, what in _counted(row) if n]
        verdict = "; ".join(row.problems) or ", ".join(["pass", *counted])
        what, count = _WHAT[row.row.judged_by], str(len(row.samples))
        bound = f"{row.row.bound_ms:.0f}"
        table.add_row(row.row.name, row.row.fault or "–", what, count, *figures, bound, verdict)
    console.print(table)
