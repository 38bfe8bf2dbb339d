"""Non-blocking access to a CAN bus of python-can: one thread receives and one sends.

Interfaces: "serial" (a serial line or a pty), "socketcan" (a real bus), "virtual" (inside one process) and
"udp_multicast" (several processes of one machine, on its loopback interface only; python-can's own bus listens on every
interface and ends at the first datagram that is not a frame).
"""

from __future__ import annotations

import contextlib
import ipaddress
import queue
import select
import socket
import struct
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Final

import can
import msgpack
from can.interfaces.serial.serial_can import SerialBus
from can.interfaces.udp_multicast.utils import pack_message

from sim_hil.protocols.can.frames import Frame

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


PORT: Final = 43113  # default of python-can
_LOOPBACK: Final = b"lo"
_MAX_DATAGRAM: Final = 4096
_FLAGS: Final = ("is_extended_id", "is_remote_frame", "is_error_frame")


class LoopbackMulticastBus(can.BusABC):
    """CAN bus between processes of one machine that join the same multicast address on its loopback interface."""

    def __init__(self, channel: str) -> None:
        """Join `channel`, an address in 224.0.0.0/4 (loopback has no IPv6 multicast). Raises ValueError or OSError."""
        try:
            group = ipaddress.IPv4Address(channel)
        except ValueError:
            group = None
        if group is None or not group.is_multicast:
            raise ValueError(f"expected an IPv4 multicast address such as 239.74.163.2, found {channel!r}")
        self.line_errors = 0
        """Number of datagrams without a valid frame."""
        self._group = (str(group), PORT)
        self._socket = _joined(group)
        self.channel_info = f"udp_multicast:{group}"
        super().__init__(channel)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not select.select([self._socket], [], [], timeout)[0]:
            return None, False
        message = unpacked(self._socket.recv(_MAX_DATAGRAM))
        self.line_errors += message is None
        return message, False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send one frame to all members. Raises OSError, also when it would block."""
        self._socket.sendto(pack_message(msg), self._group)

    def shutdown(self) -> None:
        """Close the socket."""
        super().shutdown()
        self._socket.close()


def unpacked(datagram: bytes) -> can.Message | None:
    """Decode a datagram into a classical CAN frame; None if it is not one."""
    try:
        # python-can's own unpacking accepts a number as data and allocates that many bytes.
        content = msgpack.unpackb(datagram, raw=False)
        identifier, data = content["arbitration_id"], content["data"]
        flags = {flag: content[flag] for flag in _FLAGS}
        if type(identifier) is not int or type(data) is not bytes or not all(type(v) is bool for v in flags.values()):
            return None
        return can.Message(arbitration_id=identifier, data=data, check=True, **flags)
    except (ValueError, TypeError, KeyError):  # not msgpack, not a table, missing key, or invalid frame
        return None


def _joined(group: ipaddress.IPv4Address) -> socket.socket:
    """Open a multicast socket bound to the loopback interface."""
    index = socket.if_nametoindex(_LOOPBACK.decode())
    found = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        found.setblocking(False)
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        # Before bind(), so that no packet from outside is ever queued. Needs no privileges since Linux 5.7.
        found.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, _LOOPBACK)
        found.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        # struct ip_mreqn: group, local address, interface
        found.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, struct.pack("@4s4si", bytes(4), bytes(4), index))
        member = struct.pack("@4s4si", group.packed, bytes(4), index)
        found.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        found.bind((str(group), PORT))
    except OSError:
        found.close()
        raise
    return found
