"""A whole run where the robot's computer and the robot have different bindings of Cyclone DDS, as an arm64 board has.

It needs a second environment with this package's dependencies and another binding; DIR/prefix is made by
tools/interop/install_unitree_sdk.sh, and TIC_VLA_OTHER_DDS_PYTHON names its python. Without it the test is skipped.

    CYCLONEDDS_HOME=DIR/prefix pip install --no-build-isolation "cyclonedds==0.10.5"
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.processes import GO2_SIM, REPOSITORY, hil_arguments, read_trace, running

OTHER_PYTHON = os.environ.get("TIC_VLA_OTHER_DDS_PYTHON", "")
pytestmark = [
    pytest.mark.process,
    pytest.mark.slow,
    pytest.mark.skipif(
        not OTHER_PYTHON,
        reason="TIC_VLA_OTHER_DDS_PYTHON is not set: make an environment with another binding of Cyclone DDS",
    ),
]
SIDES = {"this": sys.executable, "other": OTHER_PYTHON}
DRIVE_S = 5
VERSION = "import importlib.metadata; print(importlib.metadata.version('cyclonedds'))"


def version(python: str) -> str:
    return subprocess.run([python, "-c", VERSION], capture_output=True, text=True, check=True).stdout.strip()


@pytest.mark.parametrize("robot_side", SIDES)
@pytest.mark.parametrize("runner_side", SIDES)
def test_a_run_drives_sees_and_ends_at_zero(
    runner_side: str, robot_side: str, dds_domain: int, nano_dir: Path, tmp_path: Path
) -> None:
    runner_python, robot_python = SIDES[runner_side], SIDES[robot_side]
    versions = version(runner_python), version(robot_python)
    assert (versions[0] == versions[1]) == (runner_side == robot_side), f"the other binding is the same: {versions}"
    trace, result, socket = tmp_path / "trace.jsonl", tmp_path / "run.json", tmp_path / "bridge.sock"
    where = ("--robot", str(GO2_SIM), "--domain", str(dds_domain), "--socket", str(socket))
    run = [runner_python, "-m", "edge.run.command", "--artifacts", str(nano_dir), *where]
    run += ["--instruction", "walk down the corridor", "--duration", str(DRIVE_S), "--json", str(result)]
    hil = hil_arguments(dds_domain, "--trace", trace)
    with (
        running("sim_hil.hil.command", *hil, folder=tmp_path, python=robot_python) as robot,
        running("firmware_bridge.bridge", *where, folder=tmp_path, python=runner_python) as bridge,
    ):
        done = subprocess.run(run, capture_output=True, text=True, timeout=90, cwd=REPOSITORY, check=False)
        assert done.returncode == 0, done.stderr
        assert (bridge.end(), robot.end()) == (0, 0)
    found, end = json.loads(result.read_text()), read_trace(trace)[-1]
    sys.stdout.write(f"runner {versions[0]}, robot {versions[1]}: {end['path_m']:.2f} m, {end['wire']}\n")
    assert found["control"]["plans"] > 0 and found["camera"]["frames"] > 0 and found["odometry"]["rejected"] == 0
    assert end["wire"]["commands"] > DRIVE_S * 10 and end["wire"]["malformed"] == 0
    assert end["wire"]["last_command_zero"]
