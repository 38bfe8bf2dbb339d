"""Who may import whom (design §4)."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
WORKSHOP = {"torch", "pybullet", "transformers", "matplotlib", "export", "calib", "sim_hil", "tools"}
ONBOARD = sorted([*(ROOT / "edge").rglob("*.py"), *(ROOT / "firmware_bridge").rglob("*.py")])


def imports(path: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
    return found


@pytest.mark.parametrize("path", ONBOARD, ids=lambda p: str(p.relative_to(ROOT)))
def test_onboard_code_imports_nothing_of_the_workshop(path: Path) -> None:
    assert not {name.split(".")[0] for name in imports(path)} & WORKSHOP


@pytest.mark.parametrize("path", sorted((ROOT / "firmware_bridge").rglob("*.py")), ids=lambda p: p.name)
def test_the_bridge_knows_neither_the_runner_nor_any_machine_learning(path: Path) -> None:
    assert not {name.split(".")[0] for name in imports(path)} & {"edge", "numpy", "onnxruntime", "cv2", "tokenizers"}


@pytest.mark.parametrize("module", ["edge.runner", "firmware_bridge", "firmware_bridge.bridge"])
def test_importing_it_pulls_in_neither_torch_nor_pybullet(module: str) -> None:
    code = f"import {module}, sys; sys.exit(bool({{'torch', 'pybullet'}} & set(sys.modules)))"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


@pytest.mark.parametrize("module", ["edge.runner", "export.gate_run", "calib.power", "tools.bench.tick"])
def test_onnx_runtime_is_told_to_keep_no_telemetry_before_it_is_imported(module: str) -> None:
    code = (
        f"import os, sys; os.environ.pop('ORT_DISABLE_TELEMETRY', None); import {module}; names = list(sys.modules); "
        "assert names.index('edge') < names.index('onnxruntime') and os.environ['ORT_DISABLE_TELEMETRY'] == '1'"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
