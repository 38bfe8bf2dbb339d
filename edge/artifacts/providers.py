"""Execution providers: the options that a manifest may give them, and the device nodes that they compute through.

Some providers load code from a path in their options (TensorRT's plug-ins, a CUDA graph's external libraries), and a
data file of an artifact directory may hold anything: so no option names a file. The folders of engines come from
`edge.inference.engines`. The nodes of a Jetson are read in public sources, one named on each line (facts: edge
hardware, 2); they were not tested on a board.
"""

from __future__ import annotations

import grp
import json
import os
import re
import stat
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from edge.core.device import CUDA, OPENVINO, TENSORRT

ALLOWED: Final[Mapping[str, frozenset[str]]] = {
    TENSORRT: frozenset({
        "trt_builder_optimization_level", "trt_context_memory_sharing_enable", "trt_engine_cache_enable",
        "trt_fp16_enable", "trt_int8_enable", "trt_layer_norm_fp32_fallback", "trt_max_workspace_size",
        "trt_profile_max_shapes", "trt_profile_min_shapes", "trt_profile_opt_shapes", "trt_timing_cache_enable",
    }),
    CUDA: frozenset({
        "arena_extend_strategy", "cudnn_conv_algo_search", "cudnn_conv_use_max_workspace",
        "do_copy_in_default_stream", "gpu_mem_limit", "prefer_nhwc", "use_tf32",
    }),
    OPENVINO: frozenset({"device_type", "inference_precision", "num_of_threads", "num_streams", "precision"}),
}  # fmt: skip
"""Permitted options: those of the shipped targets, and similar ones for users' targets."""
_VALUE: Final = re.compile(r"[A-Za-z0-9_.:,+-]{0,4096}", re.ASCII)


def wrong_option(provider: str, options: Mapping[str, str]) -> str | None:
    """Return the defect of a provider's options, for a message; None for valid options."""
    allowed = ALLOWED.get(provider, frozenset())
    for key, value in options.items():
        if key not in allowed:
            return f"option {key!r} of {provider} is not one that the runner passes on; expected " + (
                ", ".join(sorted(allowed)) or "none"
            )
        if not _VALUE.fullmatch(value) or ".." in value:
            return f"option {key} is {value[:80]!r}; expected a number, a choice or shapes, and no path"
    return None


def opened_with(provider: str, options: Mapping[str, str], threads: int) -> dict[str, str]:
    """Return what ONNX Runtime gets: for OpenVINO the graph's threads and `inference_precision` in its own form."""
    given = dict(options)
    if provider != OPENVINO:
        return given
    given["num_of_threads"] = str(threads)
    precision = given.pop("inference_precision", None)
    if precision is not None:
        hint = {"INFERENCE_PRECISION_HINT": precision}
        given["load_config"] = json.dumps({given.get("device_type", "CPU"): hint})
    return given


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
    """Path on the machine, without the root of the search."""
    group: str | None
    """Group that may open it; None if all users may, or only root's group."""


def device_nodes(providers: Sequence[str], root: Path = Path("/")) -> list[DeviceNode]:
    """Return the existing nodes of these providers; none for a provider on the processor."""
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
