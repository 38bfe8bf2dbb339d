"""A JPEG's picture size from its header, without decoding it."""

from __future__ import annotations

_FRAME_HEADERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""SOF0..SOF15 without DHT, JPG and DAC (ITU-T T.81, table B.1)."""
_MAX_SEGMENTS = 64


def jpeg_size(jpeg: bytes) -> tuple[int, int] | None:
    """(width, height) in pixels; None when there is no frame header where there should be one."""
    position = 2
    for _ in range(_MAX_SEGMENTS):
        if position + 9 > len(jpeg) or jpeg[position] != 0xFF:
            return None
        marker = jpeg[position + 1]
        if marker in _FRAME_HEADERS:
            height = int.from_bytes(jpeg[position + 5 : position + 7], "big")
            return int.from_bytes(jpeg[position + 7 : position + 9], "big"), height
        position += 2 + int.from_bytes(jpeg[position + 2 : position + 4], "big")
    return None
