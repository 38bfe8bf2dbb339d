"""MAVLink packets in datagrams: encoding, decoding, signatures, and counts of invalid input. Pure.

The dialect is pymavlink's `common`, version 2; packets of version 1 are accepted and answered in version 2.
"""

from __future__ import annotations

import hashlib
import hmac
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from pymavlink.dialects.v20 import common

from firmware_bridge.system.input_file import read_text

Message = Any
"""One of pymavlink's message objects: fields as attributes, `get_msgId()`, `get_srcSystem()`."""

_V1, _V2 = 0xFE, 0xFD
_V1_HEADER: Final = 6
_V2_HEADER: Final = 10
_CRC: Final = 2
_SIGNED_FLAG: Final = 0x01
KEY_BYTES: Final = 32
BLOCK_BYTES: Final = 13  # link id, timestamp 48 bits, signature 48 bits
TICKS_PER_S: Final = 100_000  # unit of the timestamp: 10 us since 1 January 2015
EPOCH_UNIX_S: Final = 1_420_070_400
_NEW_STREAM_BEHIND: Final = 60 * TICKS_PER_S
# Messages of other dialects are valid, so they are counted separately.
_UNKNOWN: Final = common.MAVLink_unknown


@dataclass
class Counts:
    """Counts of rejected packets."""

    broken: int = 0  # not a packet, truncated, or wrong checksum
    unsigned: int = 0  # signature missing, wrong or old, while a key is set
    unknown: int = 0  # messages of other dialects
    not_for_us: int = 0  # messages for another system or component
    unusable: int = 0  # valid packets with invalid values

    @property
    def malformed(self) -> int:
        """Number of invalid packets."""
        return self.broken + self.unsigned + self.unusable


def _length(data: bytes, at: int) -> int:
    """Return the length of the packet that begins at `at`; 0 if there is none."""
    left = len(data) - at
    if left > 3 and data[at] == _V2 and not data[at + 2] & ~_SIGNED_FLAG:
        signed = BLOCK_BYTES if data[at + 2] & _SIGNED_FLAG else 0
        length = _V2_HEADER + data[at + 1] + _CRC + signed
    elif left > 1 and data[at] == _V1:
        length = _V1_HEADER + data[at + 1] + _CRC
    else:
        return 0
    return length if length <= left else 0


class Reader:
    """Decoder of datagrams."""

    def __init__(self, verifier: Verifier | None = None) -> None:
        """Create a decoder; with a `verifier`, packets that it rejects are dropped."""
        self.counts = Counts()
        self._verifier = verifier
        self._parser = common.MAVLink(None)

    def read(self, data: bytes) -> list[Message]:
        """Return the messages of one datagram; after invalid data the rest is ignored."""
        return [message for packet in self._packets(data) if (message := self._decode(packet)) is not None]

    def _packets(self, data: bytes) -> Iterator[bytes]:
        at = 0
        while at < len(data):
            length = _length(data, at)
            if length == 0:
                self.counts.broken += 1
                return
            yield data[at : at + length]
            at += length

    def _decode(self, packet: bytes) -> Message | None:
        try:
            message = self._parser.decode(bytearray(packet))
        except common.MAVError:
            self.counts.broken += 1
            return None
        if self._verifier is not None and not (packet[0] == _V2 and self._verifier.accepts(packet)):
            self.counts.unsigned += 1
            return None
        if isinstance(message, _UNKNOWN):
            self.counts.unknown += 1
            return None
        return message


class Writer:
    """Encoder of one sender's packets, with sequence numbers and, given a key, signatures."""

    def __init__(self, system: int, component: int, key: bytes | None = None, now_ticks: int = 0) -> None:
        self._packer = common.MAVLink(None, srcSystem=system, srcComponent=component)
        if key is not None:
            self._packer.signing.secret_key = key
            self._packer.signing.sign_outgoing = True
            self._packer.signing.timestamp = now_ticks

    def advance(self, now_ticks: int) -> None:
        """Set the clock of the signatures, which never goes back: a reader refuses a stream a minute behind its own."""
        self._packer.signing.timestamp = max(self._packer.signing.timestamp, now_ticks)

    def pack(self, message: Message) -> bytes:
        """Return a message as bytes."""
        data = bytes(message.pack(self._packer))
        self._packer.seq = (self._packer.seq + 1) % 256
        return data


def now_ticks() -> int:
    """Return the current time as a signature timestamp; the only use of wall-clock time, required by the protocol."""
    return (time.time_ns() - EPOCH_UNIX_S * 1_000_000_000) * TICKS_PER_S // 1_000_000_000


MAX_KEY_FILE_BYTES: Final = 1000


def read_key(path: Path) -> bytes:
    """Read the secret key, 64 hexadecimal digits in a file. Raises ValueError or OSError."""
    text = read_text(path, MAX_KEY_FILE_BYTES).strip()
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
    """Verifier of signed packets of all streams; a stream is (link id, system, component).

    A timestamp is stored only after the signature is verified (mavlink.io, "Message Signing"): pymavlink's own check
    stores it first, so that a forged packet from the future makes genuine packets look old.
    """

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
