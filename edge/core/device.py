"""The device that the program runs on, read from the files of Linux and Jetson; the root can be another folder."""

from __future__ import annotations

import importlib.metadata
import platform
import re
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

TENSORRT, CUDA, OPENVINO = "TensorrtExecutionProvider", "CUDAExecutionProvider", "OpenVINOExecutionProvider"
_PACKAGES = {
    TENSORRT: ("tensorrt", "tensorrt-cu12", "tensorrt-cu13"),
    OPENVINO: ("openvino", "onnxruntime-ep-openvino", "onnxruntime-openvino"),
}
_ACCELERATED = (TENSORRT, CUDA)
_LIBRARIES = {TENSORRT: "libnvinfer.so.*"}
_LIBRARY_FOLDERS = ("usr/lib/aarch64-linux-gnu", "usr/lib/x86_64-linux-gnu", "usr/local/lib")


class DeviceError(ValueError):
    """The device is not the required one; the message is one line."""


@dataclass(frozen=True)
class DeviceFacts:
    """All inputs of a compiled engine besides the model; none depends on the power mode."""

    architecture: str
    device: str
    """Name of the computing device: the Jetson module, else the graphics card; the processor for its providers."""
    l4t: str | None
    """Jetson Linux release, e.g. `36.4.3`."""
    onnxruntime: str
    provider_version: str | None
    """Version of TensorRT or OpenVINO; None if unavailable."""

    def to_dict(self) -> dict[str, str | None]:
        """Plain JSON form."""
        return asdict(self)


def package_version(name: str) -> str | None:
    """Return the version of an installed Python package; None without it."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _onnxruntime_version() -> str:
    import onnxruntime as ort  # an extra

    return str(ort.__version__)


def available_providers() -> list[str]:
    """Return the execution providers of this ONNX Runtime."""
    try:
        import onnxruntime as ort  # an extra
    except ModuleNotFoundError:
        return []
    return list(ort.get_available_providers())


def shares_device(providers: Iterable[str], others: Iterable[str]) -> bool:
    """Return whether both lists use one accelerator, on which calls wait for each other whatever the cores."""
    return any(p in _ACCELERATED for p in providers) and any(p in _ACCELERATED for p in others)


def read_device(
    provider: str, root: Path = Path("/"), version_of: Callable[[str], str | None] = package_version
) -> DeviceFacts:
    """Read the facts of the device that a provider's engines depend on, below `root`."""
    return DeviceFacts(
        architecture=platform.machine(),
        device=_device(provider, root) or "unknown",
        l4t=l4t_release(_text(root / "etc/nv_tegra_release")),
        onnxruntime=_onnxruntime_version(),
        provider_version=_provider_version(provider, root, version_of),
    )


def l4t_release(text: str) -> str | None:
    """Return `36.4.3` from the first line of `/etc/nv_tegra_release`; None for another text."""
    found = re.search(r"R(\d+) \(release\), REVISION: ([\d.]+)", text)
    return f"{found[1]}.{found[2]}" if found else None


def _device(provider: str, root: Path) -> str | None:
    if provider in (TENSORRT, CUDA):
        return _board(root) or _graphics_card(root)
    return _processor(root)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


def _board(root: Path) -> str | None:
    """Return the compatible string of a Jetson module, e.g. `nvidia,p3767-0000`."""
    names = _text(root / "proc/device-tree/compatible").split("\0")
    return next((name for name in names if re.fullmatch(r"nvidia,p\d{4}-\d{4}.*", name)), None)


def _graphics_card(root: Path) -> str | None:
    cards = sorted((root / "proc/driver/nvidia/gpus").glob("*/information"))
    models = [re.search(r"^Model:\s*(.+?)\s*$", _text(card), re.MULTILINE) for card in cards]
    return next((model[1] for model in models if model), None)


def _processor(root: Path) -> str | None:
    found = re.search(r"^(?:model name|Model|CPU part)\s*:\s*(.+?)\s*$", _text(root / "proc/cpuinfo"), re.MULTILINE)
    return found[1] if found else None


def _provider_version(provider: str, root: Path, version_of: Callable[[str], str | None]) -> str | None:
    for package in _PACKAGES.get(provider, ()):
        version = version_of(package)
        if version is not None:
            return version
    pattern = _LIBRARIES.get(provider)
    if pattern is None:
        return None
    libraries = [path.name for folder in _LIBRARY_FOLDERS for path in (root / folder).glob(pattern)]
    versions = [name.partition(".so.")[2] for name in libraries]
    # libnvinfer.so.10 is a link to libnvinfer.so.10.3.0: the longest name has the whole version.
    return max(versions, key=len, default=None)


def check_power_mode(wanted: str, *, conf: str, query: str) -> None:
    """Raise DeviceError unless the board has a mode of that name and is in it; ids differ between modules.

    `conf`: text of an `nvpmodel` configuration; `query`: what `nvpmodel -q` prints.
    """
    found = re.findall(r"<\s*POWER_MODEL\s+ID=(\d+)\s+NAME=(\S+)\s*>", conf)
    modes = {name: number for number, name in found}
    answer = re.search(r"^\s*NV Power Mode:\s*(\S+)\s*$", query, re.MULTILINE)
    current = answer[1] if answer else None
    if wanted not in modes:
        raise DeviceError(
            f"power mode {wanted!r} is not on this board; it has {', '.join(modes) or 'none'}: export for one of these "
            f"with --set power.mode=NAME"
        )
    if current != wanted:
        raise DeviceError(
            f"power mode is {current or 'not reported'}, the plan was made for {wanted}: "
            f"sudo nvpmodel -m {modes[wanted]}"
        )
