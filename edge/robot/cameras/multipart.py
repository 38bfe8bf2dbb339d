"""Parser of MJPEG over HTTP (multipart/x-mixed-replace, RFC 2046 §5.1): bytes in, pictures out, no I/O.

Every length is bounded before memory is taken for it: the server is an untrusted peer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from edge.core.jpeg import MAX_BYTES

MAX_HEAD_BYTES: Final = 16 * 1024
"""Longest header of the answer or of a part, bytes."""
MAX_BETWEEN_BYTES: Final = 64 * 1024
"""Most bytes between two parts that belong to neither, bytes."""
MAX_STAMP_DIGITS: Final = 19
"""Digits of the largest 64-bit stamp."""
_JPEG_START: Final = b"\xff\xd8"
_TYPE: Final = "multipart/x-mixed-replace"


class StreamError(ValueError):
    """The bytes are not an MJPEG stream; one line with what was expected and found."""


@dataclass(frozen=True)
class Part:
    """One picture and the X-Capture-Ns header that came with it, None without one."""

    jpeg: bytes
    capture_ns: int | None


class MjpegParser:
    """Takes the bytes of an HTTP answer in pieces of any size. It is of no use after a StreamError."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._boundary = b""  # empty before the head of the answer
        self._in_header = False
        self._fields: dict[str, str] | None = None  # of the part whose body comes next
        self._searched = 0

    def feed(self, data: bytes) -> list[Part]:
        """Return the pictures that `data` completes, oldest first. Raises StreamError."""
        self._data += data
        parts: list[Part] = []
        while self._advance(parts):
            pass
        return parts

    def _advance(self, parts: list[Part]) -> bool:
        """Take the next element off the data; False while it is incomplete."""
        if not self._boundary:
            head = self._header()
            if head is not None:
                self._boundary = _boundary(head)
            return head is not None
        if self._fields is not None:
            body = self._body(self._fields)
            if body is not None:
                parts.append(_part(body, self._fields))
                self._fields = None
            return body is not None
        if self._in_header:
            lines = self._header()
            if lines is not None:
                self._in_header, self._fields, self._searched = False, _fields(lines), 0
            return lines is not None
        self._in_header = self._skip_boundary()
        return self._in_header

    def _header(self) -> list[str] | None:
        """Take a header and the empty line after it off the data: its lines; None while it is incomplete."""
        data = self._data
        if data[:2] == b"\r\n":  # a part without header fields
            del data[:2]
            return []
        end = data.find(b"\r\n\r\n", 0, MAX_HEAD_BYTES)
        if end < 0:
            if len(data) >= MAX_HEAD_BYTES:
                raise StreamError(f"expected a header of at most {MAX_HEAD_BYTES} bytes, found more")
            return None
        lines = data[:end].decode("latin-1").split("\r\n")
        del data[: end + 4]
        return lines

    def _skip_boundary(self) -> bool:
        """Drop everything up to the end of the next boundary line; False while there is none."""
        data = self._data
        at = data.find(self._boundary)
        begin = at + len(self._boundary)
        if at < 0 or len(data) < begin + 2:
            if len(data) > MAX_BETWEEN_BYTES:
                raise StreamError(f"expected the boundary {self._boundary!r} within {MAX_BETWEEN_BYTES} bytes")
            return False
        end = bytes(data[begin : begin + 2])
        if end != b"\r\n":
            raise StreamError("the server has ended the stream" if end == b"--" else f"boundary followed by {end!r}")
        del data[: begin + 2]
        return True

    def _body(self, fields: dict[str, str]) -> bytes | None:
        """Take a part's body off the data; None while it is incomplete."""
        data, text = self._data, fields.get("content-length")
        if text is None:
            mark = b"\r\n" + self._boundary
            length = data.find(mark, self._searched)
            self._searched = max(len(data) - len(mark), 0)
            if length < 0:
                if len(data) > MAX_BYTES:
                    raise StreamError(f"expected pictures of at most {MAX_BYTES} bytes, found more")
                return None
        elif text.isascii() and text.isdigit() and len(text) <= 9 and int(text) <= MAX_BYTES:
            length = int(text)
            if len(data) < length:
                return None
        else:
            raise StreamError(f"Content-Length: expected at most {MAX_BYTES}, found {text[:20]!r}")
        body = bytes(data[:length])
        del data[:length]
        return body


def _part(body: bytes, fields: dict[str, str]) -> Part:
    if not body.startswith(_JPEG_START):
        raise StreamError(f"expected a JPEG picture in each part, found {len(body)} bytes starting {body[:4]!r}")
    stamp = fields.get("x-capture-ns", "")
    usable = stamp.isascii() and stamp.isdigit() and len(stamp) <= MAX_STAMP_DIGITS
    return Part(body, int(stamp) if usable else None)


def _fields(lines: list[str]) -> dict[str, str]:
    """Header fields by their name in lower case; a line without a colon is ignored."""
    pairs = (line.partition(":") for line in lines if ":" in line)
    return {name.strip().lower(): value.strip() for name, _, value in pairs}


def _boundary(head: list[str]) -> bytes:
    """Check the head of the answer and return the line that begins a part. Raises StreamError."""
    first, fields = "".join(head[:1]), _fields(head[1:])
    status = first.split(" ", 2)
    if not status[0].startswith("HTTP/1.") or len(status) < 2:
        raise StreamError(f"expected an HTTP answer, found {first[:40]!r}")
    if status[1] != "200":
        raise StreamError(f"expected status 200, found {first[9:60]!r}")
    if "transfer-encoding" in fields:
        raise StreamError(f"expected no Transfer-Encoding, found {fields['transfer-encoding'][:20]!r}")
    kind, _, rest = fields.get("content-type", "").partition(";")
    if kind.strip().lower() != _TYPE:
        raise StreamError(f"expected Content-Type {_TYPE}, found {kind[:40]!r}; give the address of the stream")
    options = dict(_option(each) for each in rest.split(";"))
    boundary = options.get("boundary", "")
    if not 0 < len(boundary) <= 200 or not boundary.isprintable() or not boundary.isascii():
        raise StreamError(f"expected a boundary in the Content-Type, found {rest[:40]!r}")
    # Some cameras write the two dashes into the parameter too.
    return b"--" + boundary.removeprefix("--").encode("ascii")


def _option(text: str) -> tuple[str, str]:
    name, _, value = text.partition("=")
    return name.strip().lower(), value.strip().strip('"')
