"""`edge-hil --robot carter --protocol can`, driven by `sim_hil.protocols.can.drive` in another process."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

pytestmark = pytest.mark.process


def _drive(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "sim_hil.protocols.can.drive", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=90, check=False)


@pytest.mark.slow
def test_a_session_over_a_serial_line_arms_drives_and_stops(tmp_path: Path) -> None:
    line, result = tmp_path / "can", tmp_path / "hil.json"
    link = f"serial:{line},camera=0"
    options = ["--robot", "carter", "--protocol", "can", "--scene", "corridor", "--camera", "64x36"]
    command = [sys.executable, "-m", "sim_hil.hil.command", *options, "--link", link, "--json", str(result)]
    hil = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        assert hil.stderr is not None
        ready = next(text for text in hil.stderr if "ready" in text or "edge-hil:" in text)
        found = re.search(
            rf"ready, CAN serial:{re.escape(str(line))}, camera (http://127.0.0.1:\d+)/stream.mjpg", ready
        )
        assert found, ready
        with urllib.request.urlopen(f"{found[1]}/frame.jpg", timeout=20) as picture:
            assert picture.read(2) == b"\xff\xd8"
        done = _drive("--channel", str(line), "--vx", "0.5", "--duration", "1.5", "--json", "-")
        assert done.returncode == 0, done.stderr
        driven = json.loads(done.stdout)
    finally:
        hil.send_signal(signal.SIGINT)
        hil.wait(30)
    assert hil.returncode == 0
    wire = json.loads(result.read_text(encoding="utf-8"))
    # On a busy machine the run may begin late or stutter, but never drives further than commanded.
    assert 0.2 < driven["moved_m"] < 0.9 and abs(driven["end_speed_mps"]) < 0.02
    assert driven["base_counted"]["CrcErrors"] == 0
    assert wire["path_m"] == pytest.approx(driven["moved_m"], abs=0.1)
    assert wire["video_frames"] >= 1
    assert wire["wire"]["last_command"] == "ModeCommand" and wire["wire"]["last_command_zero"]
    assert not line.is_symlink()


@pytest.mark.slow
def test_no_base_on_the_line_is_a_failed_check_in_one_line(tmp_path: Path) -> None:
    from sim_hil.protocols.can.pty_line import PtyLine

    line = PtyLine(tmp_path / "can")
    try:
        began = time.monotonic()
        done = _drive("--channel", str(line.far), "--duration", "1")
    finally:
        line.close()
    assert done.returncode == 1 and time.monotonic() - began < 60
    assert "expected the base to be armed" in done.stderr and "no answer" in done.stderr


@pytest.mark.parametrize(
    "arguments",
    [("--channel", "/no/such/line"), ("--channel", "/dev/null", "--vx", "nan"), ("--channel", "x", "--duration", "0")],
)
def test_bad_arguments_are_refused_in_one_line(arguments: tuple[str, ...]) -> None:
    done = _drive(*arguments)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and done.stderr.startswith("drive: ")
