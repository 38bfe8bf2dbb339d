"""Check of the ONNX Runtime packages: several provide one module, and the last one installed silently wins."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from edge.core.device import CUDA, OPENVINO, TENSORRT
from edge.deploy.doctor.check import Check, Level

PACKAGES: Final = ("onnxruntime", "onnxruntime-gpu", "onnxruntime-openvino")
JETSON_INDEX: Final = "https://pypi.jetson-ai-lab.io/jp6/cu126/+simple/"
"""NVIDIA's index of packages for JetPack 6 (edge hardware facts); PyPI has no GPU build for arm64."""
_LIBRARIES: Final = {
    TENSORRT: ("libnvinfer.so*", "sudo apt-get install nvidia-jetpack"),
    CUDA: ("libcudart.so*", "sudo apt-get install nvidia-jetpack"),
}
_FOLDERS: Final = ("usr/lib/aarch64-linux-gnu", "usr/lib/x86_64-linux-gnu", "usr/local/cuda/lib64", "usr/local/lib")


def onnx_runtime(
    providers: Sequence[str],
    available: Sequence[str],
    version_of: Callable[[str], str | None],
    machine: str,
    root: Path = Path("/"),
) -> Check:
    """Check that one package provides the module and has every provider of the artifacts; `providers` may be empty."""
    name, expected = "ONNX Runtime", f"one package with {', '.join(providers) or 'any provider'}"
    installed = [f"{package} {version}" for package in PACKAGES if (version := version_of(package)) is not None]
    found = f"{', '.join(installed) or 'no package'}; providers {', '.join(available)}"
    wanted = "onnxruntime-openvino" if OPENVINO in providers else "onnxruntime-gpu"
    accelerated = any(provider in (TENSORRT, CUDA, OPENVINO) for provider in providers)
    reinstall = f"pip install --force-reinstall {_source(wanted if accelerated else 'onnxruntime', machine)}"
    if not available:
        return Check(name, Level.FAIL, "the module onnxruntime is missing", expected, reinstall)
    if len(installed) > 1:
        names = " ".join(package.split()[0] for package in installed)
        return Check(name, Level.FAIL, found, expected, f"pip uninstall -y {names}; {reinstall}")
    for provider in providers:
        pattern, advice = _LIBRARIES.get(provider, ("", ""))
        if pattern and not any(any((root / folder).glob(pattern)) for folder in _FOLDERS):
            return Check(name, Level.FAIL, f"no {pattern} for {provider}", expected, advice)
    if not set(providers) <= set(available):
        names = " ".join(package.split()[0] for package in installed)
        remove = f"pip uninstall -y {names}; " if installed else ""
        return Check(name, Level.FAIL, found, expected, remove + reinstall)
    return Check(name, Level.OK, found, expected)


def _source(package: str, machine: str) -> str:
    """Return pip's arguments for a package: on arm64 the GPU build comes from NVIDIA's index."""
    from_nvidia = package == "onnxruntime-gpu" and machine == "aarch64"
    return f"--index-url {JETSON_INDEX} {package}" if from_nvidia else package
