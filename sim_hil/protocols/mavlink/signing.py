"""Signatures of MAVLink 2 (mavlink.io, "Message Signing"): a timestamp is stored only after the signature is verified.

pymavlink's own check stores the timestamp first, so a forged packet from the future makes genuine packets look old.
"""

from __future__ import annotations

import hashlib
import hmac
from pathlib import Path
from typing import Final

KEY_BYTES: Final = 32
BLOCK_BYTES: Final = 13  # link id, timestamp 48 bits, signature 48 bits
TICKS_PER_S: Final = 100_000  # unit of the timestamp: 10 us since 1 January 2015
EPOCH_UNIX_S: Final = 1_420_070_400
_NEW_STREAM_BEHIND: Final = 60 * TICKS_PER_S
_SIGNED_FLAG: Final = 0x01


def read_key(path: Path) -> bytes:
    """Read the secret key, 64 hexadecimal digits in a file. Raises ValueError or OSError."""
    text = path.read_text(encoding="ascii").strip()
    try:
        key = bytes.fromhex(text)
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES:
        raise ValueError(f"{path}: expected {2 * KEY_BYTES} hexadecimal digits, found {len(text)} characters")
    return key


def signature(key: bytes, packet: bytes) -> bytes:
    """Return the signature of a packet, its last 6 bytes, computed over everything before them."""
    return hashlib.sha256(key + packet).digest()[:6]


class Verifier:
    """Verifier of signed packets of all streams; a stream is (link id, system, component)."""

    def __init__(self, key: bytes, now_ticks: int) -> None:
        """Create a verifier; `now_ticks`: current time as a timestamp, for checking new streams."""
        self._key = key
        self.timestamp = now_ticks
        self._streams: dict[tuple[int, int, int], int] = {}

    def accepts(self, packet: bytes) -> bool:
        """Return whether a complete MAVLink 2 packet is signed with the key and newer than the last of its stream."""
        if not packet[2] & _SIGNED_FLAG:
            return False
        block = packet[-BLOCK_BYTES:]
        if not hmac.compare_digest(signature(self._key, packet[:-6]), block[7:]):
            return False
        stream, timestamp = (block[0], packet[5], packet[6]), int.from_bytes(block[1:7], "little")
        last = self._streams.get(stream, self.timestamp - _NEW_STREAM_BEHIND - 1)
        if timestamp <= last:
            return False
        self._streams[stream] = timestamp
        self.timestamp = max(self.timestamp, timestamp)
        return True
