"""Import rules: between top-level packages, between folders, and what onboard code may load (`floors.toml`)."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
FLOORS = tomllib.loads((Path(__file__).parent / "floors.toml").read_text(encoding="utf-8"))
PACKAGES: list[str] = FLOORS["packages"]
FOLDERS: dict[str, list[str]] = FLOORS["folders"]
MOST_ENTRIES = 16
"""Modules and sub-packages in one folder, its `__init__.py` not counted."""

WORKSHOP = {
    "torch",
    "pybullet",
    "transformers",
    "matplotlib",
    "jinja2",
    "tomli_w",
    "reporting",
    "export",
    "calib",
    "sim_hil",
    "tools",
}
ONBOARD = sorted([*(ROOT / "edge").rglob("*.py"), *(ROOT / "firmware_bridge").rglob("*.py")])
PYTHON = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
PACKAGE_FOLDERS = sorted({path.parent for path in PYTHON})


@cache
def imports(path: Path) -> frozenset[str]:
    """Modules that a file imports anywhere: at its top, inside functions, for type checking."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.module and not node.level, f"{path}:{node.lineno}: expected an absolute import"
            found |= {_module(node.module, alias.name) for alias in node.names}
    return frozenset(found)


@cache
def _module(package: str, name: str) -> str:
    """`from package import name` takes the module package.name, or a value of the module `package`."""
    stem = ROOT.joinpath(*package.split("."), name)
    return f"{package}.{name}" if stem.with_suffix(".py").is_file() or stem.is_dir() else package


@cache
def folder_of(module: str) -> str:
    """The folder of a module of ours, relative to the repository: `edge/core` for `edge.core.stats` and `edge.core`."""
    stem = ROOT.joinpath(*module.split("."))
    return (stem if stem.is_dir() else stem.parent).relative_to(ROOT).as_posix()


def floor_of(folder: str) -> tuple[int, int]:
    """Height of a folder: that of its package, then its own within the package."""
    package, _, rest = folder.partition("/")
    return PACKAGES.index(package), FOLDERS[package].index(rest or ".")


@cache
def is_bare(module: str) -> bool:
    """Whether it is a package whose `__init__.py` imports nothing of ours: naming it depends on no module in it."""
    init = ROOT.joinpath(*module.split("."), "__init__.py")
    return init.is_file() and not any(name.partition(".")[0] in PACKAGES for name in imports(init))


def ids(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("folder", [f for f in PACKAGE_FOLDERS if not f.is_relative_to(ROOT / "tests")], ids=ids)
def test_a_folder_imports_only_from_the_floors_below_it(folder: Path) -> None:
    here = floor_of(ids(folder))
    for path in sorted(folder.glob("*.py")):
        for name in imports(path):
            if name.partition(".")[0] not in PACKAGES or is_bare(name):
                continue
            if (there := folder_of(name)) != ids(folder):
                assert not there.startswith("tests"), f"{ids(path)} imports {name}"
                assert floor_of(there) < here, f"{ids(path)} imports {name} of a higher floor; see tests/floors.toml"


def test_every_folder_has_its_floor_and_every_floor_its_folder() -> None:
    listed = {f"{package}/{name}" if name != "." else package for package, names in FOLDERS.items() for name in names}
    assert listed == {ids(folder) for folder in PACKAGE_FOLDERS if not folder.is_relative_to(ROOT / "tests")}


@pytest.mark.parametrize("folder", PACKAGE_FOLDERS, ids=ids)
def test_a_folder_has_a_docstring_and_stays_small(folder: Path) -> None:
    init = folder / "__init__.py"
    assert init.is_file() and ast.get_docstring(ast.parse(init.read_text(encoding="utf-8"))), f"{ids(init)}: docstring"
    modules = [path for path in folder.glob("*.py") if path != init]
    packages = [path for path in folder.iterdir() if (path / "__init__.py").is_file()]
    assert len(modules) + len(packages) <= MOST_ENTRIES


@pytest.mark.parametrize("path", ONBOARD, ids=ids)
def test_onboard_code_imports_nothing_of_the_workshop(path: Path) -> None:
    assert not {name.split(".")[0] for name in imports(path)} & WORKSHOP


@pytest.mark.parametrize("path", sorted((ROOT / "firmware_bridge").rglob("*.py")), ids=ids)
def test_the_bridge_knows_neither_the_runner_nor_any_machine_learning(path: Path) -> None:
    assert not {name.split(".")[0] for name in imports(path)} & {"edge", "numpy", "onnxruntime", "cv2", "tokenizers"}


@pytest.mark.parametrize("module", ["edge.run.command", "firmware_bridge", "firmware_bridge.bridge"])
def test_importing_it_pulls_in_neither_torch_nor_pybullet(module: str) -> None:
    code = f"import {module}, sys; sys.exit(bool({{'torch', 'pybullet'}} & set(sys.modules)))"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=300)


@pytest.mark.parametrize("module", ["tools.train.collect.worker", "tools.train.encoder.worker"])
def test_a_worker_that_draws_pictures_starts_without_torch(module: str) -> None:
    """A new process records every layout: torch's import takes as long as a tour."""
    code = f"import {module}, sys; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=300)


SLOW_IMPORTS = [pytest.param(name, marks=pytest.mark.slow) for name in ("export.evaluation.gates", "tools.bench.tick")]


@pytest.mark.parametrize("module", ["edge.run.command", "calib.power", *SLOW_IMPORTS])
def test_onnx_runtime_is_told_to_keep_no_telemetry_before_it_is_imported(module: str) -> None:
    code = (
        f"import os, sys; os.environ.pop('ORT_DISABLE_TELEMETRY', None); import {module}; names = list(sys.modules); "
        "assert names.index('edge') < names.index('onnxruntime') and os.environ['ORT_DISABLE_TELEMETRY'] == '1'"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=300)
