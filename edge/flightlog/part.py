"""One file of a flight log: a whole MCAP that any viewer opens, written straight to the operating system."""

from __future__ import annotations

import base64
import contextlib
import errno
import json
import math
import operator
import os
import time
from collections import Counter
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from mcap.writer import CompressionType, Writer

from edge.flightlog.schemas import ANY_OBJECT, SCHEMAS
from edge.flightlog.standard_messages import StandardMessages
from edge.flightlog.standard_schemas import COMPRESSED_IMAGE, STANDARD_SCHEMAS, Schema

Payload = Mapping[str, Any] | bytes

_CHUNK_BYTES = 256 * 1024
_NS_PER_S = 1_000_000_000


class PartFile:
    """Unbuffered file that counts its written bytes; pipes and devices are allowed.

    With `new` it must not exist yet. Raises OSError.
    """

    def __init__(self, path: Path, *, new: bool) -> None:
        how = os.O_EXCL if new else os.O_TRUNC
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC | how, 0o644)
        status = os.fstat(self._descriptor)
        self.identity = (status.st_dev, status.st_ino)
        self.length = 0

    def write(self, data: bytes) -> int:
        """Write all bytes; a full disk takes a part and then raises OSError."""
        rest = memoryview(data)
        while rest:
            taken = os.write(self._descriptor, rest)
            if taken == 0:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self.length += taken
            rest = rest[taken:]
        return len(data)

    def tell(self) -> int:
        """Bytes written so far."""
        return self.length

    def flush(self) -> None:
        """Do nothing: there is no buffer."""

    def sync(self) -> None:
        """Sync to the device."""
        try:
            os.fsync(self._descriptor)
        except OSError as error:
            if error.errno != errno.EINVAL:  # a pipe or a device cannot sync
                raise

    @property
    def removed(self) -> bool:
        """Whether the file was deleted, so that later writes are lost."""
        return os.fstat(self._descriptor).st_nlink == 0

    def close(self) -> None:
        """Close the descriptor."""
        with contextlib.suppress(OSError):  # the records were synced before
            os.close(self._descriptor)


class LogPart:
    """An MCAP writer that registers a topic's channel when its first message comes.

    Beside every record it writes the messages of `StandardMessages`, which any viewer shows.
    """

    def __init__(self, file: PartFile, number: int) -> None:
        self.file = file
        # The writer uses tell, write and flush only.
        self._writer = Writer(cast(IO[bytes], file), chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._channels: dict[str, int] = {}
        self._sequence: Counter[str] = Counter()
        self._standard = StandardMessages()
        self._writer.start(profile="", library="tic-vla-edge")
        # Log times are monotonic; this pair of readings turns them into dates.
        clock = {"clock": "monotonic", "monotonic_ns": str(time.monotonic_ns())}
        clock["utc"] = datetime.now(timezone.utc).isoformat()
        self._writer.add_metadata("clock", clock)
        self._writer.add_metadata("part", {"number": str(number)})

    @property
    def is_empty(self) -> bool:
        """Whether no record was added."""
        return not self._channels

    def has(self, topic: str) -> bool:
        """Whether a record of that topic was added."""
        return topic in self._channels

    def add(self, topic: str, stamp_ns: int, payload: Payload) -> None:
        """Append a record and its standard messages; raises TypeError or ValueError outside JSON, and OSError."""
        schema = COMPRESSED_IMAGE if isinstance(payload, bytes) else SCHEMAS.get(topic, ANY_OBJECT)
        self._append(topic, stamp_ns, payload, schema)
        for message in self._standard.of(topic, stamp_ns, payload):
            self._append(*message, STANDARD_SCHEMAS[message.topic])

    def _append(self, topic: str, stamp_ns: int, payload: Payload, schema: Schema) -> None:
        data = encode(payload, stamp_ns)
        channel = self._channels.get(topic)
        if channel is None:
            schema_id = self._writer.register_schema(schema["title"], "jsonschema", json.dumps(schema).encode())
            channel = self._writer.register_channel(topic, "json", schema_id)
            self._channels[topic] = channel
        self._sequence[topic] += 1
        sequence = self._sequence[topic] % 2**32
        self._writer.add_message(channel, stamp_ns, data, publish_time=stamp_ns, sequence=sequence)

    def flush(self) -> None:
        """Close the chunk and sync it, so that it survives the process and the machine."""
        self._writer.flush()
        self.file.sync()

    def finish(self) -> None:
        """Write the summary (indexes, statistics) that makes the file seekable."""
        self._writer.finish()
        self.file.sync()


def encode(payload: Payload, stamp_ns: int) -> bytes:
    """Payload as UTF-8 JSON; JPEG bytes become a `foxglove.CompressedImage`.

    JSON has no NaN or infinity: a non-finite number is written as null, so that a log can show a bad model output.
    Raises TypeError or ValueError for values outside JSON and for an invalid stamp.
    """
    if not 0 <= operator.index(stamp_ns) < 2**63:
        raise ValueError(f"stamp must be monotonic ns, found {stamp_ns}")
    if isinstance(payload, bytes):
        # Assembled as bytes: encoding a picture as JSON would block the interpreter.
        time_ = f'{{"sec": {stamp_ns // _NS_PER_S}, "nsec": {stamp_ns % _NS_PER_S}}}'
        head = f'{{"timestamp": {time_}, "frame_id": "camera", "format": "jpeg", "data": "'
        return b"".join((head.encode(), base64.b64encode(payload), b'"}'))
    return json.dumps(_plain(payload), allow_nan=False).encode()


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
