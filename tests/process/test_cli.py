"""What all command lines share: exit codes, result files, parts that are not installed."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from edge.commands import ARGUMENTS, COMMANDS
from edge.core.cli import EXIT_BAD_INPUT, check_result_target, run_with_extra, write_result

MODULES = [*sorted(module for module, _ in COMMANDS.values()), "firmware_bridge.bridge"]
# Refuses the import of what the robot's base install lacks, in a fresh interpreter.
BASE_ONLY = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {"cyclonedds", "onnxruntime", "torch", "pybullet", "can", "pymavlink", "jinja2"}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent())
"""


@pytest.mark.parametrize("module", MODULES)
def test_every_command_has_help_with_examples_and_exit_codes(
    module: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [module, "--help"])
    with pytest.raises(SystemExit) as ended:
        sys.exit(import_module(module).main())
    text = capsys.readouterr().out
    assert ended.value.code == 0 and "examples:" in text and "exit codes:" in text


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


def base_only(command: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    run = "from firmware_bridge.bridge import main" if command == "edge-bridge" else "from edge.commands import run"
    call = "main()" if command == "edge-bridge" else f"run({command!r})"
    code = f"{BASE_ONLY}\nsys.argv = {[command, *arguments]!r}\n{run}\nsys.exit({call})"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.parametrize("command", [*COMMANDS, "edge-bridge"])
def test_version_needs_none_of_the_extras(command: str) -> None:
    done = base_only(command, "--version")
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(rf"{command} \d+\.\d+\.\d+ \(commit \S+, artifact schema \d+\)\n", done.stdout)


@pytest.mark.parametrize(
    ("command", "extra"),
    [
        ("edge-run --help", "cpu"), ("edge-calib --help", "cpu"), ("edge-export --dry-run", "export"),
        ("edge-hil --robot go2 --scene corridor --protocol unitree", "sim"),
        ("edge-bench --suite dynanav --policy expert", "sim"),
        ("edge-soak --artifacts none --duration 1m --out none", "sim"), ("edge-train sft --out none", "train"),
    ],
)  # fmt: skip
def test_a_missing_extra_is_one_line_that_names_it(command: str, extra: str) -> None:
    done = base_only(*command.split())
    assert done.returncode == EXIT_BAD_INPUT
    assert done.stderr.count("\n") == 1 and f"pip install 'tic-vla-edge[{extra}]'" in done.stderr


@pytest.mark.parametrize("command", ["edge-say", "edge-bridge", "edge-install", "edge-doctor", *ARGUMENTS])
def test_help_works_in_the_base_install(command: str) -> None:
    done = base_only(command, "--help")
    assert done.returncode == 0 and "usage:" in done.stdout, done.stderr


def test_a_bridge_without_a_dds_binding_names_the_command_that_installs_it(tmp_path: Path) -> None:
    done = base_only("edge-bridge", "--robot", "firmware_bridge/robots/go2_sim.toml", "--socket", str(tmp_path / "s"))
    assert done.returncode == EXIT_BAD_INPUT
    assert done.stderr.count("\n") == 1 and "edge-install dds" in done.stderr


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
