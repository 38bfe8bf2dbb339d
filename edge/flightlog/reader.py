"""Read a flight log back, also one whose end is missing (process killed, disk full, battery pulled)."""

from __future__ import annotations

import base64
import binascii
import io
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame
import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message
from mcap.stream_reader import StreamReader, breakup_chunk

from firmware_bridge.system.input_file import open_regular, parse_json

_MAGIC = b"\x89MCAP0\r\n"
_RECORD_LIMIT_BYTES = 256 * 1024 * 1024
_CHUNK_LIMIT_BYTES = 64 * 1024 * 1024
"""Largest chunk after decompression, bytes; the recorder ends its own at 256 KiB. Kilobytes of zstd can expand to
gigabytes."""

# Errors of the MCAP reader at a cut or at damage: too few bytes for a number, a string or a compressed block (a
# RuntimeError of lz4), a bad checksum (a ValueError), a message that is no JSON.
_CUT = (McapError, struct.error, zstandard.ZstdError, ValueError, RuntimeError, KeyError, MemoryError)
_NO_FILE = {FileNotFoundError: "no such file", IsADirectoryError: "a folder"}


class RecordingError(ValueError):
    """The file is not a flight log."""


@dataclass(frozen=True)
class Damage:
    """Wrong bytes in one part of a flight log; the end that a killed process did not write is none."""

    path: Path
    after_ns: int | None
    """Stamp of the last record before them; None without one in this part."""
    reason: str
    ends: bool
    """Whether the rest of the part was not read; False: one chunk, at most 1 s of records, was skipped."""


def damage_notice(damages: Sequence[Damage], start_ns: int) -> str:
    """Return one line about the first damage of a log; `start_ns`: zero of its time in s."""
    first = damages[0]
    where = "at its start" if first.after_ns is None else f"after {max(0, first.after_ns - start_ns) / 1e9:.1f} s"
    lost = "the rest was not read" if first.ends else "some of the later records are missing"
    return f"{first.path}: damaged {where} ({first.reason}); {lost}"


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


def read_messages(path: str | Path, damages: list[Damage] | None = None) -> Iterator[tuple[str, int, dict[str, Any]]]:
    """Yield (topic, stamp_ns, payload) in file order, of the file and then of its continuations.

    A damaged chunk is skipped; a part ends at any other damage, and quietly where the last part lacks its end. Each
    damage is appended to `damages`. Each continuation repeats the `/run` record.
    `payload` is the JSON object as recorded; `jpeg_bytes` turns that of `/camera` into the picture. Raises
    RecordingError when the file does not start like an MCAP file, OSError when it cannot be read.
    """
    first, *others = parts(Path(path))
    if not _is_mcap(first):
        raise RecordingError(f"{first} is not an MCAP file: expected the MCAP signature in its first 8 bytes")
    damages = [] if damages is None else damages
    yield from _read_part(first, damages, is_last=not others)
    for part in others:
        if _is_mcap(part):  # the process may have died before the first byte of it
            yield from _read_part(part, damages, is_last=part == others[-1])


def _is_mcap(path: Path) -> bool:
    try:
        with open_regular(path) as stream:
            return stream.read(len(_MAGIC)) == _MAGIC
    except OSError as error:
        found = _NO_FILE.get(type(error), error.strerror)
        refusal = type(error)(f"{path}: cannot be read: expected a flight log (.mcap), found: {found}")
        refusal.strerror = found  # for callers with a line of their own
        raise refusal from None


def _read_part(path: Path, damages: list[Damage], *, is_last: bool) -> Iterator[tuple[str, int, dict[str, Any]]]:
    last_ns: int | None = None

    def note(error: Exception, ends: bool) -> None:
        reason = str(error).partition(",")[0] or type(error).__name__  # without the checksums
        damages.append(Damage(path, last_ns, reason, ends))

    with open_regular(path) as stream:
        stream.seek(len(_MAGIC))
        topics: dict[int, str] = {}
        try:
            for record in _records(stream, lambda error: note(error, ends=False)):
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                if isinstance(record, Message):
                    topic, payload = _parsed(record, topics)
                    last_ns = record.log_time
                    yield topic, last_ns, payload
        except _CUT as error:
            # A killed process leaves a last part without an end; the recorder finishes all others.
            at_end = isinstance(error, EndOfFile) or not stream.read(1)
            if not (at_end and is_last) or _has_end(stream):
                note(error, ends=True)


def _parsed(message: Message, topics: dict[int, str]) -> tuple[str, dict[str, Any]]:
    """Return topic and payload of a message. Raises ValueError."""
    topic = topics.get(message.channel_id)
    if topic is None:
        raise ValueError("a message whose channel is unknown")
    payload = parse_json(message.data)
    if not isinstance(payload, dict):
        raise ValueError(f"a {topic} message that is no JSON object")
    return topic, payload


def _has_end(stream: BinaryIO) -> bool:
    """Return whether a part ends as the recorder ends one: with the MCAP signature, which also begins it."""
    size = stream.seek(0, io.SEEK_END)
    stream.seek(max(len(_MAGIC), size - len(_MAGIC)))
    return stream.read() == _MAGIC


def _records(stream: BinaryIO, on_bad_chunk: Callable[[Exception], None]) -> Iterator[McapRecord]:
    """Yield the records of a part, also those of its chunks, except damaged chunks. Raises the errors of _CUT."""
    reader = StreamReader(
        stream, skip_magic=True, emit_chunks=True, validate_crcs=True, record_size_limit=_RECORD_LIMIT_BYTES
    )
    for record in reader.records:
        if isinstance(record, DataEnd):
            return  # indexes follow
        if not isinstance(record, Chunk):
            yield record
            continue
        try:
            inner = breakup_chunk(_decompressed(record), validate_crc=True)
        except _CUT as error:
            on_bad_chunk(error)
            continue
        yield from inner


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
