"""Reads a JPEG's picture size from its header and checks that it is safe to decode, without decoding it."""

from __future__ import annotations

_FRAME_HEADERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""SOF0..SOF15 without DHT, JPG and DAC (ITU-T T.81, table B.1)."""
_ALONE = frozenset((0x00, 0x01, 0xFF, *range(0xD0, 0xDA)))
"""Markers without a length, which must not occur before the frame header."""
_MAX_SEGMENTS = 64
MAX_PX = 4096
MAX_BYTES = 8 * 1024 * 1024
"""Largest side of a picture, far above a robot camera's: 50 MB decoded. A header alone could demand gigabytes."""


def jpeg_size(jpeg: bytes) -> tuple[int, int] | None:
    """Return (width, height) in pixels; None without a frame header at its place."""
    position = 2
    for _ in range(_MAX_SEGMENTS):
        if position + 9 > len(jpeg) or jpeg[position] != 0xFF:
            return None
        marker = jpeg[position + 1]
        if marker in _ALONE:
            return None
        if marker in _FRAME_HEADERS:
            height = int.from_bytes(jpeg[position + 5 : position + 7], "big")
            return int.from_bytes(jpeg[position + 7 : position + 9], "big"), height
        position += 2 + int.from_bytes(jpeg[position + 2 : position + 4], "big")
    return None


def jpeg_refusal(jpeg: bytes) -> str | None:
    """Return why these bytes must not be decoded, for a message; None when they may."""
    if len(jpeg) > MAX_BYTES:
        return f"{len(jpeg)} bytes, at most {MAX_BYTES}"
    size = jpeg_size(jpeg)
    if size is None:
        return f"{len(jpeg)} bytes are not a JPEG picture"
    if not 0 < min(size) <= max(size) <= MAX_PX:
        return f"a picture of {size[0]}x{size[1]} pixels, expected 1 to {MAX_PX} each way"
    return None
