"""Console scripts and documented `python -m` names: each can be imported, and each old name names its new one."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module

import pytest

from tests.support.processes import REPOSITORY

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

SCRIPTS: dict[str, str] = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["scripts"]
RENAMED = {
    "edge.flight_logs": "edge.flightlog.cleanup",
    "sim_hil.can.drive": "sim_hil.protocols.can.drive",
    "tools.findings_models": "tools.findings.models",
}


@pytest.mark.parametrize("target", SCRIPTS.values(), ids=SCRIPTS.keys())
def test_a_console_script_has_its_function(target: str) -> None:
    module, _, function = target.partition(":")
    assert callable(getattr(import_module(module), function))


@pytest.mark.parametrize(("old", "new"), RENAMED.items())
def test_an_old_command_name_still_works_and_names_the_new_one(old: str, new: str) -> None:
    command = [sys.executable, "-m", old, "--help"]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0 and "usage:" in done.stdout
    assert done.stderr == f"{old}: this command is now python -m {new}\n"
