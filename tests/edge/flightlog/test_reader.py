"""Reading a flight log back: whatever happened to the process or the disk, what is read is what was recorded."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path

import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer

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


def _written(path: Path, compression: CompressionType, *messages: bytes) -> bytes:
    """Write an MCAP file with these messages in one chunk; return its bytes."""
    with path.open("wb") as stream:
        writer = Writer(stream, compression=compression, index_types=IndexType.NONE, use_statistics=False)
        writer.start()
        channel = writer.register_channel("/tick", "json", 0)
        for number, data in enumerate(messages):
            writer.add_message(channel, number, data, number)
        writer.finish()
    return path.read_bytes()


@pytest.mark.parametrize(
    "data",
    [b"[" * 100_000, b'{"n": 1' + b"0" * 5000 + b"}", b"5", b"[]", b'{"a": "\xff"}'],
    ids=["nested too deeply", "integer of 5001 digits", "number", "list", "not UTF-8"],
)
def test_a_part_ends_quietly_at_a_message_that_is_no_json_object(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    _written(path, CompressionType.ZSTD, b'{"tick": 1}', data, b'{"tick": 2}')
    assert [payload for _, _, payload in read_messages(path)] == [{"tick": 1}]


@pytest.mark.parametrize("compression", [CompressionType.LZ4, CompressionType.ZSTD])
def test_a_compressed_chunk_is_read_and_a_cut_one_ends_the_part(compression: CompressionType, tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    whole = _written(path, compression, b'{"tick": 1}')
    assert [payload for _, _, payload in read_messages(path)] == [{"tick": 1}]
    reader = StreamReader(io.BytesIO(whole), emit_chunks=True)
    chunk = next(record for record in reader.records if isinstance(record, Chunk))
    _write_chunk(path, replace(chunk, data=chunk.data[:-9]))
    assert list(read_messages(path)) == []


@pytest.mark.parametrize("stated", [1000, 1 << 31])
def test_a_chunk_of_kilobytes_that_expands_to_gigabytes_takes_no_memory(stated: int, tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    data = zstandard.ZstdCompressor().compress(bytes(1 << 28))  # its header states its size
    assert len(data) < 100_000
    chunk = Chunk(
        compression="zstd", data=data, message_end_time=0, message_start_time=0, uncompressed_crc=0,
        uncompressed_size=stated,
    )  # fmt: skip
    _write_chunk(path, chunk)
    tracemalloc.start()
    try:
        assert list(read_messages(path)) == []
        assert tracemalloc.get_traced_memory()[1] < 8_000_000
    finally:
        tracemalloc.stop()


def _write_chunk(path: Path, chunk: Chunk) -> None:
    builder = RecordBuilder()
    chunk.write(builder)
    path.write_bytes(b"\x89MCAP0\r\n" + builder.end())
