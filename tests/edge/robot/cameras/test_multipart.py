"""MJPEG streams as bytes: pictures however they are cut, and one clear line for everything else."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.jpeg import MAX_BYTES
from edge.robot.cameras.multipart import MAX_BETWEEN_BYTES, MAX_HEAD_BYTES, MjpegParser, Part, StreamError

HEAD = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=frame\r\n\r\n"
JPEG_A, JPEG_B = b"\xff\xd8 first \r\n--fram \xff\xd9", b"\xff\xd8 second \xff\xd9"


def part(jpeg: bytes, *, length: bool = True, more: str = "", mark: bytes = b"--frame") -> bytes:
    size = f"Content-Length: {len(jpeg)}\r\n" if length else ""
    return mark + f"\r\nContent-Type: image/jpeg\r\n{size}{more}\r\n".encode() + jpeg + b"\r\n"


def feed(data: bytes, sizes: list[int]) -> list[Part]:
    parser, parts, at = MjpegParser(), [], 0
    for size in [*sizes, len(data)]:
        parts += parser.feed(data[at : at + size])
        at += size
    return parts


@given(st.lists(st.integers(1, 60), max_size=20), st.booleans())
def test_pictures_are_the_same_however_the_bytes_are_cut(sizes: list[int], length: bool) -> None:
    stream = HEAD + part(JPEG_A, length=length) + part(JPEG_B, length=length) + b"--frame\r\n"
    assert [each.jpeg for each in feed(stream, sizes)] == [JPEG_A, JPEG_B]


@pytest.mark.slow
@given(st.binary(max_size=400), st.booleans())
def test_any_bytes_give_pictures_or_a_stream_error_and_nothing_else(data: bytes, head: bool) -> None:
    with contextlib.suppress(StreamError):
        MjpegParser().feed(HEAD + data if head else data)


@pytest.mark.parametrize(
    ("text", "stamp"),
    [("123", 123), ("", None), ("-5", None), ("1e9", None), ("9" * 20, None), ("\u0663", None)],
)
def test_a_capture_stamp_is_a_decimal_number_or_absent(text: str, stamp: int | None) -> None:
    assert MjpegParser().feed(HEAD + part(JPEG_A, more=f"X-Capture-Ns: {text}\r\n"))[0].capture_ns == stamp


@pytest.mark.parametrize("boundary", ['"frame"', "--frame", " frame; charset=utf-8"])
def test_cameras_write_the_boundary_in_several_ways(boundary: str) -> None:
    head = HEAD.replace(b"=frame", b"=" + boundary.encode())
    assert len(MjpegParser().feed(head + part(JPEG_A))) == 1


def test_a_part_without_header_fields_is_a_picture() -> None:
    stream = HEAD + b"--frame\r\n\r\n" + JPEG_B + b"\r\n--frame\r\n"
    assert [each.jpeg for each in MjpegParser().feed(stream)] == [JPEG_B]


@pytest.mark.parametrize(
    ("stream", "message"),
    [
        (b"SSH-2.0-OpenSSH\r\n\r\n", "expected an HTTP answer"),
        (b"HTTP/1.0 404 Not Found\r\n\r\n", "status 200, found '404 Not Found'"),
        (b"HTTP/1.0 200 OK\r\nContent-Type: image/jpeg\r\n\r\n", "give the address of the stream"),
        (b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace\r\n\r\n", "expected a boundary"),
        (HEAD.replace(b"\r\n\r\n", b"\r\nTransfer-Encoding: chunked\r\n\r\n"), "no Transfer-Encoding"),
        (HEAD + b"--frame--\r\n", "has ended the stream"),
        (HEAD + b"--frameX\r\n", "boundary followed by"),
        (HEAD + part(b"GIF89a"), "expected a JPEG picture"),
        (HEAD + b"--frame\r\nContent-Length: 99999999\r\n\r\n", "Content-Length"),
        (HEAD + b"--frame\r\nContent-Length: -1\r\n\r\n", "Content-Length"),
        (b"x" * MAX_HEAD_BYTES, "header of at most"),
        (HEAD + b"--frame\r\n" + b"a" * MAX_HEAD_BYTES, "header of at most"),
        (HEAD + b"y" * (MAX_BETWEEN_BYTES + 1), "expected the boundary"),
        (HEAD + b"--frame\r\n\r\n" + bytes(MAX_BYTES + 1), "pictures of at most"),
    ],
)
def test_anything_else_is_one_line_with_what_was_expected(stream: bytes, message: str) -> None:
    with pytest.raises(StreamError, match=message) as raised:
        MjpegParser().feed(stream)
    assert "\n" not in str(raised.value) and len(str(raised.value)) < 200
