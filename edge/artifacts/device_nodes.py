"""Device nodes that an execution provider computes through, as they are on this machine (facts: edge hardware, 2).

The list for a Jetson is read in public sources, one named on each line. It was not tested on a board.
"""

from __future__ import annotations

import grp
import os
import stat
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from edge.core.device import CUDA, OPENVINO, TENSORRT


@dataclass(frozen=True)
class NodePattern:
    """A glob below /dev and the public source that names it."""

    glob: str
    source: str


_DRI_RENDER: Final = "dri/renderD*"
"""DRM render nodes. The cards (`dri/card*`) belong to the display and stay closed."""
_NVIDIA: Final = (
    # Jetson, whose graphics processor is part of the module. Sources are for L4T R35 and R36; not tested on a board.
    NodePattern("nvmap", "canonical/snapd nvidia_tegra_drivers_support.go; NVIDIA/NemoClaw #4231 (cuInit on an Orin)"),
    NodePattern("host1x-fence", "canonical/snapd nvidia_tegra_drivers_support.go (fences; opened by cuInit on R36)"),
    NodePattern(_DRI_RENDER, "wendylabsinc/WendyOS #1699 (Orin NX, JetPack 6.2: without it cuInit returns 801)"),
    NodePattern("nvgpu/*/*", "canonical/snapd nvidia_tegra_drivers_support.go: igpu0 as, channel, ctrl, power, sched"),
    NodePattern("nvhost-*", "nvidia-holoscan/holoscan-sdk dockerutils.py; OE4T/meta-tegra #230 (NVIDIA's l4t.csv)"),
    NodePattern("nvsciipc", "NVIDIA/NemoClaw #8910 (its list of Tegra nodes); NVIDIA's devices.csv of R36"),
    # Graphics cards; JetPack 6 has the first two as well (OE4T/meta-tegra #1038).
    NodePattern("nvidia[0-9]*", "NVIDIA driver README, chapter 'Device files'"),
    NodePattern("nvidiactl", "NVIDIA driver README, chapter 'Device files'"),
    NodePattern("nvidia-uvm", "NVIDIA driver README, chapter 'Device files'"),
    NodePattern("nvidia-uvm-tools", "NVIDIA driver README, chapter 'Device files'"),
    NodePattern("nvidia-modeset", "nvidia-holoscan/holoscan-sdk dockerutils.py"),
)
PATTERNS: Final[Mapping[str, Sequence[NodePattern]]] = {
    CUDA: _NVIDIA,
    TENSORRT: _NVIDIA,
    OPENVINO: (NodePattern(_DRI_RENDER, "Linux kernel, Documentation/gpu/drm-uapi.rst, 'Render nodes'"),),
}
_EVERYBODY = stat.S_IROTH | stat.S_IWOTH


@dataclass(frozen=True)
class DeviceNode:
    """One node below /dev."""

    path: Path
    """As the machine names it, without the root that it was looked for in."""
    group: str | None
    """Group that may open it; None if everybody may, or if only root's group may."""


def device_nodes(providers: Sequence[str], root: Path = Path("/")) -> list[DeviceNode]:
    """Nodes of these providers that exist; none for a provider that computes on the processor."""
    found: dict[Path, DeviceNode] = {}
    patterns = (pattern for provider in providers for pattern in PATTERNS.get(provider, ()))
    for pattern in dict.fromkeys(pattern.glob for pattern in patterns):
        for path in sorted((root / "dev").glob(pattern)):
            status = path.stat()
            if stat.S_ISDIR(status.st_mode):
                continue
            named = Path("/") / path.relative_to(root)
            found[named] = DeviceNode(named, group_of(status))
    return [found[path] for path in sorted(found)]


def group_of(status: os.stat_result) -> str | None:
    """Group that a user has to join to open a node; None where that changes nothing.

    Root's own group never counts: with it the runner could read files of the system's administration.
    """
    if status.st_mode & _EVERYBODY == _EVERYBODY or status.st_gid == 0:
        return None
    try:
        return grp.getgrgid(status.st_gid).gr_name
    except KeyError:
        return None
