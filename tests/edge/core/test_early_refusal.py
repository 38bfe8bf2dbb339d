"""Bad arguments are refused before a command loads torch or the simulation, and leave nothing behind."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from edge.commands import ARGUMENTS
from sim_hil.hil.arguments import MAX_PEOPLE as MAX_PEOPLE_OF_HIL
from sim_hil.soak.arguments import MAX_PEOPLE

SLOW_TO_LOAD = ("torch", "pybullet", "matplotlib", "ray", "onnxruntime")
REFUSED = {
    "edge-export": ["--model", "nope", "--dry-run"],
    "edge-hil": ["--robot", "go2", "--scene", "nope", "--protocol", "unitree"],
    "edge-bench": ["--suite", "nope", "--policy", "expert"],
    "edge-soak": ["--artifacts", "nope", "--duration", "1m", "--out", "nope", "--scene", "nope"],
    "edge-train": ["sft", "--out", "nope", "--device", "nope"],
}


@pytest.mark.parametrize("command", ARGUMENTS)
def test_a_bad_argument_is_refused_without_the_slow_packages(command: str) -> None:
    code = (
        f"import sys; sys.argv = {[command, *REFUSED[command]]!r}\n"
        "from edge.commands import run\n"
        f"code = run({command!r})\n"
        f"print(code, [name for name in {SLOW_TO_LOAD!r} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=300)
    assert done.stdout == "2 []\n"
    assert done.stderr.startswith(f"{command}: ") and done.stderr.count("\n") == 1 and "nope" in done.stderr


SOAK = "edge-soak --artifacts nope --out new --duration 1m"
REFUSED_VALUES = {
    "edge-export --out foreign": "foreign/manifest.json",
    "edge-export --out new --checkpoint nope": "--checkpoint nope: no such file",
    "edge-export --out new --calibration nope": "calibration set 'nope' is not known",
    f"{SOAK} --people 99999999999999999999": "--people: expected 0 to 500, found 99999999999999999999",
    f"{SOAK} --people=-1": "--people: expected 0 to 500, found -1",
    f"{SOAK} --seed 99999999999999999999": "--seed: expected 0 to 9223372036854775807",
    f"{SOAK} --duration 1s": "--duration: expected 15 s to 30 days, found 1 s",
    f"{SOAK} --leg 2d": "--leg: expected 15 s to a day",
    "edge-bench --suite dynanav --policy expert --out foreign": "--out foreign: expected a new or empty directory",
    "edge-bench compare foreign nope": "foreign/config.json: expected the configuration of a benchmark run",
    "edge-bench report foreign": "foreign/config.json: expected the configuration of a benchmark run",
    "edge-train sft --out foreign": "foreign: expected a new or empty directory",
}


@pytest.mark.parametrize("line", REFUSED_VALUES)
def test_a_bad_value_is_refused_before_the_slow_packages_load(line: str, tmp_path: Path) -> None:
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "mine").touch()
    command, *arguments = line.split()
    code = (
        f"import sys; sys.argv = {[command, *arguments]!r}\n"
        "from edge.commands import run\n"
        f"code = run({command!r})\n"
        f"print(code, [name for name in {SLOW_TO_LOAD!r} if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True, timeout=300
    )
    assert done.stdout == "2 []\n"
    assert done.stderr.startswith(command) and done.stderr.count("\n") == 1 and REFUSED_VALUES[line] in done.stderr
    assert [path.name for path in tmp_path.rglob("*")] == ["foreign", "mine"]


def test_a_soak_accepts_as_many_people_as_its_simulator() -> None:
    assert MAX_PEOPLE == MAX_PEOPLE_OF_HIL
