"""The device is identified by what Linux and Jetson report of it, and its power mode must be the plan's."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from edge.core.device import OPENVINO, TENSORRT, DeviceError, check_power_mode, l4t_release, read_device

CONF = """
< POWER_MODEL ID=0 NAME=MAXN_SUPER >
CPU_ONLINE CORE_0 1
< POWER_MODEL ID=3 NAME=25W >
GPU MAX_FREQ 408000000
< POWER_MODEL ID=4 NAME=40W >
"""


def jetson(root: Path) -> Path:
    for name, text in {
        "proc/device-tree/compatible": "nvidia,p3509-0000+p3767-0000\0nvidia,p3767-0000\0nvidia,tegra234\0",
        "etc/nv_tegra_release": "# R36 (release), REVISION: 4.3, GCID: 38968081, BOARD: generic\n",
        "usr/lib/aarch64-linux-gnu/libnvinfer.so.10": "",
        "usr/lib/aarch64-linux-gnu/libnvinfer.so.10.3.0": "",
        "proc/cpuinfo": "processor\t: 0\nmodel name\t: ARMv8 Processor rev 1 (v8l)\n",
    }.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


def laptop(root: Path) -> Path:
    information = root / "proc/driver/nvidia/gpus/0000:01:00.0/information"
    information.parent.mkdir(parents=True)
    information.write_text("Model: \t\t NVIDIA GeForce RTX 4060 Laptop GPU\nIRQ:   \t\t 190\n")
    return root


@pytest.mark.parametrize(
    ("machine", "provider", "versions", "expected"),
    [
        (jetson, TENSORRT, {}, ("nvidia,p3509-0000+p3767-0000", "36.4.3", "10.3.0")),
        (laptop, TENSORRT, {"tensorrt-cu12": "10.7.0"}, ("NVIDIA GeForce RTX 4060 Laptop GPU", None, "10.7.0")),
        (jetson, OPENVINO, {"openvino": "2026.4.1"}, ("ARMv8 Processor rev 1 (v8l)", "36.4.3", "2026.4.1")),
        (lambda root: root, TENSORRT, {}, ("unknown", None, None)),
    ],
    ids=["a Jetson by its module", "a laptop by its graphics card", "OpenVINO by the processor", "a silent machine"],
)
def test_a_device_is_identified(
    tmp_path: Path, machine: Callable[[Path], Path], provider: str, versions: dict[str, str],
    expected: tuple[str | None, ...],
) -> None:  # fmt: skip
    facts = read_device(provider, machine(tmp_path), versions.get)
    assert (facts.device, facts.l4t, facts.provider_version) == expected


@pytest.mark.parametrize("text", ["", "R36", "# R35"])
def test_text_without_a_release_gives_none(text: str) -> None:
    assert l4t_release(text) is None


def test_only_the_mode_that_the_plan_was_made_for_is_accepted() -> None:
    query = "NV Power Mode: 25W\n3\n"
    check_power_mode("25W", conf=CONF, query=query)
    with pytest.raises(DeviceError, match="power mode is not reported, the plan was made for 25W: sudo nvpmodel -m 3"):
        check_power_mode("25W", conf=CONF, query="")
    with pytest.raises(DeviceError, match="'20W' is not on this board; it has MAXN_SUPER, 25W, 40W"):
        check_power_mode("20W", conf=CONF, query=query)
    with pytest.raises(DeviceError, match="power mode is 25W, the plan was made for 40W: sudo nvpmodel -m 4"):
        check_power_mode("40W", conf=CONF, query=query)
