"""Non-blocking access to a CAN bus of python-can: one thread receives and one sends.

Interfaces: "serial" (a serial line or a pty), "socketcan" (a real bus), "virtual" (inside one process) and
"udp_multicast" (several processes of one machine, on its loopback interface only).
"""

from __future__ import annotations

import contextlib
import queue
import struct
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Final

import can
from can.interfaces.serial.serial_can import SerialBus

from sim_hil.protocols.can.e2e import Frame
from sim_hil.protocols.can.multicast import LoopbackMulticastBus

INTERFACES: Final = ("serial", "socketcan", "virtual", "udp_multicast")
_LISTEN_S: Final = 0.1
_SEND_QUEUE: Final = 256
_RECEIVE_QUEUE: Final = 4096
_SERIAL_TIMEOUT_S: Final = 0.05
_SERIAL_WRITE_S: Final = 0.5  # long, because a write aborted inside a frame also corrupts the next frame
_END_S: Final = 1.0
_SERIAL_START: Final = 0xAA
_SERIAL_END: Final = 0xBB
_SERIAL_HEAD: Final = struct.Struct("<BIBI")


class BusError(RuntimeError):
    """The bus cannot be opened, or it was lost."""


@dataclass(frozen=True)
class BusAddress:
    """Address of a bus: `interface` and `channel` of python-can."""

    interface: str
    channel: str

    def __post_init__(self) -> None:
        if self.interface not in INTERFACES or not self.channel:
            raise ValueError(
                f"CAN bus: expected INTERFACE:CHANNEL with an interface of {', '.join(INTERFACES)}, "
                f"found {self.interface}:{self.channel}"
            )

    @staticmethod
    def parse(text: str) -> BusAddress:
        """Parse INTERFACE:CHANNEL. Raises ValueError."""
        interface, _, channel = text.partition(":")
        return BusAddress(interface, channel)

    def __str__(self) -> str:
        return f"{self.interface}:{self.channel}"


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
        while (start := self._bytes.find(_SERIAL_START)) >= 0:
            del self._bytes[:start]
            if len(self._bytes) < _SERIAL_HEAD.size:
                return None
            _, stamp_ms, length, identifier = _SERIAL_HEAD.unpack_from(self._bytes)
            end = _SERIAL_HEAD.size + length
            if length <= 8 and len(self._bytes) <= end:
                return None
            if length <= 8 and self._bytes[end] == _SERIAL_END:
                data = bytes(self._bytes[_SERIAL_HEAD.size : end])
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
        is_extended_id=bool(identifier & 0x80000000),
        is_remote_frame=bool(identifier & 0x40000000),
        is_error_frame=bool(identifier & 0x20000000),
    )


class _SerialBus(SerialBus):
    """python-can's serial bus with a write timeout and with resynchronisation after lost bytes."""

    def __init__(self, channel: str) -> None:
        super().__init__(channel, timeout=_SERIAL_TIMEOUT_S)
        self._ser.write_timeout = _SERIAL_WRITE_S
        self._frames = SerialFrames()

    @property
    def line_errors(self) -> int:
        """Number of start bytes without a valid frame."""
        return self._frames.errors

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        message = self._frames.take()
        if message is None:
            self._frames.put(self._ser.read(max(1, self._ser.in_waiting)))
            message = self._frames.take()
        return message, False


def open_bus(address: BusAddress) -> can.BusABC:
    """Open the bus. Raises BusError with one line."""
    try:
        if address.interface == "serial":
            return _SerialBus(address.channel)
        if address.interface == "udp_multicast":
            return LoopbackMulticastBus(address.channel)
        return can.Bus(channel=address.channel, interface=address.interface)
    except (can.CanError, OSError, ValueError, ImportError) as error:  # pyserial's SerialException is an OSError
        raise BusError(f"CAN bus {address}: cannot be opened: {error}") from error


class BusLink:
    """Link to a bus whose `send` and `receive` never wait; frames are stamped with time.monotonic_ns."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._received: deque[tuple[int, Frame]] = deque(maxlen=_RECEIVE_QUEUE)
        self._arrived = threading.Event()
        self._to_send: queue.Queue[Frame | None] = queue.Queue(_SEND_QUEUE)
        self._ending = False
        self._failure: Exception | None = None
        self.sent = 0
        self.unsent = 0
        self._threads = [
            threading.Thread(target=work, name=f"can-{work.__name__}", daemon=True)
            for work in (self._listen, self._send_all)
        ]
        for thread in self._threads:
            thread.start()

    @property
    def line_errors(self) -> int:
        """Number of invalid serial frames or multicast datagrams."""
        return int(getattr(self._bus, "line_errors", 0))

    @property
    def pending(self) -> int:
        """Number of frames waiting to be sent."""
        return self._to_send.qsize()

    def send(self, frame: Frame) -> None:
        """Queue a frame; if the queue is full, because the line takes no data, the frame counts as `unsent`."""
        try:
            self._to_send.put_nowait(frame)
        except queue.Full:
            self.unsent += 1

    def receive(self) -> list[tuple[int, Frame]]:
        """Return the frames since the last call with their receive times, ns. Raises BusError if the bus was lost."""
        if self._failure is not None:
            raise BusError(f"CAN bus {self._bus.channel_info}: connection lost: {self._failure}")
        self._arrived.clear()
        received = []
        while self._received:
            received.append(self._received.popleft())
        return received

    def wait(self, left_ns: int) -> None:
        """Wait until a frame arrives, at most `left_ns`."""
        self._arrived.wait(left_ns / 1e9)

    def close(self) -> None:
        """End both threads and close the bus; may be called twice."""
        if self._ending:
            return
        self._ending = True
        with contextlib.suppress(queue.Full):  # then the thread checks _ending after the next frame
            self._to_send.put_nowait(None)
        for thread in self._threads:
            thread.join(_END_S)
        self._bus.shutdown()

    def _listen(self) -> None:
        while not self._ending:
            try:
                message = self._bus.recv(_LISTEN_S)
            except (can.CanError, OSError, TypeError) as error:  # TypeError: pyserial, closed while it reads
                if not self._ending:
                    self._failure = error
                    self._arrived.set()
                return
            if message is not None and (message.is_error_frame or _is_ours(message)):
                self._note(message)

    def _note(self, message: can.Message) -> None:
        frame = Frame(message.arbitration_id, bytes(message.data[:8]), error=message.is_error_frame)
        self._received.append((time.monotonic_ns(), frame))
        self._arrived.set()

    def _send_all(self) -> None:
        while not self._ending:
            frame = self._to_send.get()
            if frame is None:
                return
            message = can.Message(
                arbitration_id=frame.identifier,
                data=frame.data,
                is_extended_id=False,
                is_error_frame=frame.error,
            )
            try:
                self._bus.send(message, timeout=_SERIAL_TIMEOUT_S)
                self.sent += 1
            except (can.CanError, OSError):  # no receiver, full queue or bus off: the frame is lost, as on a real bus
                self.unsent += 1


def _is_ours(message: can.Message) -> bool:
    return not (message.is_remote_frame or message.is_extended_id)
