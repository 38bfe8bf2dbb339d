"""Flight recorder: what the runner saw, decided and commanded, as one MCAP file written by a thread of its own.

The control thread must never wait for a disk. `Recorder.put` therefore only appends to a bounded queue; everything
that can be slow or can fail (JSON, compression, write, fsync) happens in the writer thread. When the disk is full the
robot keeps driving and the recorder says so in `error`.

A chunk is closed and handed to the operating system at least once a second, so a process killed in the middle
loses at most the last second (read such a file with `edge.recording.read_messages`).
"""

from __future__ import annotations

import base64
import json
import math
import operator
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import IO, Any

import numpy as np
from mcap.writer import CompressionType, Writer

from edge.log_schemas import ANY_OBJECT, COMPRESSED_IMAGE, SCHEMAS

Payload = Mapping[str, Any] | bytes

_CHUNK_BYTES = 256 * 1024
_FLUSH_PERIOD_NS = 900_000_000  # below one second even when a pass of the loop is late
_POLL_S = 0.05  # the writer looks by itself, so that a caller never pays for waking it
_NS_PER_S = 1_000_000_000


class Recorder:
    """Write records to an MCAP file without ever making the caller wait.

    `capacity` bounds the queue in records and `capacity_bytes` in bytes of raw (camera) payload; beyond either a
    record is dropped and counted. A path that cannot be opened is reported in `error`, not raised: the caller
    decides whether a run without a recording may start.
    """

    def __init__(self, path: str | Path, *, capacity: int = 4096, capacity_bytes: int = 64 * 1024 * 1024) -> None:
        if capacity < 1 or capacity_bytes < 1:
            raise ValueError(f"recorder capacity must be positive, found {capacity} records, {capacity_bytes} bytes")
        self.path = Path(path)
        self._capacity = capacity
        self._capacity_bytes = capacity_bytes
        self._lock = threading.Lock()  # held for a few instructions only, never around I/O or encoding
        self._queue: deque[tuple[str, int, Payload]] = deque()
        self._queued_bytes = 0
        self._dropped: Counter[str] = Counter()
        self._unsaved: Counter[str] = Counter()  # taken from the queue since the last flush
        self._error: str | None = None
        self._closing = threading.Event()
        self._file: IO[bytes] | None = None
        try:
            self._file = self.path.open("wb")
        except OSError as error:
            self._error = f"cannot open {self.path} for recording: {error.strerror or error}"
        # A daemon: a disk that hangs for good must not keep the process from ending.
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        if self._file is not None:
            self._thread.start()

    @property
    def error(self) -> str | None:
        """Why writing stopped, in one line, or None while it works."""
        with self._lock:
            return self._error

    @property
    def dropped(self) -> dict[str, int]:
        """Records per topic that were given to `put` and are not known to be on disk.

        While `error` is None that is what was refused or could not be encoded. An error adds what was queued and
        what was written since the last flush, of which the file may still hold a part: never fewer than are missing.
        """
        with self._lock:
            return dict(self._dropped)

    def put(self, topic: str, stamp_ns: int, payload: Payload) -> None:
        """Queue one record; never blocks and never raises.

        `payload` is a mapping that JSON can hold (numpy values allowed) and that nobody changes afterwards, or
        the bytes of a JPEG, which become a `foxglove.CompressedImage`.
        """
        size = len(payload) if isinstance(payload, bytes) else 0
        with self._lock:
            full = len(self._queue) >= self._capacity or self._queued_bytes + size > self._capacity_bytes
            if full or self._error is not None or self._closing.is_set():
                self._dropped[topic] += 1
                return
            self._queue.append((topic, stamp_ns, payload))
            self._queued_bytes += size

    def close(self, timeout_s: float = 5.0) -> bool:
        """Write what is queued, finish the file and return whether all of it is on disk in time."""
        self._closing.set()
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
            if self._thread.is_alive():
                self._fail(f"{self.path} was not finished within {timeout_s:g} s; its last second may be missing")
        return self.error is None

    def _take(self) -> tuple[str, int, Payload] | None:
        with self._lock:
            if not self._queue:
                return None
            item = self._queue.popleft()
            if isinstance(item[2], bytes):
                self._queued_bytes -= len(item[2])
            self._unsaved[item[0]] += 1
            return item

    def _fail(self, message: str) -> None:
        with self._lock:
            self._error = self._error or message
            for topic, _, _ in self._queue:
                self._dropped[topic] += 1
            self._queue.clear()
            self._queued_bytes = 0
            self._dropped.update(self._unsaved)
            self._unsaved.clear()

    def _drop_taken(self, topic: str) -> None:
        with self._lock:
            if self._unsaved[topic] > 0:  # otherwise _fail has counted it
                self._unsaved[topic] -= 1
                self._dropped[topic] += 1

    def _all_saved(self) -> None:
        with self._lock:
            self._unsaved.clear()

    def _run(self) -> None:
        assert self._file is not None
        try:
            with self._file as stream:
                self._write_all(stream)
        except Exception as error:  # noqa: BLE001 - a thread that ends must always say why in `error`
            reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
            self._fail(f"recording to {self.path} stopped: {reason or type(error).__name__}")

    def _write_all(self, stream: IO[bytes]) -> None:
        log = _LogWriter(stream)
        log.flush()
        flushed_ns = time.monotonic_ns()
        while True:
            # Asked before the queue is emptied: whatever was put before close() is then written.
            closing = self._closing.is_set()
            while (item := self._take()) is not None:
                topic, stamp_ns, payload = item
                try:
                    stamp_ns = _checked_stamp(stamp_ns)
                    data = encode(payload, stamp_ns)
                except (TypeError, ValueError, RecursionError):
                    # One record JSON cannot hold must not end the recording of all others.
                    self._drop_taken(topic)
                    continue
                log.add(topic, stamp_ns, data, image=isinstance(payload, bytes))
                if time.monotonic_ns() - flushed_ns >= _FLUSH_PERIOD_NS:
                    break
            now_ns = time.monotonic_ns()
            if now_ns - flushed_ns >= _FLUSH_PERIOD_NS:
                log.flush()
                if os.fstat(stream.fileno()).st_nlink == 0:
                    raise OSError("the file was removed while recording")
                self._all_saved()
                flushed_ns = now_ns
            if closing and not self._queue:
                log.finish()
                self._all_saved()
                return
            if not self._queue:
                self._closing.wait(_POLL_S)


class _LogWriter:
    """An MCAP writer that registers a topic's channel when its first message comes."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self._writer = Writer(stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._channels: dict[str, int] = {}
        self._sequence: Counter[str] = Counter()
        self._writer.start(profile="", library="tic-vla-edge")
        # Log times are monotonic; this pair of readings turns them into dates.
        clock = {"clock": "monotonic", "monotonic_ns": str(time.monotonic_ns())}
        clock["utc"] = datetime.now(timezone.utc).isoformat()
        self._writer.add_metadata("clock", clock)

    def add(self, topic: str, stamp_ns: int, data: bytes, *, image: bool) -> None:
        channel = self._channels.get(topic)
        if channel is None:
            schema = COMPRESSED_IMAGE if image else SCHEMAS.get(topic, ANY_OBJECT)
            schema_id = self._writer.register_schema(schema["title"], "jsonschema", json.dumps(schema).encode())
            channel = self._writer.register_channel(topic, "json", schema_id)
            self._channels[topic] = channel
        self._sequence[topic] += 1
        sequence = self._sequence[topic] % 2**32
        self._writer.add_message(channel, stamp_ns, data, publish_time=stamp_ns, sequence=sequence)

    def flush(self) -> None:
        self._writer.flush()  # type: ignore[no-untyped-call]
        os.fsync(self._stream.fileno())

    def finish(self) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.flush()
        os.fsync(self._stream.fileno())


def encode(payload: Payload, stamp_ns: int) -> bytes:
    """Payload as UTF-8 JSON; JPEG bytes become a `foxglove.CompressedImage`.

    JSON has no NaN or infinity: a non-finite number is written as null (a bad model output is what one most wants
    to find in a log). Raises TypeError or ValueError for what JSON cannot hold.
    """
    if isinstance(payload, bytes):
        return json.dumps(
            {
                "timestamp": {"sec": stamp_ns // _NS_PER_S, "nsec": stamp_ns % _NS_PER_S},
                "frame_id": "camera",
                "format": "jpeg",
                "data": base64.b64encode(payload).decode("ascii"),
            }
        ).encode()
    return json.dumps(_plain(payload), allow_nan=False).encode()


def _checked_stamp(stamp_ns: int) -> int:
    stamp_ns = operator.index(stamp_ns)
    if not 0 <= stamp_ns < 2**63:
        raise ValueError(f"stamp must be monotonic ns, found {stamp_ns}")
    return stamp_ns


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value
