"""MAVSDK and MAVProxy, unmodified, watch a driven rover; MAVProxy's mode command latches the bridge within 100 ms.

Both live in environments of their own: tools/interop/install_mavproxy.sh DIR and tools/interop/install_mavsdk.sh DIR,
then TIC_VLA_MAVPROXY=DIR/venv/bin/mavproxy.py and TIC_VLA_MAVSDK_PYTHON=DIR/venv/bin/python. Without them this test is
skipped.
The figures: python -m tools.interop.takeover --help.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from tools.interop.takeover import main

MAVPROXY, PYTHON = os.environ.get("TIC_VLA_MAVPROXY", ""), os.environ.get("TIC_VLA_MAVSDK_PYTHON", "")
pytestmark = [
    pytest.mark.process,
    pytest.mark.slow,
    pytest.mark.skipif(
        not (MAVPROXY and PYTHON), reason="TIC_VLA_MAVPROXY or TIC_VLA_MAVSDK_PYTHON is not set: see tools/interop"
    ),
]


def test_each_mode_of_a_ground_station_latches_the_bridge_within_100_ms(tmp_path: Path) -> None:
    out = tmp_path / "takeover.json"
    assert main(["--mavproxy", MAVPROXY, "--mavsdk-python", PYTHON, "--repeat", "4", "--out", str(out)]) == 0
    result = json.loads(out.read_text(encoding="utf-8"))
    assert result["n"] == 4 and result["max_ms"] - max(s["stall_ms"] for s in result["samples"]) <= 100
