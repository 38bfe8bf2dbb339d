"""MAVSDK, unmodified, finds the rover, reads it, arms it, drives it by velocity setpoints and stops it.

It lives in an environment of its own: tools/interop/install_mavsdk.sh DIR, then
TIC_VLA_MAVSDK_PYTHON=DIR/venv/bin/python. Without it these tests are skipped.
"""

from __future__ import annotations

import math
import os

import pytest

from tests.process.interop.mavlink_sessions import SESSIONS, Session, run_session

PYTHON = os.environ.get("TIC_VLA_MAVSDK_PYTHON", "")
pytestmark = [
    pytest.mark.process,
    pytest.mark.skipif(
        not PYTHON, reason="TIC_VLA_MAVSDK_PYTHON is not set: install MAVSDK with tools/interop/install_mavsdk.sh"
    ),
]
CLIENT = [PYTHON, str(SESSIONS / "mavsdk_session.py")]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    return run_session(tmp_path_factory.mktemp("mavsdk"), CLIENT)


def test_it_finds_a_rover_that_can_be_armed(session: Session) -> None:
    assert session.seen["armable"] is True
    assert session.seen["battery"]["percent"] > 90 and session.seen["battery"]["volts"] == pytest.approx(41, abs=1)


def test_it_reads_all_parameters_and_sets_one(session: Session) -> None:
    assert session.seen["parameters"]["COM_OF_LOSS_T"] == pytest.approx(0.5)
    integers = {"COM_OBL_RC_ACT": 5, "MAV_GCS_SYSID": 0, "MAV_SYS_ID": 1}
    assert session.seen["integer_parameters"] == integers
    assert session.seen["set_and_read_back"] == pytest.approx(0.8)


def test_its_velocity_setpoints_drive_the_rover_and_stop_it(session: Session) -> None:
    seen = session.seen
    assert seen["armed"] is True and seen["mode"] == "OFFBOARD"
    assert seen["speed_max_mps"] == pytest.approx(0.5, abs=0.05) and 1.5 < seen["moved_m"] < 2.3
    assert seen["end_speed_mps"] < 0.02
    assert session.hil["path_m"] == pytest.approx(seen["moved_m"], abs=0.15)


def test_it_turns_the_rover_to_the_right_and_back_to_north(session: Session) -> None:
    assert session.seen["turned_right_deg"] == pytest.approx(60, abs=15)
    assert session.seen["yaw_after_asking_for_north_deg"] == pytest.approx(0, abs=6)


def test_it_stops_offboard_mode_and_disarms(session: Session) -> None:
    assert session.seen["mode_after_stop"] == "HOLD" and session.seen["armed_at_the_end"] is False


def test_a_kill_lasts(session: Session) -> None:
    assert session.seen["armed_after_kill"] is False and session.seen["arm_after_kill"] == "FAILED"


def test_nothing_that_it_sends_is_malformed(session: Session) -> None:
    assert session.hil["wire"]["malformed"] == 0


def test_its_death_stops_the_rover(tmp_path_factory: pytest.TempPathFactory) -> None:
    session = run_session(tmp_path_factory.mktemp("died"), CLIENT, "--die", after_s=2.0)
    setpoints = [row["t_ns"] for row in session.trace if row.get("name") == "SET_POSITION_TARGET_LOCAL_NED"]
    poses = [row for row in session.trace if row["kind"] == "pose"]
    speed = {row["t_ns"]: math.hypot(row["vx"], row["vy"]) for row in poses}
    assert max(speed.values()) > 0.4
    late = [value for at_ns, value in speed.items() if at_ns > setpoints[-1] + 1_200_000_000]
    assert late and max(late) < 0.02  # 0.5 s without setpoints, 0.25 s to brake, and a busy machine
