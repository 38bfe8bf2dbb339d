"""What all command lines share: exit codes, result files, parts that are not installed."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

import pytest

from edge.core.cli import EXIT_BAD_INPUT, check_result_target, run_with_extra, write_result
from tests.support.processes import REPOSITORY

with (REPOSITORY / "pyproject.toml").open("rb") as _file:
    COMMANDS = sorted(entry.split(":")[0] for entry in tomllib.load(_file)["project"]["scripts"].values())


@pytest.mark.parametrize("module", COMMANDS)
def test_every_command_has_help_with_examples_and_exit_codes(module: str) -> None:
    code = f"import sys; from {module} import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", code, "--help"], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0
    assert "examples:" in done.stdout
    assert "exit codes:" in done.stdout


def test_a_part_with_missing_packages_names_the_install_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "needs_much.py").write_text("import package_that_is_not_installed\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert run_with_extra("edge-x", "needs_much", "much") == EXIT_BAD_INPUT
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert "package_that_is_not_installed" in line
    assert "pip install 'tic-vla-edge[much]'" in line


def test_a_result_is_written_whole_and_nothing_else_is_left(tmp_path: Path) -> None:
    target = tmp_path / "new" / "result.json"
    check_result_target(str(target))
    write_result(str(target), {"a": 1})
    assert json.loads(target.read_text()) == {"a": 1}
    assert [p.name for p in target.parent.iterdir()] == ["result.json"]


@pytest.mark.parametrize("bad", ["", ".", "/", "/dev/null/result.json"])
def test_a_place_that_no_file_can_be_written_to_is_refused_beforehand(bad: str) -> None:
    with pytest.raises(OSError, match="--json"):
        check_result_target(bad)
