"""Read a flight log back, also one whose end is missing (process killed, disk full, battery pulled)."""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Message
from mcap.stream_reader import CRCValidationError, StreamReader

_RECORD_LIMIT_BYTES = 256 * 1024 * 1024

# What the MCAP reader raises at a cut: too few bytes for a number, a string, a compressed block, or a bad checksum.
_CUT = (McapError, CRCValidationError, struct.error, zstandard.ZstdError, UnicodeDecodeError, MemoryError)


class RecordingError(ValueError):
    """The file is not a flight log at all."""


def read_messages(path: str | Path) -> Iterator[tuple[str, int, dict[str, Any]]]:
    """Yield (topic, stamp_ns, payload) in file order and end quietly at the first record that is cut or damaged.

    `payload` is the JSON object as recorded; `jpeg_bytes` turns that of `/camera` into the picture. Raises
    RecordingError when the file does not start like an MCAP file, OSError when it cannot be read.
    """
    path = Path(path)
    with path.open("rb") as stream:
        if stream.read(8) != b"\x89MCAP0\r\n":
            raise RecordingError(f"{path} is not an MCAP file: expected the MCAP signature in its first 8 bytes")
        records = StreamReader(
            stream, skip_magic=True, validate_crcs=True, record_size_limit=_RECORD_LIMIT_BYTES
        ).records
        topics: dict[int, str] = {}
        while True:
            try:
                record = next(records, None)
                if record is None:
                    return
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                if not isinstance(record, Message):
                    continue
                topic, payload = topics[record.channel_id], json.loads(record.data)
            except (*_CUT, KeyError, json.JSONDecodeError):
                return
            yield topic, record.log_time, payload


def jpeg_bytes(payload: dict[str, Any]) -> bytes:
    """The JPEG in a `foxglove.CompressedImage` payload; ValueError when it holds none."""
    try:
        return base64.b64decode(payload["data"], validate=True)
    except (KeyError, TypeError, binascii.Error) as error:
        raise ValueError("payload is not a foxglove.CompressedImage: no base64 text under 'data'") from error
