"""The maker's own, unmodified Python SDK drives `edge-hil`.

It needs Cyclone DDS 0.10.2, so it lives in an environment of its own: tools/interop/install_unitree_sdk.sh DIR, then
TIC_VLA_SDK_PYTHON=DIR/venv/bin/python. Without it these tests are skipped.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.processes import hil_arguments, running

SDK_PYTHON = os.environ.get("TIC_VLA_SDK_PYTHON", "")
pytestmark = pytest.mark.skipif(
    not SDK_PYTHON,
    reason="TIC_VLA_SDK_PYTHON is not set: install the maker's SDK with tools/interop/install_unitree_sdk.sh",
)


@pytest.fixture(scope="module")
def session(dds_domain: int, tmp_path_factory: pytest.TempPathFactory) -> dict:
    """What the SDK's clients saw in one session with a real edge-hil."""
    folder = tmp_path_factory.mktemp("interop")
    client = Path(__file__).with_name("unitree_sdk_client.py")
    with running("sim_hil.hil", *hil_arguments(dds_domain), folder=folder):
        command = [SDK_PYTHON, str(client), str(dds_domain), "lo", str(folder / "frame.jpg")]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr + done.stdout
    sys.stdout.write(done.stdout)  # for `pytest -s`
    return json.loads(done.stdout.splitlines()[-1])


def test_the_sdk_finds_the_services(session: dict) -> None:
    assert session["version"] == [0, "1.0.0.1"]
    assert session["services"][0] == 0 and "sport_mode" in session["services"][1]


def test_the_sdk_reads_both_states(session: dict) -> None:
    assert session["sport_state_hz"] == pytest.approx(50, abs=10)
    assert session["low_state_hz"] == pytest.approx(500, abs=100)


def test_the_sdk_accepts_every_low_state_checksum(session: dict) -> None:
    good, total = session["low_state_crc_ok"]
    assert good == total == 20


def test_the_sdk_stands_the_robot_up(session: dict) -> None:
    assert (session["stand_up"], session["balance_stand"]) == (0, 0)
    assert (session["mode_at_start"], session["mode_after_stand_up"], session["mode_after_balance_stand"]) == (5, 6, 1)
    assert session["body_height_m"] > 0.25


def test_the_sdk_moves_the_robot(session: dict) -> None:
    assert session["move"] == [0]
    assert session["mode_while_moving"] == 3
    assert session["moved_m"] > 0.6


def test_the_sdk_stops_the_robot(session: dict) -> None:
    assert session["stop_move"] == 0
    assert session["mode_after_stop"] == 1
    assert session["after_stop_m"] < 0.3


def test_the_sdk_is_told_what_the_robot_cannot_do(session: dict) -> None:
    assert session["unknown_api"] == 3203


def test_the_sdk_fetches_a_picture(session: dict) -> None:
    code, size, shape, contrast = session["image"]
    assert (code, shape) == (0, [180, 320, 3])
    assert size > 1000 and contrast > 5
