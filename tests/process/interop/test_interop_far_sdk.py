"""A binding of the maker's C++ SDK, unmodified, reads `edge-hil`'s state and drives its joints.

It lives in an environment of its own: tools/interop/install_far_sdk.sh DIR, then
TIC_VLA_FAR_PYTHON=DIR/venv/bin/python. Without it, or without the right to make network namespaces, these tests are
skipped. Both run in a network namespace of their own, because the binding knows DDS domain 0 only.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.processes import REPOSITORY, read_trace

FAR_PYTHON = os.environ.get("TIC_VLA_FAR_PYTHON", "")
pytestmark = [
    pytest.mark.process,
    pytest.mark.skipif(
        not FAR_PYTHON,
        reason="TIC_VLA_FAR_PYTHON is not set: install the binding with tools/interop/install_far_sdk.sh",
    ),
    pytest.mark.skipif(os.geteuid() != 0, reason="network namespaces need root"),
]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> dict:
    """What the binding saw in one session with a real edge-hil."""
    folder = tmp_path_factory.mktemp("far")
    hil = (
        f"{sys.executable} -m sim_hil.hil.command --robot go2 --scene corridor --protocol unitree --camera none"
        f" --interface eth0 --json {folder / 'hil.json'} --trace {folder / 'hil.jsonl'}"
    )
    tests = Path(__file__).parent
    release = f"{sys.executable} {tests / 'release_joints.py'} 0 eth0"
    client = f"{release} && {FAR_PYTHON} {tests / 'far_sdk_client.py'} eth0"
    script = f"""ip link set lo up && ip link add eth0 type veth peer name eth1 && ip link set eth1 up
        ip addr add 192.168.123.161/24 dev eth0 && ip link set eth0 up && {{ {hil} & }}
        {client}; code=$?; kill $!; wait; exit $code"""
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run(
        ["unshare", "--net", "bash", "-c", script],
        cwd=folder, capture_output=True, text=True, timeout=120, env=environment, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr + done.stdout
    sys.stdout.write(done.stdout)  # for `pytest -s`
    seen = json.loads(done.stdout.splitlines()[-1])
    seen["hil"] = json.loads((folder / "hil.json").read_text())
    seen["heights_m"] = [line["z"] for line in read_trace(folder / "hil.jsonl") if line["kind"] == "pose"]
    return seen


def test_the_binding_reads_the_joints_and_the_imu(session: dict) -> None:
    assert session["low_state"] and session["rests"] and session["motors"] == 12
    assert session["lying_q"][1] == pytest.approx(1.3, abs=0.3) and session["accel_z"] == pytest.approx(9.8, abs=0.5)


def test_its_low_commands_stand_the_robot_up(session: dict) -> None:
    assert session["standing_q_error"] < 0.15
    assert session["heights_m"][0] < 0.12 and max(session["heights_m"]) > 0.25


def test_none_of_its_commands_has_a_wrong_checksum(session: dict) -> None:
    assert session["hil"]["wire"]["malformed"] == 0


def test_it_reads_the_odometry_and_the_remote(session: dict) -> None:
    assert session["odometry_quat_norm"] == pytest.approx(1.0, abs=0.01)
    assert session["odometry_after"][2] > session["odometry_before"][2] + 0.1
    assert session["remote"] == [0.0, 0.0, 0.0, 0.0, 0]


def test_it_gets_low_states_fast(session: dict) -> None:
    assert session["low_state_hz_at_least"] > 200  # polled, on a machine that other tests share
