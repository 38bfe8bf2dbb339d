"""End-to-end protection of CAN frames: a CRC-8 and a counter in every frame. Pure functions and state.

Similar to AUTOSAR E2E profile 1. The CRC covers the identifier, so a frame received under another identifier is
invalid. Byte 0 contains the CRC, the low half of byte 1 the counter.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import Final

COUNTER_PERIOD: Final = 16
MAX_AHEAD: Final = 6  # a counter further ahead than this more likely belongs to an older, delayed frame


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
    """Result of checking a frame. Only GOOD frames are obeyed."""

    GOOD = auto()
    FIRST = auto()  # first of a stream: valid, but possibly old
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
    """Return the CRC for byte 0 of a frame."""
    return crc8_j1850(bytes((identifier & 0xFF, identifier >> 8)) + data[1:])


def protect(identifier: int, data: bytes, counter: int) -> bytes:
    """Return the payload with counter and CRC inserted; `data` has at least 2 bytes."""
    body = bytes((0, (data[1] & 0xF0) | counter)) + data[2:]
    return bytes((frame_crc(identifier, body),)) + body[1:]


class Checker:
    """Checker for the frames of one identifier, in order of arrival."""

    def __init__(self, length: int) -> None:
        """Create a checker; `length`: required bytes of a frame."""
        self._length = length
        self._last: int | None = None
        self._trusted = False
        self.lost = 0
        self.newly_lost = 0

    def check(self, frame: Frame) -> Verdict:
        """Check a frame; `newly_lost` is then the number of frames missing before a GOOD one, `lost` their total."""
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
            # Accept the new counter without trust: a restarted sender continues from it.
            self._trusted = False
            return Verdict.OUT_OF_ORDER
        if not self._trusted:
            self._trusted = True
            return Verdict.GOOD
        self.newly_lost = ahead - 1
        self.lost += ahead - 1
        return Verdict.GOOD

    def forget(self) -> None:
        """Reset after the end of a stream: the next frame counts as FIRST."""
        self._last = None
