"""Bad arguments are refused before a command loads torch or the simulation."""

from __future__ import annotations

import subprocess
import sys

import pytest

from edge.commands import ARGUMENTS

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
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout == "2 []\n"
    assert done.stderr.startswith(f"{command}: ") and done.stderr.count("\n") == 1 and "nope" in done.stderr
