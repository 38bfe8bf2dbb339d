"""MAVLink packets: found in received bytes, checked, decoded; and encoded. No socket, no clock.

The dialect is pymavlink's `ardupilotmega`, which contains `common`. Packets of version 1 are read too, except on a
signed link: they have no signature.
"""

from __future__ import annotations

import struct
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, Final

from pymavlink.dialects.v20 import ardupilotmega as dialect
from pymavlink.generator.mavcrc import x25crc

from firmware_bridge.mavlink.signing import BLOCK_BYTES, RADIO_STATUS, SIGNED_FLAG, Signatures

Message = Any
"""One of pymavlink's message objects: fields as attributes, `get_msgId()`, `get_srcSystem()`, `get_seq()`."""

_V1, _V2 = 0xFE, 0xFD
_V1_HEADER: Final = 6
_V2_HEADER: Final = 10
_CRC: Final = 2
_MAX_BUFFER_BYTES: Final = 8192  # of a serial line: four steps at 2 Mbaud
_MAX_PACKETS: Final = 256  # examined per step, wanted or not: each costs a checksum, on a signed link a hash
_MAX_FAILURES: Final = 32  # false packet starts per call: each costs a checksum
_INCOMPLETE: Final = -1


@dataclass
class Counts:
    """Counts of rejected packets."""

    broken: int = 0  # not a packet, truncated, or wrong checksum
    unsigned: int = 0  # signature missing, wrong or old, on a signed link
    strange: int = 0  # packets of other systems, or values that cannot be true

    @property
    def malformed(self) -> int:
        """Number of rejected packets."""
        return self.broken + self.unsigned + self.strange


class Reader:
    """Decoder of one link. A datagram is read whole; on a serial line (`stream`) packets may arrive in pieces."""

    def __init__(self, wanted: Collection[int], signatures: Signatures | None = None, *, stream: bool = False) -> None:
        """`wanted`: numbers of the messages to decode; others are skipped."""
        self.counts = Counts()
        self._wanted = frozenset(wanted)
        self._signatures = signatures
        self._stream = stream
        self._buffer = b""
        self._left = _MAX_PACKETS
        self._parser = dialect.MAVLink(None)

    def begin_step(self) -> None:
        """Begin a step of the bridge, in which a bounded number of packets is examined."""
        self._left = _MAX_PACKETS

    def read(self, data: bytes, now_ns: int) -> list[Message]:
        """Return the wanted messages in `data`; after the first bad byte of a datagram, none.

        What one step's limit leaves over waits for the next step on a serial line, and is lost in a datagram.
        """
        buffer = (self._buffer + data)[-_MAX_BUFFER_BYTES:]
        messages: list[Message] = []
        at = failures = 0
        while at < len(buffer) and self._left > 0 and failures < _MAX_FAILURES:
            length = _length(buffer, at)
            if length == _INCOMPLETE and self._stream:
                break
            self._left -= 1
            packet = buffer[at : at + length] if length > 0 else b""
            if not packet or not self._is_whole(packet, buffer[at + length : at + length + 1]):
                self.counts.broken += 1
                if not self._stream:
                    return messages
                failures, at = failures + 1, _next_start(buffer, at + 1)
                continue
            at += length
            if (message := self._decode(packet, now_ns)) is not None:
                messages.append(message)
        self._buffer = buffer[at:] if self._stream else b""
        return messages

    def _is_whole(self, packet: bytes, following: bytes) -> bool:
        """Whether the checksum is right; that of an unknown message cannot be computed, so its successor decides."""
        number = _number(packet)
        message = dialect.mavlink_map.get(number)
        if message is None:
            return following in (b"", b"\xfd", b"\xfe")
        end = len(packet) - (BLOCK_BYTES if _is_signed(packet) else 0)
        crc = x25crc(packet[1 : end - _CRC] + bytes((message.crc_extra,)))
        (found,) = struct.unpack_from("<H", packet, end - _CRC)
        return bool(crc.crc == found)

    def _decode(self, packet: bytes, now_ns: int) -> Message | None:
        number = _number(packet)
        # The signature comes first, also of a message that is skipped: its timestamp makes an earlier one old.
        if self._signatures is not None and number != RADIO_STATUS:
            signed = packet[0] == _V2 and self._signatures.accepts(packet, now_ns)
            if not signed:
                self.counts.unsigned += 1
                return None
        if number not in self._wanted or number not in dialect.mavlink_map:
            return None
        try:
            return self._parser.decode(bytearray(packet))
        except dialect.MAVError:
            self.counts.broken += 1
            return None


class Writer:
    """Encoder of our packets, with sequence numbers and, on a signed link, signatures."""

    def __init__(self, system: int, component: int, signatures: Signatures | None = None) -> None:
        self._packer = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        self._signatures = signatures
        if signatures is not None:
            self._packer.signing.secret_key = signatures.key
            self._packer.signing.sign_outgoing = True

    def pack(self, message: Message, now_ns: int) -> bytes:
        """Return a message as bytes."""
        if self._signatures is not None:
            self._packer.signing.timestamp = self._signatures.next_ticks(now_ns)
        data = bytes(message.pack(self._packer))
        self._packer.seq = (self._packer.seq + 1) % 256
        return data


def _length(data: bytes, at: int) -> int:
    """Return the length of the packet that begins at `at`: 0 if there is none, _INCOMPLETE if its end is missing."""
    if data[at] not in (_V1, _V2):
        return 0
    left = len(data) - at
    if left < 3:
        return _INCOMPLETE
    if data[at] == _V1:
        length = _V1_HEADER + data[at + 1] + _CRC
    elif data[at + 2] & ~SIGNED_FLAG:
        return 0
    else:
        signed = BLOCK_BYTES if data[at + 2] & SIGNED_FLAG else 0
        length = _V2_HEADER + data[at + 1] + _CRC + signed
    return length if length <= left else _INCOMPLETE


def _next_start(data: bytes, at: int) -> int:
    """Return the position of the next byte that may begin a packet."""
    found = [position for position in (data.find(_V2, at), data.find(_V1, at)) if position >= 0]
    return min(found, default=len(data))


def _is_signed(packet: bytes) -> bool:
    return packet[0] == _V2 and bool(packet[2] & SIGNED_FLAG)


def _number(packet: bytes) -> int:
    return packet[5] if packet[0] == _V1 else int.from_bytes(packet[7:10], "little")
