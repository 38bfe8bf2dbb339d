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
    """Results of the SDK's clients in one session with a real edge-hil."""
    client = Path(__file__).with_name("unitree_sdk_client.py")
    with running("sim_hil.hil.command", *hil_arguments(dds_domain), folder=tmp_path_factory.mktemp("interop")):
        command = [SDK_PYTHON, str(client), str(dds_domain), "lo"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=180, check=False)
    assert done.returncode == 0, done.stderr + done.stdout
    sys.stdout.write(done.stdout)  # for `pytest -s`
    return json.loads(done.stdout.splitlines()[-1])


def test_the_sdk_reads_both_states_and_accepts_every_checksum(session: dict) -> None:
    assert session["sport_state_hz"] == pytest.approx(50, abs=10)
    assert session["low_state_hz"] == pytest.approx(500, abs=100)
    assert session["low_state_crc_ok"] == [20, 20]


def test_the_sdk_moves_and_stops_the_robot(session: dict) -> None:
    assert session["mode_at_start"] == 5 and session["body_height_m"] > 0.25
    assert session["move"] == [[0], 3] and session["moved_m"] > 0.6
    assert session["stop"] == [0, 1] and session["after_stop_m"] < 0.3


def test_the_sdk_fetches_a_picture(session: dict) -> None:
    codes, size, shape, contrast = session["image"]
    assert (codes, shape) == ([0], [180, 320, 3])
    assert size > 1000 and contrast > 5


class TestServices:
    def test_every_service_has_the_makers_version(self, session: dict) -> None:
        assert session["versions"] == ["1.0.0.1", "1.0.0.2", "1.0.0.1"]

    def test_postures_are_taken_and_reported_and_end_in_a_stand(self, session: dict) -> None:
        assert session["stand"] == [0, 6, 0, 1]
        assert session["hello"] == [0, 2, 1.0, 1]
        assert session["sit"] == [0, 10, 0, 1]
        assert session["euler"] == [0, pytest.approx(0.3, abs=0.1)]

    def test_acrobatics_are_refused(self, session: dict) -> None:
        assert session["acrobatics"] == [3203] * 3

    def test_settings_are_taken_and_read_back(self, session: dict) -> None:
        assert session["settings"] == [0] * 6
        assert session["auto_recovery"] == [0, [0, True], 0, [0, False]]

    def test_a_protected_service_cannot_be_switched_off(self, session: dict) -> None:
        assert session["services"]["motion_switcher"] == [1, 1]
        assert session["switch_protected"] == 5202

    def test_obstacles_avoid_drives_by_velocity_and_by_place(self, session: dict) -> None:
        assert session["avoid_switch"] == [[0, True], 0, [0, False], 0, 0]
        assert session["avoid_moved_m"] > 0.4
        assert session["avoid_increment_m"] == pytest.approx(0.5, abs=0.15)

    def test_a_lease_denies_all_other_clients_until_its_holder_ends(self, session: dict) -> None:
        assert session["lease_holder"] == [0, 0, 0]
        assert session["lease_others"] == 3205
        assert session["lease_question"] == [0, False]
        assert session["lease_after"] == 0

    def test_low_commands_drive_the_joints_of_a_released_robot_when_their_checksum_is_right(
        self, session: dict
    ) -> None:
        assert session["release"] == [0, "", 7002]
        assert session["sport_while_released"] == 4202
        assert session["height_after_wrong_crc_m"] < 0.12
        assert session["height_after_low_commands_m"] > 0.25

    def test_the_sport_controller_takes_over_again(self, session: dict) -> None:
        assert session["select"] == [7004, 0, 0, 1]
