"""MAVProxy, unmodified, finds the rover, reads and sets parameters, arms it, drives it with its sticks and disarms it.

It lives in an environment of its own: tools/interop/install_mavproxy.sh DIR, then
TIC_VLA_MAVPROXY=DIR/venv/bin/mavproxy.py. Without it these tests are skipped.
"""

from __future__ import annotations

import os
import re
import sys

import pytest

from sim_hil.protocols.mavlink.parameters import NAMES
from tests.process.interop.mavlink_sessions import SESSIONS, Session, run_session

MAVPROXY = os.environ.get("TIC_VLA_MAVPROXY", "")
pytestmark = [
    pytest.mark.process,
    pytest.mark.skipif(
        not MAVPROXY, reason="TIC_VLA_MAVPROXY is not set: install MAVProxy with tools/interop/install_mavproxy.sh"
    ),
]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    client = [sys.executable, str(SESSIONS / "mavproxy_session.py"), MAVPROXY]
    return run_session(tmp_path_factory.mktemp("mavproxy"), client)


def answer(session: Session, typed: str) -> str:
    (step,) = [step for step in session.seen["steps"] if step["typed"] == typed]
    return str(step["answer"])


def test_it_gets_all_parameters(session: Session) -> None:
    assert any(step["answer"].startswith(f"Received {len(NAMES)} parameters") for step in session.seen["steps"])


def test_offboard_mode_is_refused_with_a_reason(session: Session) -> None:
    assert answer(session, "long DO_SET_MODE 1 6 0").endswith("TEMPORARILY_REJECTED")


def test_it_arms_drives_and_disarms(session: Session) -> None:
    for typed in ("arm throttle", "long DO_SET_MODE 1 1 0", "disarm"):
        assert answer(session, typed).endswith("ACCEPTED")
    found = re.search(r"x : ([-0-9.e]+)", answer(session, "status"))
    assert found and 1.2 < float(found[1]) < 2.2  # 4 s at 0.48 m/s
    assert session.hil["path_m"] == pytest.approx(float(found[1]), abs=0.15)
    assert session.hil["wire"]["last_command_zero"] and session.hil["wire"]["malformed"] == 0
