"""Device nodes that an execution provider computes through, as they are on this machine (facts: edge hardware, 2)."""

from __future__ import annotations

import grp
import stat
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from edge.device import CUDA, OPENVINO, TENSORRT

_NVIDIA: Final = (
    # Jetson, whose graphics processor is part of the module.
    "nvmap",
    "nvhost-*",
    "nvgpu/*/*",
    "nvsciipc",
    # Graphics cards.
    "nvidia[0-9]*",
    "nvidiactl",
    "nvidia-uvm",
    "nvidia-uvm-tools",
    "nvidia-modeset",
)
PATTERNS: Final[Mapping[str, Sequence[str]]] = {CUDA: _NVIDIA, TENSORRT: _NVIDIA, OPENVINO: ("dri/renderD*",)}
_EVERYBODY = stat.S_IROTH | stat.S_IWOTH


@dataclass(frozen=True)
class DeviceNode:
    """One node below /dev."""

    path: Path
    """As the machine names it, without the root that it was looked for in."""
    group: str | None
    """Group that may open it; None if everybody may, or the group has no name."""


def device_nodes(providers: Sequence[str], root: Path = Path("/")) -> list[DeviceNode]:
    """Nodes of these providers that exist; none for a provider that computes on the processor."""
    found: dict[Path, DeviceNode] = {}
    for pattern in dict.fromkeys(pattern for provider in providers for pattern in PATTERNS.get(provider, ())):
        for path in sorted((root / "dev").glob(pattern)):
            status = path.stat()
            if stat.S_ISDIR(status.st_mode):
                continue
            everybody = status.st_mode & _EVERYBODY == _EVERYBODY
            named = Path("/") / path.relative_to(root)
            found[named] = DeviceNode(named, None if everybody else _group(status.st_gid))
    return [found[path] for path in sorted(found)]


def _group(number: int) -> str | None:
    try:
        return grp.getgrgid(number).gr_name
    except KeyError:
        return None
