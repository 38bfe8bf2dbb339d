"""Wire format between the benchmark and a policy server: JSON headers followed by image bytes; version 1.

A message is 4 bytes of header length (big-endian), the header (UTF-8 JSON object), then `payload_bytes` bytes, if the
header has that key. `docs/benchmark.md` describes the order of messages. Each side treats the other as untrusted:
lengths are bounded before reading, every field is checked, and received data is never executed.
"""

from __future__ import annotations

import json
import math
import socket
import struct
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

PROTOCOL = "edge-bench-policy"
VERSION = 1
MAX_HEADER_BYTES = 65_536
MAX_PAYLOAD_BYTES = 8_000_000
MAX_TEXT_CHARS = 4096
ENCODINGS = ("jpeg", "png", "raw")
JPEG_QUALITY = 95
_LENGTH = struct.Struct(">I")


class ExternalError(RuntimeError):
    """The peer is absent, too slow, or sent an invalid message; one line."""


@dataclass(frozen=True)
class Message:
    """A header and its payload."""

    header: Mapping[str, Any]
    payload: bytes = b""

    @property
    def kind(self) -> str:
        """Message type: the header's `type`."""
        return str(self.header.get("type", ""))


@dataclass(frozen=True)
class Address:
    """Address of a policy server: `HOST:PORT` or `unix:PATH`."""

    host: str = ""
    port: int = 0
    path: str = ""

    @staticmethod
    def parse(text: str) -> Address:
        """Parse `HOST:PORT` or `unix:PATH`. Raises ExternalError."""
        if text.startswith("unix:") and len(text) > len("unix:"):
            return Address(path=str(Path(text.removeprefix("unix:")).absolute()))
        host, _, port = text.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) < 65536:
            raise ExternalError(f"address {text!r}: expected HOST:PORT or unix:PATH")
        return Address(host.strip("[]"), int(port))

    def connect(self, timeout_s: float) -> socket.socket:
        """Return a connected socket with that timeout for every call. Raises OSError."""
        if not self.path:
            return socket.create_connection((self.host, self.port), timeout_s)
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            connection.settimeout(timeout_s)
            connection.connect(self.path)
        except OSError:
            connection.close()
            raise
        return connection

    def __str__(self) -> str:
        return f"unix:{self.path}" if self.path else f"{self.host}:{self.port}"


def encode(message: Message) -> bytes:
    """Encode a message. Raises ValueError if it is too large or contains a number that is not finite."""
    header = dict(message.header)
    if message.payload:
        header["payload_bytes"] = len(message.payload)
    data = json.dumps(header, allow_nan=False).encode()
    if len(data) > MAX_HEADER_BYTES or len(message.payload) > MAX_PAYLOAD_BYTES:
        raise ValueError(f"message {message.kind}: {len(data)} + {len(message.payload)} bytes exceed the maximum")
    return _LENGTH.pack(len(data)) + data + message.payload


class Decoder:
    """Incremental decoder from bytes to messages. Raises ExternalError on invalid data."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[Message]:
        """Add received bytes and return the messages that are now complete."""
        self._buffer += data
        messages: list[Message] = []
        while (found := self._next()) is not None:
            messages.append(found)
        return messages

    def _next(self) -> Message | None:
        if len(self._buffer) < _LENGTH.size:
            return None
        (length,) = _LENGTH.unpack_from(self._buffer)
        if not 2 <= length <= MAX_HEADER_BYTES:
            raise ExternalError(f"header of {length} bytes, expected 2 to {MAX_HEADER_BYTES}")
        end = _LENGTH.size + length
        if len(self._buffer) < end:
            return None
        header = _header(bytes(self._buffer[_LENGTH.size : end]))
        size = header.pop("payload_bytes", 0)
        if isinstance(size, bool) or not isinstance(size, int) or not 0 <= size <= MAX_PAYLOAD_BYTES:
            raise ExternalError(f"payload_bytes {size!r}, expected 0 to {MAX_PAYLOAD_BYTES}")
        if len(self._buffer) < end + size:
            return None
        payload = bytes(self._buffer[end : end + size])
        del self._buffer[: end + size]
        return Message(header, payload)


def _header(data: bytes) -> dict[str, Any]:
    try:
        header = json.loads(data, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise ExternalError(f"header is not JSON ({str(error)[:120]})") from error
    if not isinstance(header, dict) or not isinstance(header.get("type"), str):
        raise ExternalError("header is not an object with a type")
    return header


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not valid JSON")


@dataclass
class Channel:
    """Message channel over a connected socket. Every method raises ExternalError, also on timeout."""

    connection: socket.socket
    peer: str
    timeout_s: float | None = None
    """Timeout for one whole message, s; None: no timeout."""
    _decoder: Decoder = field(default_factory=Decoder)
    _waiting: list[Message] = field(default_factory=list)

    def send(self, header: Mapping[str, object], payload: bytes = b"") -> None:
        """Send a message."""
        self.connection.settimeout(self.timeout_s)
        try:
            self.connection.sendall(encode(Message(header, payload)))
        except TimeoutError as error:
            raise ExternalError(f"{self.peer}: timeout while sending {header.get('type')}") from error
        except OSError as error:
            raise ExternalError(f"{self.peer}: connection lost ({error.strerror or error})") from error

    def receive(self, *kinds: str) -> Message:
        """Return the next message, which must have one of these types; the peer's `error` raises ExternalError."""
        end_ns = None if self.timeout_s is None else time.monotonic_ns() + round(self.timeout_s * 1e9)
        while not self._waiting:
            try:
                if end_ns is not None:
                    # A timeout of 0 would make the socket non-blocking, with another exception.
                    self.connection.settimeout(max((end_ns - time.monotonic_ns()) / 1e9, 1e-3))
                data = self.connection.recv(1 << 16)
            except TimeoutError as error:
                raise ExternalError(f"{self.peer}: no {' or '.join(kinds)} within the time allowed") from error
            except OSError as error:
                raise ExternalError(f"{self.peer}: connection lost ({error.strerror or error})") from error
            if end_ns is not None and time.monotonic_ns() > end_ns:
                raise ExternalError(f"{self.peer}: no {' or '.join(kinds)} within the time allowed")
            if not data:
                raise ExternalError(f"{self.peer}: closed the connection, expected {' or '.join(kinds)}")
            try:
                self._waiting += self._decoder.feed(data)
            except ExternalError as error:
                raise ExternalError(f"{self.peer}: {error}") from error
        message = self._waiting.pop(0)
        if message.kind == "error":
            raise ExternalError(f"{self.peer} reports: {text(message.header, 'message', self.peer)[:300]}")
        if message.kind not in kinds:
            raise ExternalError(f"{self.peer}: expected {' or '.join(kinds)}, found {message.kind[:40]!r}")
        return message

    def close(self) -> None:
        """Close the connection."""
        self.connection.close()


def check_keys(header: Mapping[str, object], required: set[str], optional: set[str], peer: str) -> None:
    """Raise ExternalError for a missing or unknown key."""
    missing, unknown = required - set(header), set(header) - required - optional - {"type"}
    if missing or unknown:
        what = f"lacks {sorted(missing)[0]!r}" if missing else f"has the unknown key {sorted(unknown)[0][:40]!r}"
        raise ExternalError(f"{peer}: {header.get('type')} {what}")


def text(header: Mapping[str, object], key: str, peer: str, limit: int = MAX_TEXT_CHARS) -> str:
    """Return a text field of at most `limit` characters. Raises ExternalError."""
    value = header.get(key)
    if not isinstance(value, str) or len(value) > limit:
        raise ExternalError(f"{peer}: expected {key} to be a text of at most {limit} characters")
    return value


def numbers(header: Mapping[str, object], key: str, count: int, peer: str) -> tuple[float, ...]:
    """Return a field of `count` finite numbers. Raises ExternalError."""
    value = header.get(key)
    if not isinstance(value, list) or len(value) != count:
        raise ExternalError(f"{peer}: expected {key} to be {count} numbers")
    if not all(isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in value):
        raise ExternalError(f"{peer}: expected {key} to be {count} finite numbers")
    return tuple(float(v) for v in value)


def encode_image(rgb: npt.NDArray[np.uint8], encoding: str) -> bytes:
    """Encode uint8 RGB [h, w, 3] as JPEG, PNG or raw bytes, row by row."""
    if encoding == "raw":
        return np.ascontiguousarray(rgb).tobytes()
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if encoding == "jpeg" else []
    done, data = cv2.imencode(".jpg" if encoding == "jpeg" else ".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), options)
    if not done:
        raise ValueError(f"an image of shape {rgb.shape} cannot be encoded as {encoding}")
    return bytes(data.tobytes())


def decode_image(payload: bytes, encoding: str, width: int, height: int) -> npt.NDArray[np.uint8]:
    """Decode an image written by `encode_image` to RGB [height, width, 3]. Raises ExternalError."""
    if encoding == "raw":
        if len(payload) != width * height * 3:
            raise ExternalError(f"image of {len(payload)} bytes, expected {width}x{height}x3")
        return np.frombuffer(payload, dtype=np.uint8).reshape(height, width, 3)
    picture = cv2.imdecode(np.frombuffer(payload, dtype=np.uint8), cv2.IMREAD_COLOR) if payload else None
    if picture is None or picture.shape != (height, width, 3):
        raise ExternalError(f"expected an image of {width}x{height} px as {encoding}, found another one or none")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)
