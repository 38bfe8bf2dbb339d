"""Read a flight log back, also one whose end is missing (process killed, disk full, battery pulled)."""

from __future__ import annotations

import base64
import binascii
import json
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Message
from mcap.stream_reader import CRCValidationError, StreamReader

from firmware_bridge.system.input_file import open_regular

_MAGIC = b"\x89MCAP0\r\n"
_RECORD_LIMIT_BYTES = 256 * 1024 * 1024

# Errors of the MCAP reader at a cut: too few bytes for a number, a string, a compressed block, or a bad checksum.
_CUT = (McapError, CRCValidationError, struct.error, zstandard.ZstdError, UnicodeDecodeError, MemoryError)


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
    """Return the JPEG of a `foxglove.CompressedImage` payload. Raises ValueError if there is none."""
    try:
        return base64.b64decode(payload["data"], validate=True)
    except (KeyError, TypeError, binascii.Error) as error:
        raise ValueError("payload is not a foxglove.CompressedImage: no base64 text under 'data'") from error
