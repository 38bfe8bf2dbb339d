"""Flight recorder: never in the caller's way, bounded on disk, and every record that is lost is counted."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.reader import make_reader

from edge.flightlog.part import encode
from edge.flightlog.reader import jpeg_bytes, parts, read_messages
from edge.flightlog.recorder import Recorder, RecorderLimits, space_refusal
from edge.flightlog.schemas import SCHEMAS

JPEG = b"\xff\xd8\xff\xe0 not a picture, but bytes of one \xff\xd9"


def wait_for(condition, timeout_s: float = 5.0) -> bool:
    end_ns = time.monotonic_ns() + int(timeout_s * 1e9)
    while time.monotonic_ns() < end_ns:
        if condition():
            return True
        time.sleep(0.01)
    return False


def ticks(path: Path) -> list[int]:
    """What a reader sees now; the file is empty until the writer's first flush."""
    if path.stat().st_size == 0:
        return []
    return [payload["tick"] for topic, _, payload in read_messages(path) if topic == "/tick"]


def test_records_come_back_in_order_with_their_stamps(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "flight.mcap")
    for tick in range(300):
        recorder.put("/tick", 1_000 + tick, {"tick": tick, "command": [0.1, 0.0, -0.2], "reason": "ok"})
    assert recorder.close()
    assert recorder.dropped == {}
    messages = list(read_messages(tmp_path / "flight.mcap"))
    assert [(topic, stamp_ns, payload["tick"]) for topic, stamp_ns, payload in messages] == [
        ("/tick", 1_000 + tick, tick) for tick in range(300)
    ]
    recorder.put("/tick", 1, {"tick": 0})
    assert recorder.dropped == {"/tick": 1}, "after its end"


def test_the_summary_of_a_finished_file_lists_every_record(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "flight.mcap")
    for index in range(50):
        recorder.put("/tick", 1_000 + index, {"tick": index})
    recorder.put("/camera", 2_000, JPEG)
    assert recorder.close()
    with (tmp_path / "flight.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None and summary.statistics is not None
    by_topic = {channel.topic: summary.statistics.channel_message_counts[n] for n, channel in summary.channels.items()}
    assert by_topic == {"/tick": 50, "/camera": 1}
    assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (1_000, 2_000)


def test_an_ordinary_mcap_reader_sees_topics_and_schemas(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "flight.mcap")
    recorder.put("/camera", 12_345_678_901_234, JPEG)
    recorder.put("/tick", 2, {"tick": 0})
    recorder.put("/unheard-of", 3, {"a": 1})
    assert recorder.close()
    _, stamp_ns, payload = next(read_messages(tmp_path / "flight.mcap"))
    assert stamp_ns == 12_345_678_901_234
    assert payload["timestamp"] == {"sec": 12_345, "nsec": 678_901_234}
    assert (payload["format"], jpeg_bytes(payload)) == ("jpeg", JPEG)
    with (tmp_path / "flight.mcap").open("rb") as stream:
        found = {
            channel.topic: (schema.name, schema.encoding, channel.message_encoding)
            for schema, channel, _ in make_reader(stream).iter_messages()
        }
    assert found == {
        "/camera": ("foxglove.CompressedImage", "jsonschema", "json"),
        "/tick": ("tic_vla.Tick", "jsonschema", "json"),
        "/unheard-of": ("tic_vla.Object", "jsonschema", "json"),
    }


def test_a_hanging_disk_costs_the_caller_records_not_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk_answers = threading.Event()
    monkeypatch.setattr("edge.flightlog.recorder.os.fsync", lambda _: disk_answers.wait())
    recorder = Recorder(tmp_path / "flight.mcap", RecorderLimits(records=8))
    for index in range(10):
        recorder.put("/tick", index, {"tick": index})  # returns although the writer is stuck
    recorder.put("/camera", 10, JPEG)
    assert recorder.dropped == {"/tick": 2, "/camera": 1}
    assert recorder.close(timeout_s=0.1) is False
    assert "not finished within 0.1 s" in (recorder.error or "")
    disk_answers.set()


class Watched(dict):
    """A payload that notes in which threads it was encoded."""

    def __init__(self, tick: int) -> None:
        super().__init__(tick=tick)
        self.encoded_in: list[str] = []

    def items(self):  # what the encoder asks for
        self.encoded_in.append(threading.current_thread().name)
        return super().items()


def test_the_caller_encodes_nothing(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "flight.mcap")
    payload = Watched(0)
    recorder.put("/tick", 1, payload)
    assert recorder.close()
    assert payload.encoded_in == ["recorder"]


def test_a_device_that_takes_nothing_for_a_while_loses_nothing_that_the_queue_holds(tmp_path: Path) -> None:
    path = tmp_path / "stalled.mcap"
    os.mkfifo(path)
    device = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    recorder = Recorder(path, RecorderLimits(records=600))
    noise = [os.urandom(300).hex() for _ in range(600)]
    for tick in range(600):  # more than a pipe holds: the writer is stuck inside the kernel
        recorder.put("/tick", tick, {"tick": tick, "noise": noise[tick]})
    refused = 0
    while refused == 0:
        recorder.put("/tick", 600, {"tick": 600, "noise": noise[0]})
        refused = recorder.dropped.get("/tick", 0)
    copy = tmp_path / "copy.mcap"
    closing = threading.Thread(target=recorder.close, args=(30,))
    closing.start()
    with copy.open("wb") as out:
        while closing.is_alive():  # the device takes again
            with contextlib.suppress(BlockingIOError):
                out.write(os.read(device, 1 << 20))
        while data := os.read(device, 1 << 20):
            out.write(data)
    os.close(device)
    assert recorder.error is None
    assert ticks(copy)[:600] == list(range(600))


def test_the_queue_is_bounded_in_bytes_too(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "flight.mcap", RecorderLimits(picture_bytes=1000))
    recorder.put("/camera", 1, b"x" * 1001)
    assert recorder.close()
    assert recorder.dropped == {"/camera": 1}


def test_a_disk_that_is_full_stops_writing_and_is_reported(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    recorder = Recorder("/dev/full")
    recorder.put("/tick", 1, {"tick": 0})
    assert wait_for(lambda: recorder.error is not None)
    recorder.put("/tick", 2, {"tick": 1})
    assert "/dev/full stopped: No space left on device" in (recorder.error or "")
    assert recorder.dropped["/tick"] >= 1
    assert recorder.close() is False


FILL_THE_DISK = """
import os, resource, sys, time
from edge.flightlog.recorder import Recorder
from edge.flightlog.schemas import SCHEMAS
resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))
recorder = Recorder(sys.argv[1])
given = 0
while recorder.error is None:
    recorder.put("/camera", given, os.urandom(10_000))
    given += 1
    time.sleep(0.001)
print(given, recorder.dropped.get("/camera", 0), recorder.error)
"""


def test_on_a_disk_that_fills_up_what_was_written_can_be_read_and_the_rest_is_counted(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    done = subprocess.run(
        [sys.executable, "-B", "-c", FILL_THE_DISK, str(path)], capture_output=True, text=True, timeout=300
    )
    given, dropped, error = done.stdout.split(maxsplit=2)
    assert "stopped: File too large" in error
    assert path.stat().st_size == 300_000
    whole = len(list(read_messages(path)))
    assert whole > 0
    assert whole + int(dropped) >= int(given), "never fewer are counted than are missing"


def test_below_the_floor_of_free_space_nothing_is_written_until_there_is_room_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = [100]
    monkeypatch.setattr("edge.flightlog.recorder._free", lambda _: (free[0], 1_000))
    path = tmp_path / "flight.mcap"
    recorder = Recorder(path, RecorderLimits(free_bytes=200))
    recorder.put("/run", 1, {"instruction": "go"})
    assert wait_for(lambda: recorder.dropped == {"/run": 1})
    assert "is paused" in (recorder.error or "") and "delete old logs" in (recorder.error or "")
    free[0] = 249  # above the floor, but not clearly
    recorder.put("/tick", 2, {"tick": 0})
    assert wait_for(lambda: recorder.dropped == {"/run": 1, "/tick": 1})
    free[0] = 250
    assert wait_for(lambda: recorder.error is None, 20)
    recorder.put("/tick", 3, {"tick": 1})
    assert recorder.close()
    assert [(topic, at_ns) for topic, at_ns, _ in read_messages(path) if topic in SCHEMAS] == [
        ("/run", 1),
        ("/tick", 3),
    ]


@pytest.mark.parametrize(
    ("free", "total", "refused"),
    [(69, 1_000, True), (70, 1_000, False), (100, 1_000, False), (19, 20, True), (20, 20, False)],
)
def test_a_robot_is_not_armed_with_less_than_seven_percent_of_the_disk_free(
    free: int, total: int, refused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("edge.flightlog.recorder._free", lambda _: (free, total))
    reason = space_refusal(Path("flight.mcap"), RecorderLimits(free_bytes=20))
    assert (reason is not None) == refused
    assert reason is None or "delete old logs" in reason


def _record_parts(path: Path, count: int, limits: RecorderLimits) -> Recorder:
    """Records of about 1 kB of noise, so that compression does not change how many parts there are."""
    recorder = Recorder(path, limits)
    recorder.put("/run", 0, {"instruction": "go"})
    for tick in range(count):
        recorder.put("/tick", 1 + tick, {"tick": tick, "noise": os.urandom(1_000).hex()})
    assert recorder.close(30)
    return recorder


def test_a_long_recording_goes_on_in_further_parts_that_are_read_as_one(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    limits = RecorderLimits(part_bytes=400_000, total_bytes=10**9)
    recorder = _record_parts(path, 1_500, limits)
    assert [part.name for part in parts(path)[:3]] == ["flight.mcap", "flight.002.mcap", "flight.003.mcap"]
    assert all(part.stat().st_size < 400_000 + 300_000 for part in parts(path)), "a part and at most one chunk"
    assert recorder.dropped == {}
    assert ticks(path) == list(range(1_500))
    for part in parts(path):
        with part.open("rb") as stream:
            assert make_reader(stream).get_summary() is not None, "every part is whole by itself"
        assert next(read_messages(part))[0] == "/run", "and names its run"
    assert recorder.statistics()["bytes"] == sum(part.stat().st_size for part in parts(path))


def test_a_part_that_grows_slowly_is_ended_after_five_minutes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = [0]
    monkeypatch.setattr("edge.flightlog.recorder.time", SimpleNamespace(monotonic_ns=lambda: now_ns[0]))
    path = tmp_path / "flight.mcap"
    recorder = Recorder(path)
    recorder.put("/tick", 1, payload := Watched(0))
    assert wait_for(lambda: payload.encoded_in, 20)
    now_ns[0] = 299 * 1_000_000_000
    assert wait_for(lambda: ticks(path) == [0], 20)
    assert len(parts(path)) == 1
    now_ns[0] = 300 * 1_000_000_000
    assert wait_for(lambda: len(parts(path)) == 2, 20)
    recorder.put("/tick", 2, {"tick": 1})
    assert recorder.close()
    assert ticks(path) == [0, 1]


@pytest.mark.slow
def test_beyond_the_limit_the_oldest_part_but_the_first_is_given_up(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    limits = RecorderLimits(part_bytes=400_000, total_bytes=2_000_000)
    recorder = _record_parts(path, 3_000, limits)
    assert sum(part.stat().st_size for part in parts(path)) <= 2_000_000 + 300_000
    assert recorder.statistics()["discarded_parts"] > 0
    found = ticks(path)
    assert found[0] == 0 and found[-1] == 2_999, "how it began and how it ended"
    assert found == sorted(found)


def test_a_continuation_of_another_recording_is_not_written_over(tmp_path: Path) -> None:
    (tmp_path / "flight.002.mcap").write_bytes(b"somebody else's")
    recorder = Recorder(tmp_path / "flight.mcap")
    assert "flight.002.mcap of another recording" in (recorder.error or "")
    assert not (tmp_path / "flight.mcap").exists()


@pytest.mark.parametrize(
    "change", [{"records": 0}, {"free_bytes": -1}, {"total_bytes": 2 * 256 * 1024 * 1024}], ids=str
)
def test_limits_that_make_no_sense_are_refused_by_name(change: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=next(iter(change))):
        RecorderLimits(**change)


def _disk_fails_after(monkeypatch: pytest.MonkeyPatch, good_flushes: int) -> list[int]:
    """Let the disk take so many flushes; the list holds how many are left and may be changed."""
    left = [good_flushes]

    def fsync(_: int) -> None:
        if left[0] == 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        left[0] -= 1

    monkeypatch.setattr("edge.flightlog.recorder.os.fsync", fsync)
    return left


def test_records_of_the_chunk_the_disk_did_not_take_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _disk_fails_after(monkeypatch, good_flushes=1)  # the header's
    recorder = Recorder(tmp_path / "flight.mcap")
    for index in range(3):
        recorder.put("/tick", index, {"tick": index})
    recorder.put("/camera", 3, JPEG)
    assert recorder.close() is False
    assert recorder.dropped == {"/tick": 3, "/camera": 1}


@pytest.mark.slow
def test_records_the_disk_took_before_it_failed_are_not_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = _disk_fails_after(monkeypatch, good_flushes=1_000)
    path = tmp_path / "flight.mcap"
    recorder = Recorder(path)
    recorder.put("/tick", 1, {"tick": 0})
    assert wait_for(lambda: ticks(path) == [0], 20)
    flushes = left[0]
    assert wait_for(lambda: left[0] <= flushes - 2, 20)  # the flush after that of the record
    left[0] = 0
    recorder.put("/tick", 2, {"tick": 1})
    assert recorder.close() is False
    assert recorder.dropped == {"/tick": 1}


def test_a_missing_directory_is_reported_not_raised(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "missing" / "flight.mcap")
    recorder.put("/tick", 1, {"tick": 0})
    assert "No such file or directory" in (recorder.error or "")
    assert recorder.dropped == {"/tick": 1}
    assert recorder.close() is False


def test_a_file_removed_while_recording_is_reported(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    recorder = Recorder(folder / "flight.mcap")
    recorder.put("/tick", 1, {"tick": 0})
    (folder / "flight.mcap").unlink()
    folder.rmdir()
    assert wait_for(lambda: recorder.error is not None)
    assert "was removed" in (recorder.error or "")
    recorder.close()


def test_a_record_is_in_the_file_before_a_second_has_passed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = [0]
    monkeypatch.setattr("edge.flightlog.recorder.time", SimpleNamespace(monotonic_ns=lambda: now_ns[0]))
    path = tmp_path / "flight.mcap"
    recorder = Recorder(path)
    recorder.put("/tick", 1, payload := Watched(0))
    assert wait_for(lambda: payload.encoded_in, 20)  # the writer's second has begun
    now_ns[0] = 999_999_999
    assert wait_for(lambda: ticks(path) == [0], 20)
    recorder.close()


def test_one_record_json_cannot_hold_does_not_end_the_recording(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "flight.mcap")
    recorder.put("/tick", 1, {"tick": object()})
    recorder.put("/tick", -1, {"tick": 1})
    recorder.put("/tick", 3, {"tick": 2})
    assert recorder.close()
    assert recorder.dropped == {"/tick": 2}
    assert [payload["tick"] for _, _, payload in read_messages(tmp_path / "flight.mcap")] == [2]


def test_numpy_values_and_non_finite_numbers_are_valid_json() -> None:
    payload = {"a": np.float32(0.5), "b": np.array([[1.0, math.nan], [math.inf, 2.0]]), "c": (np.int64(3), None)}
    assert json.loads(encode(payload, 0)) == {"a": 0.5, "b": [[1.0, None], [None, 2.0]], "c": [3, None]}


def test_threads_may_record_at_the_same_time(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "flight.mcap", RecorderLimits(records=10_000))
    threads = [
        threading.Thread(target=lambda name=name: [recorder.put(name, n, {"n": n}) for n in range(500)])
        for name in ("/tick", "/semantic", "/other")
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert recorder.close()
    for name in ("/tick", "/semantic", "/other"):
        numbers = [payload["n"] for topic, _, payload in read_messages(tmp_path / "flight.mcap") if topic == name]
        assert numbers == list(range(500))
