"""Read a flight log back, also one whose end is missing (process killed, disk full, battery pulled)."""

from __future__ import annotations

import base64
import binascii
import io
import re
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame
import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, McapRecord, Message
from mcap.stream_reader import StreamReader, breakup_chunk

from firmware_bridge.system.input_file import open_regular, parse_json

_MAGIC = b"\x89MCAP0\r\n"
_RECORD_LIMIT_BYTES = 256 * 1024 * 1024
_CHUNK_LIMIT_BYTES = 64 * 1024 * 1024
"""Largest chunk after decompression, bytes; the recorder ends its own at 256 KiB. Kilobytes of zstd can expand to
gigabytes."""

# Errors of the MCAP reader at a cut or at damage: too few bytes for a number, a string or a compressed block (a
# RuntimeError of lz4), a bad checksum (a ValueError), a message that is no JSON, an unknown channel.
_CUT = (McapError, struct.error, zstandard.ZstdError, ValueError, RuntimeError, KeyError, MemoryError)


class RecordingError(ValueError):
    """The file is not a flight log."""


def part_path(path: Path, number: int) -> Path:
    """Return the path of part `number` (from 1) of a recording: `flight.mcap`, `flight.002.mcap`, …"""
    return path if number == 1 else path.with_name(f"{path.stem}.{number:03d}{path.suffix}")


def parts(path: Path) -> list[Path]:
    """Return `path` and its existing continuations, in order; middle ones may have been discarded."""
    pattern = re.compile(rf"{re.escape(path.stem)}\.(\d{{3,}}){re.escape(path.suffix)}", re.ASCII)
    found: list[tuple[int, Path]] = []
    if path.parent.is_dir():
        for beside in path.parent.iterdir():
            match = pattern.fullmatch(beside.name)
            if match is not None and beside == part_path(path, number := int(match[1])) and number > 1:
                found.append((number, beside))
    return [path, *(part for _, part in sorted(found))]


def read_messages(path: str | Path) -> Iterator[tuple[str, int, dict[str, Any]]]:
    """Yield (topic, stamp_ns, payload) in file order, of the file and then of its continuations.

    A part ends quietly at the first record that is cut or damaged; each continuation repeats the `/run` record.
    `payload` is the JSON object as recorded; `jpeg_bytes` turns that of `/camera` into the picture. Raises
    RecordingError when the file does not start like an MCAP file, OSError when it cannot be read.
    """
    first, *others = parts(Path(path))
    if not _is_mcap(first):
        raise RecordingError(f"{first} is not an MCAP file: expected the MCAP signature in its first 8 bytes")
    yield from _read_part(first)
    for part in others:
        if _is_mcap(part):  # the process may have died before the first byte of it
            yield from _read_part(part)


def _is_mcap(path: Path) -> bool:
    with open_regular(path) as stream:
        try:
            return stream.read(len(_MAGIC)) == _MAGIC
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(path)) from None


def _read_part(path: Path) -> Iterator[tuple[str, int, dict[str, Any]]]:
    with open_regular(path) as stream:
        stream.seek(len(_MAGIC))
        records = _records(stream)
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
                topic, payload = topics[record.channel_id], parse_json(record.data)
            except _CUT:
                return
            if not isinstance(payload, dict):
                return
            yield topic, record.log_time, payload


def _records(stream: BinaryIO) -> Iterator[McapRecord]:
    """Yield the records of a part, also those of its chunks. Raises the errors of _CUT."""
    reader = StreamReader(
        stream, skip_magic=True, emit_chunks=True, validate_crcs=True, record_size_limit=_RECORD_LIMIT_BYTES
    )
    for record in reader.records:
        if isinstance(record, Chunk):
            yield from breakup_chunk(_decompressed(record), validate_crc=True)
        else:
            yield record


def _decompressed(chunk: Chunk) -> Chunk:
    """Return a chunk without compression. Raises ValueError where its size is not the stated one or too large."""
    size = chunk.uncompressed_size
    if size > _CHUNK_LIMIT_BYTES:
        raise ValueError(f"a chunk of {size} bytes, expected at most {_CHUNK_LIMIT_BYTES}")
    # One byte more than stated shows that the data is longer, whatever the frame itself states.
    if chunk.compression == "zstd":
        data = zstandard.ZstdDecompressor().stream_reader(io.BytesIO(chunk.data)).read(size + 1)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, size + 1)
    else:
        return chunk
    if len(data) != size:
        raise ValueError(f"a chunk of {len(data)} bytes or more, expected {size}")
    return replace(chunk, compression="", data=data)


def jpeg_bytes(payload: dict[str, Any]) -> bytes:
    """Return the JPEG of a `foxglove.CompressedImage` payload. Raises ValueError if there is none."""
    try:
        return base64.b64decode(payload["data"], validate=True)
    except (KeyError, TypeError, binascii.Error) as error:
        raise ValueError("payload is not a foxglove.CompressedImage: no base64 text under 'data'") from error
