"""The fault table is complete, every row of it is tested, and nothing in the runner finds what is not in it."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from edge.faults import FAULTS, LAST_ROW, NOT_HERE, Action, Escalation, Fault
from edge.findings import Finding, FindingQueue

ROOT = Path(__file__).parents[1]
ROWS = sorted(FAULTS.values(), key=lambda fault: (fault.row, fault.name))


def test_every_row_of_the_matrix_is_in_the_table_or_has_a_reason_not_to_be() -> None:
    listed = {fault.row for fault in ROWS}
    assert listed | set(NOT_HERE) == set(range(1, LAST_ROW + 1))
    assert not listed & set(NOT_HERE)


@pytest.mark.parametrize("fault", ROWS, ids=lambda fault: fault.name)
def test_the_test_that_injects_a_fault_exists(fault: Fault) -> None:
    file, name = fault.test_id.split("::")
    tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


@pytest.mark.parametrize("fault", ROWS, ids=lambda fault: fault.name)
def test_a_name_is_lower_case_with_hyphens(fault: Fault) -> None:
    assert re.fullmatch(r"[a-z]+(-[a-z]+)*", fault.name)


def test_what_is_found_by_the_code_is_in_the_table_and_what_is_in_the_table_is_found() -> None:
    used: set[str] = set()
    for path in (ROOT / "edge").rglob("*.py"):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "Finding":
                used |= {node.value for node in ast.walk(call.args[0]) if _is_name(node)}
    reached = used | {f.escalation.to for f in ROWS if f.name in used and f.escalation}
    ours = {f.name for f in ROWS if f.where == "runner" and f.action is not Action.NOTHING}
    assert reached <= set(FAULTS)
    assert ours - reached == set()


def _is_name(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def test_control_code_never_reads_the_wall_clock() -> None:
    wall = re.compile(r"\btime\.time\b|\btime_ns\(\)|datetime\.now|CLOCK_REALTIME|\.utcnow|date\.today")
    readers = [
        path.name
        for path in sorted((ROOT / "edge").rglob("*.py"))
        if wall.search(path.read_text(encoding="utf-8").replace("monotonic_ns()", ""))
    ]
    # The recorder writes the date into the log, once and for people.
    assert set(readers) <= {"recorder.py", "log_part.py"}


def test_a_finding_that_is_not_in_the_table_cannot_be_made() -> None:
    with pytest.raises(ValueError, match="not a fault of the table"):
        Finding("camera-stoped")


@pytest.mark.parametrize("scale", [-0.1, 1.1, float("nan")])
def test_a_finding_cannot_ask_for_more_than_the_limit(scale: float) -> None:
    with pytest.raises(ValueError, match="speed scale"):
        Finding("semantic-old", speed_scale=scale)


@pytest.mark.parametrize(
    "change",
    [
        {"row": 65},
        {"where": "cloud"},
        {"bound_ms": -1},
        {"speed_scale": 0.5},
        {"says": "no full stop"},
        {"test_id": "somewhere"},
    ],
)
def test_a_row_that_cannot_be_true_is_refused(change: dict[str, object]) -> None:
    row: dict[str, object] = {"name": "x", "row": 1, "action": Action.ZERO, "bound_ms": 1, "where": "runner"}
    row |= {"says": "A.", "advice": "B.", "test_id": "f.py::test_x"}
    Fault(**row)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="fault x"):
        Fault(**(row | change))  # type: ignore[arg-type]


def test_an_escalation_needs_two_findings_and_a_time() -> None:
    with pytest.raises(ValueError, match="escalation"):
        Escalation("x", 1, 1000)


def test_what_latches_is_what_stops() -> None:
    assert all(fault.latch == (fault.action is Action.STOP) for fault in ROWS)


def test_findings_of_other_threads_are_taken_once_in_their_order() -> None:
    queue = FindingQueue()
    queue.put((Finding("odometry-late"), Finding("odometry-jump")))
    assert [finding.name for finding in queue.take()] == ["odometry-late", "odometry-jump"]
    assert queue.take() == ()


def test_a_queue_that_nobody_reads_stays_small_and_keeps_the_newest() -> None:
    queue = FindingQueue(capacity=3)
    for index in range(10):
        queue.put((Finding("odometry-late", str(index)),))
    assert [finding.detail for finding in queue.take()] == ["7", "8", "9"]
