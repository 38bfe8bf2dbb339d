"""Mutation testing: which changes are made, how they reach imported modules, and what is counted."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.processes import REPOSITORY
from tools.mutants import plan
from tools.mutants.graft import graft
from tools.mutants.operators import mutants_of

SOURCE = '''"""A module."""
from dataclasses import dataclass
from enum import Enum
class Colour(Enum):
    """A colour."""
    RED = "red"
LIMIT: int = 3
TWICE = LIMIT * 2
@dataclass(frozen=True)
class Box:
    """A box."""
    size: int = 5
    def fits(self, *, strict: bool = False) -> bool:
        """Whether it fits."""
        if self.size > LIMIT and not strict:
            raise ValueError(f"too large: {self.size + 1}")
        return self.size <= LIMIT
    @property
    def half(self) -> float:
        return self.size / 2
'''


def changed(source: str, part: str) -> str:
    """The source with the only mutant whose key contains `part`."""
    [mutant] = [mutant for mutant in mutants_of(source) if part in mutant.key]
    return ast.unparse(mutant.change())


@pytest.mark.parametrize(
    ("source", "part", "expected"),
    [
        ("x = a < b", "a < b -> a <= b", "x = a <= b"),
        ("x = a < b", "a < b -> a >= b", "x = a >= b"),
        ("x = a and b", "-> a or b", "x = a or b"),
        ("x = a and b and c", "-> a and c", "x = a and c"),
        ("x = not a", "not a -> a", "x = a"),
        ("x = min(a, b)", "-> max", "x = max(a, b)"),
        ("x = a + 1", "a + 1 -> a - 1", "x = a - 1"),
        ("x = 0.5", "0.5 -> 1.0", "x = 1.0"),
        ("x = 250", "250 -> 500", "x = 500"),
        ("x = 'armed'", "-> 'armed_'", "x = 'armed_'"),
        ("x = a if b else c", "a if not b", "x = a if not b else c"),
        ("def f(): return a", "-> return None", "def f():\n    return None"),
        ("def f(): stop()", "stop() -> pass", "def f():\n    pass"),
        ("class A:\n def f(s): s.x = 1", "-> pass", "class A:\n\n    def f(s):\n        pass"),
    ],
)
def test_each_operator_makes_one_small_change(source: str, part: str, expected: str) -> None:
    assert changed(source, part) == expected


def test_messages_docstrings_annotations_and_imports_stay_as_they_are() -> None:
    source = 'from a import b\ndef f(x: "int") -> "str":\n "doc"\n raise E(f"{x + 1} of {x}", 3)\n'
    assert [mutant.key for mutant in mutants_of(source)] == ["f | raise E(f'{x + 1} of {x}', 3) -> pass"]


def test_keys_are_unique_and_do_not_depend_on_the_line() -> None:
    keys = [mutant.key for mutant in mutants_of(SOURCE)]
    assert len(set(keys)) == len(keys) > 10
    assert [mutant.key for mutant in mutants_of("\n\n" + SOURCE)] == keys


class TestGraft:
    @pytest.fixture
    def module(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> object:
        (tmp_path / "grafted_sample.py").write_text(SOURCE)
        monkeypatch.syspath_prepend(tmp_path)
        yield importlib.import_module("grafted_sample")
        del sys.modules["grafted_sample"]

    @pytest.mark.parametrize(
        ("part", "expression", "expected"),
        [
            ("self.size <= LIMIT -> self.size < LIMIT", "Box(3).fits()", False),
            ("False -> True", "Box(9).fits()", False),
            ("self.size / 2 -> self.size * 2", "Box(3).half", 6),
            ("LIMIT: int = 3 | 3 -> 4", "Box(4).fits()", True),
            ("LIMIT: int = 3 | 3 -> 4", "TWICE", 8),
            ("size: int = 5 | 5 -> 6", "Box().size", 6),
            ("'red' -> 'red_'", "RED.value", "red_"),
        ],
    )
    def test_a_change_reaches_objects_that_were_imported_before(
        self, module, part: str, expression: str, expected: object
    ) -> None:
        names, red = {"Box": module.Box}, module.Colour.RED  # as another module has imported them
        [mutant] = [mutant for mutant in mutants_of(SOURCE) if part in mutant.key]
        graft(module, mutant)
        value = {
            "Box(3).fits()": lambda: names["Box"](3).fits(),
            "Box(9).fits()": lambda: names["Box"](9).fits(),
            "Box(4).fits()": lambda: names["Box"](4).fits(),
            "Box(3).half": lambda: names["Box"](3).half,
            "Box().size": lambda: names["Box"]().size,
            "TWICE": lambda: module.TWICE,
            "RED.value": lambda: red.value,
        }[expression]()
        assert value == expected


@pytest.mark.parametrize("module", sorted(plan.read_targets()))
def test_every_equivalent_names_a_mutant_that_there_is_and_every_test_file_exists(module: str) -> None:
    keys = {mutant.key for mutant in mutants_of(plan.source_of(module))}
    assert set(plan.read_equivalents().get(module, {})) <= keys
    assert all((REPOSITORY / file).is_file() for file in plan.read_targets()[module])


def test_every_equivalent_is_of_a_target_and_has_a_reason() -> None:
    equivalents = plan.read_equivalents()
    assert set(equivalents) <= set(plan.read_targets())
    assert all(len(reason) > 20 for reasons in equivalents.values() for reason in reasons.values())


class TestResults:
    def test_a_second_call_reads_what_the_first_has_found(self, tmp_path: Path) -> None:
        plan.Results(tmp_path, "edge.safety.supervisor").add("one", "killed")
        assert plan.Results(tmp_path, "edge.safety.supervisor").found == {"one": "killed"}

    def test_results_of_another_source_are_dropped(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        plan.Results(tmp_path, "edge.safety.supervisor").add("one", "killed")
        monkeypatch.setattr(plan, "source_of", lambda _: "changed")
        assert plan.Results(tmp_path, "edge.safety.supervisor").found == {}

    def test_a_row_counts_every_mutant_once(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(plan, "source_of", lambda _: "x = a < b\ny = c < d")
        killed, survived, same, missing = (mutant.key for mutant in mutants_of("x = a < b\ny = c < d"))
        row = plan.row_of("sample", {killed: "killed", survived: "survived"}, {same: "no difference"})
        assert row.text == "| `sample` | 4 | 1 | 1 | 1 | 1 |"
        assert row.survivors == (survived,) and missing not in row.survivors


@pytest.mark.slow
def test_the_command_kills_the_supervisors_mutants_and_a_second_call_has_nothing_left_to_run(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tools.mutants", "--module", "edge.safety.supervisor", "--out", str(tmp_path)]
    first = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=170, check=False)
    assert first.returncode == 0, first.stdout + first.stderr
    table = subprocess.run(
        [*command, "--table"], cwd=REPOSITORY, capture_output=True, text=True, timeout=300, check=False
    )
    assert table.returncode == 0 and "| `edge.safety.supervisor` |" in table.stdout
