"""CAN frames over a serial line or a pty, in python-can's serial format; no call waits longer than its timeout."""

from __future__ import annotations

import os
import select
import struct
import time
from typing import Final

import can
from can.interfaces.serial.serial_can import SerialBus

from firmware_bridge.system.serial_backlog import SerialBacklog

_START: Final = 0xAA
_END: Final = 0xBB
_HEAD: Final = struct.Struct("<BIBI")
_FLAG_EXTENDED: Final = 0x80000000
_FLAG_REMOTE: Final = 0x40000000
_FLAG_ERROR: Final = 0x20000000


class SerialFrames:
    """Decoder of python-can's serial format that resynchronises after lost or wrong bytes.

    Frame: 0xAA, time stamp (4 bytes), length, identifier (4 bytes, little endian, flags as in the kernel), data, 0xBB.
    """

    def __init__(self) -> None:
        self._bytes = bytearray()
        self.errors = 0

    def put(self, data: bytes) -> None:
        """Add received bytes."""
        self._bytes += data

    def take(self) -> can.Message | None:
        """Return the next message; None if more bytes are needed."""
        while (start := self._bytes.find(_START)) >= 0:
            del self._bytes[:start]
            if len(self._bytes) < _HEAD.size:
                return None
            _, stamp_ms, length, identifier = _HEAD.unpack_from(self._bytes)
            end = _HEAD.size + length
            if length <= 8 and len(self._bytes) <= end:
                return None
            if length <= 8 and self._bytes[end] == _END:
                data = bytes(self._bytes[_HEAD.size : end])
                del self._bytes[: end + 1]
                return _message(stamp_ms / 1000, identifier, data)
            del self._bytes[0]  # a start byte without a frame behind it
            self.errors += 1
        self._bytes.clear()
        return None


def _message(stamp_s: float, identifier: int, data: bytes) -> can.Message:
    return can.Message(
        timestamp=stamp_s,
        arbitration_id=identifier & 0x1FFFFFFF,
        data=data,
        is_extended_id=bool(identifier & _FLAG_EXTENDED),
        is_remote_frame=bool(identifier & _FLAG_REMOTE),
        is_error_frame=bool(identifier & _FLAG_ERROR),
    )


class SerialLine(SerialBus):
    """python-can's serial bus without waiting, and with resynchronisation after lost bytes. Raises OSError."""

    def __init__(self, channel: str) -> None:
        super().__init__(channel, timeout=0.0)
        self._frames = SerialFrames()
        self._rest = b""  # of a frame of which the line has taken the beginning
        self._backlog = SerialBacklog()

    @property
    def line_errors(self) -> int:
        """Number of start bytes without a valid frame."""
        return self._frames.errors

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        message = self._frames.take()
        if message is None and select.select([self._ser.fileno()], [], [], timeout)[0]:
            self._frames.put(self._ser.read(max(1, self._ser.in_waiting)))
            message = self._frames.take()
        return message, False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send one frame whole or not at all, waiting at most `timeout`. Raises can.CanError or OSError.

        A frame of which the line has taken a part is completed before the next one.
        """
        identifier = msg.arbitration_id | (_FLAG_EXTENDED if msg.is_extended_id else 0)
        identifier |= (_FLAG_REMOTE if msg.is_remote_frame else 0) | (_FLAG_ERROR if msg.is_error_frame else 0)
        frame = _HEAD.pack(_START, 0, msg.dlc, identifier) + bytes(msg.data) + bytes((_END,))
        behind = self._backlog.is_behind(self._ser.out_waiting, time.monotonic_ns())
        self._rest = self._written(self._rest, timeout)
        if self._rest or behind:
            raise can.CanOperationError("the serial line takes no bytes")
        left = self._written(frame, timeout)
        if len(left) == len(frame):
            raise can.CanOperationError("the serial line takes no bytes")
        self._rest = left

    def _written(self, data: bytes, timeout: float | None) -> bytes:
        """Write what the line takes and return the rest."""
        if not data or not select.select([], [self._ser.fileno()], [], timeout or 0.0)[1]:
            return data
        try:
            return data[os.write(self._ser.fileno(), data) :]
        except BlockingIOError:
            return data
