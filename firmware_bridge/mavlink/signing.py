"""Message signatures (mavlink.io, "Message Signing"): the key file, checks of received packets, our own timestamps.

The clock is the wall clock, read once at start, plus the monotonic time since then.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import stat
import time
from pathlib import Path
from typing import Final

from firmware_bridge.core.sections import ConfigError

KEY_BYTES: Final = 32
BLOCK_BYTES: Final = 13  # link id, timestamp 48 bits, signature 48 bits
SIGNED_FLAG: Final = 0x01
RADIO_STATUS: Final = 109  # sent by radios themselves, which have no key; nothing here depends on it
TICKS_PER_S: Final = 100_000  # unit of the timestamp: 10 us since 1 January 2015
_EPOCH_UNIX_S: Final = 1_420_070_400
_NS_PER_TICK: Final = 10_000
_NEW_STREAM_BEHIND: Final = 60 * TICKS_PER_S  # the protocol's own bound for a stream that is not known yet
_AHEAD: Final = 60 * TICKS_PER_S  # our choice, as large: a packet from further ahead would make genuine ones look old
_MAX_STREAMS: Final = 64  # only owners of the key can open one


def read_key(path: Path) -> bytes:
    """Read the key: 32 bytes, or 64 hexadecimal digits. Raises ConfigError, also for a file that others may read."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            info, data = os.fstat(descriptor), os.read(descriptor, 2 * KEY_BYTES + 2)
        finally:
            os.close(descriptor)
    except OSError as error:
        raise ConfigError(f"mavlink.signing_key {path}: expected a readable file, {error.strerror}") from error
    mode = stat.S_IMODE(info.st_mode)
    if not stat.S_ISREG(info.st_mode) or mode & 0o077:
        raise ConfigError(f"mavlink.signing_key {path}: expected a file with mode 0600, found {mode:04o}; chmod 600 it")
    if len(data) == KEY_BYTES:
        return data
    try:
        key = bytes.fromhex(data.decode("ascii"))
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES:
        raise ConfigError(f"mavlink.signing_key {path}: expected 32 bytes or 64 hexadecimal digits")
    return key


def wall_ticks() -> int:
    """Return the wall clock as a signature timestamp; the protocol requires it."""
    return (time.time_ns() - _EPOCH_UNIX_S * 1_000_000_000) // _NS_PER_TICK


class Signatures:
    """Checks received packets and gives the timestamps of sent ones; every stream's packets pass once and in order."""

    def __init__(self, key: bytes, start_ticks: int, start_ns: int) -> None:
        """`start_ticks`: the current time as a timestamp, `start_ns`: the same instant on the monotonic clock."""
        self.key = key
        self.from_future = 0
        self._start_ticks, self._start_ns = start_ticks, start_ns
        self._sent = 0
        self._streams: dict[tuple[int, int, int], int] = {}

    def now_ticks(self, now_ns: int) -> int:
        """Return the current time as a timestamp."""
        return self._start_ticks + (now_ns - self._start_ns) // _NS_PER_TICK

    def next_ticks(self, now_ns: int) -> int:
        """Return the timestamp of the next packet to send: never an earlier one twice."""
        self._sent = max(self._sent + 1, self.now_ticks(now_ns))
        return self._sent

    def accepts(self, packet: bytes, now_ns: int) -> bool:
        """Return whether a complete MAVLink 2 packet has a valid signature, is new, and is not from the future.

        Nothing is stored before the signature is verified, so a forged packet cannot make genuine ones look old.
        """
        if not packet[2] & SIGNED_FLAG:
            return False
        block = packet[-BLOCK_BYTES:]
        expected = hashlib.sha256(self.key + packet[:-6]).digest()[:6]
        if not hmac.compare_digest(expected, block[7:]):
            return False
        now, stream = self.now_ticks(now_ns), (block[0], packet[5], packet[6])
        ticks = int.from_bytes(block[1:7], "little")
        if ticks > now + _AHEAD:
            self.from_future += 1
            return False
        newest = self._streams.get(stream)
        if ticks <= (now - _NEW_STREAM_BEHIND - 1 if newest is None else newest):
            return False
        if newest is None and len(self._streams) >= _MAX_STREAMS:
            return False
        self._streams[stream] = ticks
        return True
