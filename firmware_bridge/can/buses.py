"""Buses of python-can behind one interface that never waits.

Interfaces: "serial" (a serial line or a pty), "socketcan" (a real bus), "virtual" (inside one process) and
"udp_multicast" (several processes of one machine).
"""

from __future__ import annotations

import termios
from collections import deque
from dataclasses import dataclass
from typing import Final

import can

from firmware_bridge.can.frame import Frame
from firmware_bridge.core.config_can import INTERFACES
from firmware_bridge.core.robot_state import LinkOpenError

_OTHER_FORMAT: Final = 0x80000000  # keeps identifiers of 29 bits, remote frames and CAN FD apart from ours
_MOST_ECHOES: Final = 256


class BusError(LinkOpenError):
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


def open_bus(address: BusAddress) -> can.BusABC:
    """Open the bus. Raises BusError with one line."""
    try:
        if address.interface == "serial":
            from firmware_bridge.can.serial_line import SerialLine  # needs pyserial, which a socketcan robot may lack

            return SerialLine(address.channel)
        if address.interface == "udp_multicast":
            from firmware_bridge.can.multicast import LoopbackMulticastBus  # needs msgpack

            return LoopbackMulticastBus(address.channel)
        bus = can.Bus(channel=address.channel, interface=address.interface)
    except (can.CanError, OSError, ValueError, ImportError, termios.error) as error:  # SerialException is an OSError
        raise BusError(f"CAN bus {address}: cannot be opened: {error}") from error
    if address.interface == "socketcan":
        bus.socket.setblocking(False)  # type: ignore[attr-defined]  # a full send buffer must not wait
    return bus


def as_frame(message: can.Message) -> Frame:
    """Return a received message as a frame; one of another format gets an identifier that no DBC message has."""
    other = _OTHER_FORMAT if message.is_extended_id or message.is_remote_frame or message.is_fd else 0
    identifier = message.arbitration_id if message.is_error_frame else message.arbitration_id | other
    return Frame(identifier, bytes(message.data[:8]), error=message.is_error_frame)


class FrameBus:
    """Bus whose `receive` and `send` return at once, without a thread."""

    def __init__(self, bus: can.BusABC, *, echoes: bool) -> None:
        """Take ownership of `bus`; `echoes`: it also receives what it sends."""
        self._bus = bus
        self._echoes: deque[Frame] | None = deque(maxlen=_MOST_ECHOES) if echoes else None
        self.refused = 0

    @property
    def line_errors(self) -> int:
        """Number of invalid serial frames or multicast datagrams."""
        return int(getattr(self._bus, "line_errors", 0))

    def receive(self, most: int) -> list[Frame]:
        """Return at most that many frames of others that wait. Raises BusError if the bus was lost."""
        frames = []
        try:
            for _ in range(most):
                # `recv` measures its waiting with the wall clock: one that is set back would make it wait.
                before = self.line_errors
                message, _ = self._bus._recv_internal(0.0)
                if message is None and self.line_errors != before:
                    continue  # what is invalid must not delay what waits behind it
                if message is None:
                    break
                frame = as_frame(message)
                if self._echoes is not None and frame in self._echoes:
                    self._echoes.remove(frame)
                    continue
                frames.append(frame)
        except (can.CanError, OSError, TypeError) as error:  # TypeError: pyserial, closed while it reads
            raise BusError(f"CAN bus {self._bus.channel_info}: connection lost: {error}") from error
        return frames

    def send(self, frame: Frame) -> bool:
        """Send one frame and return True; a frame that the bus does not take now is dropped and counted."""
        message = can.Message(arbitration_id=frame.identifier, data=frame.data, is_extended_id=False)
        try:
            self._bus.send(message, timeout=0.0)
        except (can.CanError, OSError):  # full queue, interface down, bus off
            self.refused += 1
            return False
        if self._echoes is not None:
            self._echoes.append(frame)
        return True

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()
