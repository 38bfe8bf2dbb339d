"""The fault table is complete, every row of it is tested, and nothing in the runner finds what is not in it."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from edge.safety.faults.findings import Finding, FindingQueue
from edge.safety.faults.table import FAULT_OF_CAUSE, FAULTS, LAST_ROW, NOT_HERE, Action, Escalation, Fault
from firmware_bridge.core.link import CAUSES
from tools.fault_table import page

ROOT = Path(__file__).parents[3]
ROWS = sorted(FAULTS.values(), key=lambda fault: (fault.row, fault.name))


def test_every_row_of_the_matrix_is_in_the_table_or_has_a_reason_not_to_be() -> None:
    listed = {fault.row for fault in ROWS}
    assert listed | set(NOT_HERE) == set(range(1, LAST_ROW + 1))
    assert not listed & set(NOT_HERE)


@pytest.mark.parametrize("fault", ROWS, ids=lambda fault: fault.name)
def test_the_test_that_injects_a_fault_exists(fault: Fault) -> None:
    node, _, case = fault.test_id.removesuffix("]").partition("[")
    file, *names = node.split("::")
    text = (ROOT / file).read_text(encoding="utf-8")
    assert not case or any(f'"{name}"' in text for name in (case, case.split()[0])), f"{file} has no case {case}"
    body = ast.parse(text).body
    for name in names:
        found = [node for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == name]
        assert found, f"{file} has no {name}"
        body = found[0].body


def test_every_finding_of_the_code_is_in_the_table() -> None:
    found = {
        name
        for path in (ROOT / "edge").rglob("*.py")
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "Finding"
        for name in _texts(call.args[0])
    }
    assert found and found <= set(FAULTS)


def test_the_runner_notices_every_fault_that_the_table_assigns_to_it() -> None:
    named = {
        name
        for path in (ROOT / "edge").rglob("*.py")
        if path.parent.name != "faults"
        for name in _texts(ast.parse(path.read_text(encoding="utf-8")))
    }
    named |= {fault.escalation.to for fault in ROWS if fault.name in named and fault.escalation}
    ours = {fault.name for fault in ROWS if fault.where == "runner" and fault.action is not Action.NOTHING}
    assert ours - named == set()


def _texts(tree: ast.AST) -> set[str]:
    return {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)}


def test_control_code_never_reads_the_wall_clock() -> None:
    wall = re.compile(r"\btime\.time(_ns)?\b|datetime\.now|CLOCK_REALTIME|\.utcnow|date\.today")
    control = _imported("edge.run.control_loop", set()) | _imported("firmware_bridge.bridge", set())
    assert {"edge.safety.supervisor", "edge.safety.monitors.frame", "firmware_bridge.core.rules"} <= control
    # The flight log writes the date once, for people.
    readers = {name for name in control if wall.search(_file(name).read_text(encoding="utf-8"))}
    assert readers <= {"edge.flightlog.recorder", "edge.flightlog.part"}


def _file(module: str) -> Path:
    return ROOT / (module.replace(".", "/") + ".py")


def _imported(module: str, seen: set[str]) -> set[str]:
    """The module and all of ours that it needs."""
    if module not in seen and _file(module).exists():
        seen.add(module)
        for node in ast.walk(ast.parse(_file(module).read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                for name in (node.module, *(f"{node.module}.{alias.name}" for alias in node.names)):
                    _imported(name, seen)
    return seen


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
        {"message": "no full stop"},
        {"test_id": "somewhere"},
    ],
)
def test_a_row_that_cannot_be_true_is_refused(change: dict[str, object]) -> None:
    row: dict[str, object] = {"name": "x", "row": 1, "action": Action.ZERO, "bound_ms": 1, "where": "runner"}
    row |= {"message": "A.", "advice": "B.", "test_id": "f.py::test_x"}
    Fault(**row)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="fault x"):
        Fault(**(row | change))  # type: ignore[arg-type]


def test_an_escalation_needs_two_findings_and_a_time() -> None:
    with pytest.raises(ValueError, match="escalation"):
        Escalation("x", 1, 1000)


def test_every_cause_for_which_the_bridge_stops_is_in_the_table_or_is_no_fault_while_driving() -> None:
    ours = {"none", "client_stop", "client_lost", "shutdown"}  # the runner's own doing, or its end
    refused = {"not_standing", "battery_low", "operator"}  # only at arming
    assert set(FAULT_OF_CAUSE) | ours | refused == set(CAUSES)
    assert set(FAULT_OF_CAUSE.values()) <= set(FAULTS)


def test_findings_of_other_threads_are_taken_once_in_their_order() -> None:
    queue = FindingQueue()
    queue.put((Finding("odometry-late"), Finding("odometry-jump")))
    assert [finding.name for finding in queue.take()] == ["odometry-late", "odometry-jump"]
    assert queue.take() == ()


def test_an_unread_queue_stays_small_and_keeps_the_newest() -> None:
    queue = FindingQueue(capacity=3)
    for index in range(10):
        queue.put((Finding("odometry-late", str(index)),))
    assert [finding.detail for finding in queue.take()] == ["7", "8", "9"]


def test_the_page_is_made_from_the_table() -> None:
    assert (ROOT / "docs" / "faults.md").read_text(encoding="utf-8") == page(), (
        "run python -m tools.fault_table > docs/faults.md"
    )
