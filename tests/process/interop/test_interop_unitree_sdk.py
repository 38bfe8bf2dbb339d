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

from tests.support.processes import hil_arguments, running

SDK_PYTHON = os.environ.get("TIC_VLA_SDK_PYTHON", "")
pytestmark = [
    pytest.mark.process,
    pytest.mark.skipif(
        not SDK_PYTHON,
        reason="TIC_VLA_SDK_PYTHON is not set: install the maker's SDK with tools/interop/install_unitree_sdk.sh",
    ),
]


@pytest.fixture(scope="module")
def session(dds_domain: int, tmp_path_factory: pytest.TempPathFactory) -> dict:
    """What the SDK's clients saw in one session with a real edge-hil."""
    folder = tmp_path_factory.mktemp("interop")
    client = Path(__file__).with_name("unitree_sdk_client.py")
    with running("sim_hil.hil.command", *hil_arguments(dds_domain), folder=folder):
        command = [SDK_PYTHON, str(client), str(dds_domain), "lo", str(folder / "frame.jpg")]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr + done.stdout
    sys.stdout.write(done.stdout)  # for `pytest -s`
    return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def services(dds_domain: int, tmp_path_factory: pytest.TempPathFactory) -> dict:
    """What the SDK's clients of the other services saw in one session with another edge-hil."""
    folder = tmp_path_factory.mktemp("services")
    client = Path(__file__).with_name("unitree_sdk_services_client.py")
    with running("sim_hil.hil.command", *hil_arguments(dds_domain), folder=folder):
        command = [SDK_PYTHON, str(client), str(dds_domain), "lo"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=150, check=False)
    assert done.returncode == 0, done.stderr + done.stdout
    sys.stdout.write(done.stdout)
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


class TestServices:
    def test_every_service_has_the_makers_version(self, services: dict) -> None:
        assert services["versions"] == ["1.0.0.1", "1.0.0.2", "1.0.0.1"]

    def test_postures_are_taken_and_reported_and_end_in_a_stand(self, services: dict) -> None:
        assert services["stand"] == [0, 6, 0, 1]
        assert services["hello"] == [0, 2, 1.0, 1]
        assert services["sit"] == [0, 10, 0, 1]
        assert services["euler"] == [0, pytest.approx(0.3, abs=0.1)]

    def test_acrobatics_are_refused(self, services: dict) -> None:
        assert services["acrobatics"] == [3203] * 3

    def test_settings_are_taken_and_read_back(self, services: dict) -> None:
        assert services["settings"] == [0] * 6
        assert services["auto_recovery"] == [0, [0, True], 0, [0, False]]

    def test_a_protected_service_cannot_be_switched_off(self, services: dict) -> None:
        assert services["services"]["motion_switcher"] == [1, 1]
        assert services["switch_protected"] == 5202

    def test_obstacles_avoid_drives_by_velocity_and_by_place(self, services: dict) -> None:
        assert services["avoid_switch"] == [[0, True], 0, [0, False], 0, 0]
        assert services["avoid_moved_m"] > 0.4
        assert services["avoid_increment_m"] == pytest.approx(0.5, abs=0.15)

    def test_a_lease_denies_everybody_else_until_its_holder_has_gone(self, services: dict) -> None:
        assert services["lease_holder"] == [0, 0, 0]
        assert services["lease_others"] == 3205
        assert services["lease_question"] == [0, False]
        assert services["lease_after"] == 0

    def test_low_commands_drive_the_joints_of_a_released_robot_when_their_checksum_is_right(
        self, services: dict
    ) -> None:
        assert services["release"] == [0, "", 7002]
        assert services["sport_while_released"] == 4202
        assert services["height_after_wrong_crc_m"] < 0.12
        assert services["height_after_low_commands_m"] > 0.25

    def test_the_sport_controller_takes_over_again(self, services: dict) -> None:
        assert services["select"] == [7004, 0, 0, 1]
