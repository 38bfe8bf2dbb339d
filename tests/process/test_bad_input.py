"""Every command refuses bad input in one clear line, with a documented exit code, and leaves nothing half-written."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from edge.commands import COMMANDS
from tests.support.bad_input.commands import TABLE, TOOLS
from tests.support.bad_input.harness import Answer, Command, Servers, cases, prepare, run

REPOSITORY = Path(__file__).resolve().parents[2]
FEW = ("missing", "deep-list", "fifo", "loop", "not-utf8", "escape-name", "text ''")
"""Bad values of the quick test."""
WITHOUT_ARGUMENTS = ("tools.fault_table",)
ON_DEMAND = ("tools.bench.", "tools.can_trace.", "tools.fuzz", "tools.interop.", "tools.memory", "tools.mutants")
"""Measurements by hand, whose arguments only their author gives."""


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    """The harness's folder, with the good and the bad files; its path is short, because sockets lie in it."""
    with tempfile.TemporaryDirectory(prefix="bad-") as made:
        prepare(Path(made))
        yield Path(made)


@pytest.fixture(scope="module")
def servers() -> Iterator[Servers]:
    with Servers() as made:
        yield made


def placed(command: Command, artifacts: Path) -> Command:
    """Put the artifact directory into the command lines of a row."""
    good, quick = (text.replace("{artifacts}", str(artifacts)) for text in (command.good, command.quick))
    return replace(command, good=good, quick=quick)


def describe(answers: list[Answer]) -> str:
    return "\n".join(f"{a.case.what}: {'; '.join(a.faults)}: {a.err[-300:]!r}" for a in answers if a.faults)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("command", [*TABLE, *TOOLS], ids=lambda command: command.name)
def test_every_bad_input_is_refused_in_one_clear_line(
    command: Command, folder: Path, servers: Servers, artifacts_dir: Path
) -> None:
    command = placed(command, artifacts_dir)
    answers = run(command, folder, list(cases(command, folder)), servers)
    assert not any(answer.faults for answer in answers), describe(answers)


def test_a_few_bad_inputs_of_the_operators_commands(folder: Path, servers: Servers) -> None:
    for command in TABLE:
        if command.name in ("edge-bridge status", "edge-say"):
            quick = replace(command, name=f"{command.name} quick")
            chosen = [case for case in cases(quick, folder) if case.bad.label in FEW]
            answers = run(quick, folder, chosen, servers)
            assert len(answers) >= 5 and not any(answer.faults for answer in answers), describe(answers)


def test_every_console_script_has_at_least_thirty_bad_inputs(folder: Path) -> None:
    counts: dict[str, int] = {}
    for command in TABLE:
        name = command.name.split()[0]
        counts[name] = counts.get(name, 0) + len(list(cases(placed(command, folder), folder)))
    assert set(counts) == {*COMMANDS, "edge-bridge"} and min(counts.values()) >= 30, counts


def test_every_documented_program_has_a_row() -> None:
    pages = [REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", *(REPOSITORY / "docs").glob("*.md")]
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    documented = {name.rstrip(".") for name in re.findall(r"python -m ((?:tools|edge)\.[a-z_.0-9]+)", text)}
    known = {command.name.split()[0] for command in TOOLS}
    assert {name for name in documented if not name.startswith(ON_DEMAND)} - {*WITHOUT_ARGUMENTS} <= known
