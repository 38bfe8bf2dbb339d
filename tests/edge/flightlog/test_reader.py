"""Reading a flight log back: whatever happened to the process or the disk, what is read is what was recorded."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from edge.flightlog.reader import RecordingError, read_messages
from edge.flightlog.recorder import Recorder
from tests.edge.flightlog.test_recorder import ticks, wait_for

RECORD_FOR_EVER = """
import sys, time
from edge.flightlog.recorder import Recorder
recorder = Recorder(sys.argv[1])
tick = 0
while True:
    recorder.put("/tick", time.monotonic_ns(), {"tick": tick})
    recorder.put("/camera", time.monotonic_ns(), bytes(range(256)) * 40)
    tick += 1
    time.sleep(0.01)
"""


def test_a_recording_process_killed_in_the_middle_leaves_a_readable_file(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    process = subprocess.Popen([sys.executable, "-c", RECORD_FOR_EVER, str(path)])
    try:
        assert wait_for(lambda: path.exists() and path.stat().st_size > 0, 20)
        assert wait_for(lambda: len(ticks(path)) > 0, 20)  # still recording, and readable already
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    found = ticks(path)
    assert found and found == list(range(len(found)))


@pytest.fixture(scope="module")
def whole_file(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("whole") / "flight.mcap"
    recorder = Recorder(path)
    for tick in range(2_000):
        recorder.put("/tick", tick, {"tick": tick, "noise": os.urandom(100).hex()})
    assert recorder.close()
    return path.read_bytes()


@pytest.mark.slow
@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(part=st.floats(0.0, 1.0))
def test_a_file_cut_anywhere_yields_a_prefix_and_never_raises(part: float, whole_file: bytes, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole_file[: 8 + int(part * (len(whole_file) - 8))])
    found = [payload["tick"] for _, _, payload in read_messages(path)]
    assert found == list(range(len(found)))


@pytest.mark.slow
@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(part=st.floats(0.01, 0.99), flip=st.integers(1, 255))
def test_a_damaged_byte_never_yields_a_wrong_record(part: float, flip: int, whole_file: bytes, tmp_path: Path) -> None:
    damaged = bytearray(whole_file)
    damaged[int(part * len(damaged))] ^= flip
    path = tmp_path / "damaged.mcap"
    path.write_bytes(bytes(damaged))
    found = [payload["tick"] for _, _, payload in read_messages(path)]
    assert found == sorted(set(found)) and set(found) <= set(range(2_000))


def test_a_file_that_is_no_recording_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("hello, this is not MCAP")
    with pytest.raises(RecordingError, match=r"notes\.txt is not an MCAP file"):
        list(read_messages(path))
