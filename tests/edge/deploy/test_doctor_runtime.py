"""The doctor's check of the ONNX Runtime packages: two at once, a CPU build for a GPU target, missing libraries."""

from __future__ import annotations

from pathlib import Path

import pytest

from edge.core.device import CUDA, TENSORRT
from edge.deploy.doctor.check import Check, Level
from edge.deploy.doctor.runtime import JETSON_INDEX, onnx_runtime
from edge.inference.graph import CPU_PROVIDER

GPU = (TENSORRT, CUDA, CPU_PROVIDER)
LIBRARIES = ("libnvinfer.so.10", "libcudart.so.12")


def check(
    root: Path, packages: dict[str, str], available: tuple[str, ...], libraries: tuple[str, ...] = LIBRARIES
) -> Check:
    folder = root / "usr/lib/aarch64-linux-gnu"
    folder.mkdir(parents=True)
    for library in libraries:
        (folder / library).touch()
    return onnx_runtime((TENSORRT, CUDA), available, packages.get, "aarch64", root)


def test_one_gpu_build_is_right(tmp_path: Path) -> None:
    assert check(tmp_path, {"onnxruntime-gpu": "1.23.0"}, GPU).level is Level.OK


def test_two_packages_at_once_are_refused_with_the_command_that_mends_it(tmp_path: Path) -> None:
    found = check(tmp_path, {"onnxruntime-gpu": "1.23.0", "onnxruntime": "1.31.1"}, GPU)
    assert found.level is Level.FAIL
    assert "pip uninstall -y onnxruntime onnxruntime-gpu" in found.advice and JETSON_INDEX in found.advice


def test_a_cpu_build_is_refused_for_a_gpu_target(tmp_path: Path) -> None:
    found = check(tmp_path, {"onnxruntime": "1.31.1"}, (CPU_PROVIDER,))
    assert found.level is Level.FAIL
    assert "pip uninstall -y onnxruntime;" in found.advice and "onnxruntime-gpu" in found.advice


@pytest.mark.parametrize("library", LIBRARIES)
def test_a_missing_library_is_named(tmp_path: Path, library: str) -> None:
    rest = tuple(name for name in LIBRARIES if name != library)
    found = check(tmp_path, {"onnxruntime-gpu": "1.23.0"}, GPU, rest)
    assert found.level is Level.FAIL and library.split(".")[0] in found.found and "nvidia-jetpack" in found.advice


def test_the_cpu_build_is_right_for_a_cpu_target(tmp_path: Path) -> None:
    found = onnx_runtime((CPU_PROVIDER,), (CPU_PROVIDER,), {"onnxruntime": "1.31.1"}.get, "x86_64", tmp_path)
    assert found.level is Level.OK


def test_a_missing_module_is_a_failed_check_that_names_the_package(tmp_path: Path) -> None:
    found = onnx_runtime((), (), {}.get, "x86_64", tmp_path)
    assert found.level is Level.FAIL and found.advice.endswith("pip install --force-reinstall onnxruntime")
