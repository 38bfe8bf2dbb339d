"""End-to-end protection of CAN frames: a CRC and a counter in every frame. Pure.

Similar to AUTOSAR E2E profile 1: the CRC may cover the identifier, so that a frame received under another identifier is
invalid.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, auto

from firmware_bridge.can.frame import Frame


class Verdict(Enum):
    """Result of checking a frame. Only GOOD frames are obeyed."""

    GOOD = auto()
    FIRST = auto()  # first of a stream: valid, but possibly old
    REPEATED = auto()
    OUT_OF_ORDER = auto()
    WRONG_CRC = auto()
    WRONG_LENGTH = auto()


@dataclass(frozen=True)
class Crc:
    """CRC of 8 or 16 bits; `reflected`: the lowest bit of each byte goes first."""

    bits: int
    polynomial: int
    initial: int
    final_xor: int
    reflected: bool = False
    _table: tuple[int, ...] = field(init=False, repr=False, compare=False, default=())

    def __post_init__(self) -> None:
        object.__setattr__(self, "_table", tuple(map(self._remainder, range(256))))

    def _remainder(self, byte: int) -> int:
        mask, top = (1 << self.bits) - 1, 1 << (self.bits - 1)
        if self.reflected:
            low_first, value = int(f"{self.polynomial:0{self.bits}b}"[::-1], 2), byte
            for _ in range(8):
                value = (value >> 1) ^ low_first if value & 1 else value >> 1
            return value
        value = byte << (self.bits - 8)
        for _ in range(8):
            value = ((value << 1) ^ self.polynomial if value & top else value << 1) & mask
        return value

    def of(self, data: bytes) -> int:
        """Return the CRC of these bytes."""
        value, mask, shift = self.initial, (1 << self.bits) - 1, self.bits - 8
        for byte in data:
            if self.reflected:
                value = (value >> 8) ^ self._table[(value ^ byte) & 0xFF]
            else:
                value = ((value << 8) & mask) ^ self._table[(value >> shift) ^ byte]
        return value ^ self.final_xor


@dataclass(frozen=True)
class Protection:
    """Protection of one message: where CRC and counter are, and what the CRC covers.

    `crc_bytes`: indices of the CRC's bytes, most significant first. `counter_shift`: position of the counter's lowest
    bit in byte `counter_byte`. `covers`: names of config_can.CRC_INPUTS, in the order in which the CRC takes them.
    """

    crc: Crc
    crc_bytes: tuple[int, ...]
    covers: tuple[str, ...]
    counter_byte: int
    counter_shift: int
    counter_mask: int
    counter_period: int
    max_ahead: int

    def crc_of(self, identifier: int, data: bytes) -> int:
        """Return the CRC of a frame, whatever its CRC bytes contain."""
        parts = {
            "id_low": bytes((identifier & 0xFF,)),
            "id_high": bytes((identifier >> 8 & 0xFF,)),
            "length": bytes((len(data),)),
            "data": bytes(byte for index, byte in enumerate(data) if index not in self.crc_bytes),
        }
        return self.crc.of(b"".join(parts[name] for name in self.covers))

    def protect(self, identifier: int, data: bytes, counter: int) -> bytes:
        """Return the data with counter and CRC inserted."""
        body, bits = bytearray(data), self.counter_mask << self.counter_shift
        body[self.counter_byte] = body[self.counter_byte] & ~bits & 0xFF | counter << self.counter_shift
        crc = self.crc_of(identifier, bytes(body))
        for place, index in enumerate(reversed(self.crc_bytes)):
            body[index] = crc >> 8 * place & 0xFF
        return bytes(body)

    def is_intact(self, identifier: int, data: bytes) -> bool:
        """Return whether the frame contains its own CRC."""
        found = int.from_bytes(bytes(data[index] for index in self.crc_bytes), "big")
        return found == self.crc_of(identifier, data)

    def counter(self, data: bytes) -> int:
        """Return the counter of a frame."""
        return data[self.counter_byte] >> self.counter_shift & self.counter_mask


class Checker:
    """Checker for the frames of one identifier, in order of arrival."""

    def __init__(self, length: int, protection: Protection | None) -> None:
        """`length`: required bytes of a frame. Without `protection`, every frame of that length is GOOD."""
        self._length = length
        self._protection = protection
        self._last: int | None = None
        self._trusted = False
        self.newly_lost = 0

    def check(self, frame: Frame) -> Verdict:
        """Check a frame; `newly_lost` is then the number of frames missing before a GOOD one."""
        self.newly_lost = 0
        protection = self._protection
        if len(frame.data) != self._length:
            return Verdict.WRONG_LENGTH
        if protection is None:
            return Verdict.GOOD
        if not protection.is_intact(frame.identifier, frame.data):
            return Verdict.WRONG_CRC
        counter, last = protection.counter(frame.data), self._last
        if counter >= protection.counter_period:
            return Verdict.OUT_OF_ORDER
        if last is None:
            self._last, self._trusted = counter, False
            return Verdict.FIRST
        ahead = (counter - last) % protection.counter_period
        if ahead == 0:
            return Verdict.REPEATED
        self._last = counter
        if ahead > protection.max_ahead:
            # Accept the new counter without trust: a restarted sender continues from it.
            self._trusted = False
            return Verdict.OUT_OF_ORDER
        if not self._trusted:
            self._trusted = True
            return Verdict.GOOD
        self.newly_lost = ahead - 1
        return Verdict.GOOD

    def forget(self) -> None:
        """Reset after the end of a stream: the next frame counts as FIRST."""
        self._last = None
