"""End-to-end protection of the base's frames: CRC-8 and a counter in every one of them. Pure.

In the manner of AUTOSAR's E2E profile 1: the identifier goes into the CRC, so that a frame that arrives under another
identifier is wrong too; byte 0 holds the CRC, the low half of byte 1 the counter.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import Final

COUNTER_PERIOD: Final = 16
MAX_AHEAD: Final = 6  # frames further ahead than this are rather older ones, come late


@dataclass(frozen=True)
class Frame:
    """A CAN 2.0A data frame; `error`: an error frame instead, with the kernel's error class in `identifier`."""

    identifier: int
    data: bytes
    error: bool = False

    def __post_init__(self) -> None:
        if len(self.data) > 8:
            raise ValueError(f"CAN frame 0x{self.identifier:x}: expected up to 8 bytes, found {len(self.data)}")


class Verdict(Enum):
    """What a receiver makes of a frame. Only GOOD ones are obeyed."""

    GOOD = auto()
    FIRST = auto()  # of a stream: right, but nothing says yet that it is new
    REPEATED = auto()
    OUT_OF_ORDER = auto()
    WRONG_CRC = auto()
    WRONG_LENGTH = auto()


def _table() -> tuple[int, ...]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = (value << 1) ^ 0x1D if value & 0x80 else value << 1
        table.append(value & 0xFF)
    return tuple(table)


_CRC_TABLE: Final = _table()


def crc8_j1850(data: bytes) -> int:
    """CRC-8 SAE J1850: polynomial 0x1D, start 0xFF, final XOR 0xFF; of b"123456789" it is 0x4B."""
    crc = 0xFF
    for byte in data:
        crc = _CRC_TABLE[crc ^ byte]
    return crc ^ 0xFF


def frame_crc(identifier: int, data: bytes) -> int:
    """What byte 0 of a frame must be."""
    return crc8_j1850(bytes((identifier & 0xFF, identifier >> 8)) + data[1:])


def protect(identifier: int, data: bytes, counter: int) -> bytes:
    """The payload with counter and CRC put in; `data` has at least 2 bytes."""
    body = bytes((0, (data[1] & 0xF0) | counter)) + data[2:]
    return bytes((frame_crc(identifier, body),)) + body[1:]


class Checker:
    """Judges the frames of one identifier as they arrive."""

    def __init__(self, length: int) -> None:
        """`length`: bytes that a frame must have."""
        self._length = length
        self._last: int | None = None
        self._trusted = False
        self.lost = 0
        self.newly_lost = 0

    def check(self, frame: Frame) -> Verdict:
        """The verdict; `newly_lost` then is how many frames are missing before a GOOD one, `lost` all of them."""
        self.newly_lost = 0
        if len(frame.data) != self._length:
            return Verdict.WRONG_LENGTH
        if frame.data[0] != frame_crc(frame.identifier, frame.data):
            return Verdict.WRONG_CRC
        counter, last = frame.data[1] & 0x0F, self._last
        if last is None:
            self._last, self._trusted = counter, False
            return Verdict.FIRST
        ahead = (counter - last) % COUNTER_PERIOD
        if ahead == 0:
            return Verdict.REPEATED
        self._last = counter
        if ahead > MAX_AHEAD:
            # Follow it nevertheless, without trust: a sender that was switched off and on goes on from here.
            self._trusted = False
            return Verdict.OUT_OF_ORDER
        if not self._trusted:
            self._trusted = True
            return Verdict.GOOD
        self.newly_lost = ahead - 1
        self.lost += ahead - 1
        return Verdict.GOOD

    def forget(self) -> None:
        """The stream has ended: the next frame is the first of another."""
        self._last = None
