"""Byte links to an autopilot: a UDP socket and a serial line. No method waits and none raises after the opening."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import socket
import sys
import termios
import time
import tty
from typing import Final, Protocol

from firmware_bridge.core.config import MavlinkConfig
from firmware_bridge.core.robot_state import LinkOpenError
from firmware_bridge.system.serial_backlog import SerialBacklog

_MAX_DATAGRAM_BYTES: Final = 2048
_MAX_DATAGRAMS: Final = 64  # a step: 3200 a second at 50 Hz
_MAX_SERIAL_BYTES: Final = 4096  # a step: 2 Mbaud at 50 Hz
_REOPEN_NS: Final = 1_000_000_000


class Transport(Protocol):
    """Link of bytes; `stream`: packets may be cut anywhere."""

    stream: bool

    def receive(self, now_ns: int) -> list[bytes]:
        """Return what has arrived, a bounded amount."""

    def send(self, data: bytes) -> bool:
        """Send one packet; return whether the system took it."""

    def close(self) -> None:
        """Close the link."""


class UdpTransport:
    """UDP socket that is connected to the autopilot: the system drops datagrams of every other address."""

    stream = False

    def __init__(self, host: str, port: int, local_port: int = 0) -> None:
        """Raises LinkOpenError."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(("", local_port))
            self._socket.connect((host, port))
        except OSError as error:
            self._socket.close()
            where = f"udp:{host}:{port} from port {local_port}"
            raise LinkOpenError(f"MAVLink {where}: expected a free port and a route, {error.strerror}") from error
        self._socket.setblocking(False)

    def receive(self, now_ns: int) -> list[bytes]:
        """Return the datagrams that have arrived."""
        datagrams: list[bytes] = []
        for _ in range(_MAX_DATAGRAMS):
            try:
                datagrams.append(self._socket.recv(_MAX_DATAGRAM_BYTES))
            except BlockingIOError:
                break
            except OSError:  # the answer to an earlier datagram: nothing listens there
                continue
        return datagrams

    def send(self, data: bytes) -> bool:
        """Send one datagram."""
        try:
            self._socket.send(data)
        except OSError:
            return False
        return True

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class SerialTransport:
    """Serial line in raw mode, for this process alone; a line that fails is opened again once a second."""

    stream = True

    def __init__(self, path: str, baud: int) -> None:
        """Raises LinkOpenError."""
        self._path, self._baud = path, baud
        self._rest = b""  # of a packet that the line took in part
        self._retry_ns = 0
        self._backlog = SerialBacklog()
        self._file: int | None = None
        try:
            self._file = _open_line(path, baud)
        except (OSError, termios.error) as error:
            reason = error.args[-1]
            raise LinkOpenError(f"MAVLink serial:{path}: expected a serial line of our own, {reason}") from error

    def receive(self, now_ns: int) -> list[bytes]:
        """Return what has arrived, in one piece."""
        if self._file is None and now_ns >= self._retry_ns:
            self._retry_ns = now_ns + _REOPEN_NS
            with contextlib.suppress(OSError, termios.error):
                self._file = _open_line(self._path, self._baud)
        if self._file is None:
            return []
        try:
            data = os.read(self._file, _MAX_SERIAL_BYTES)
        except BlockingIOError:
            return []
        except OSError:
            self._drop_line(now_ns)
            return []
        return [data] if data else []

    def send(self, data: bytes) -> bool:
        """Send one packet, or nothing of it while the line owes earlier ones: a late command is worse than none."""
        behind = self._backlog.is_behind(self._waiting_bytes(), time.monotonic_ns())
        if not self._write(self._rest) or self._rest or behind:
            return False
        return self._write(data)

    def _waiting_bytes(self) -> int:
        """Return the number of bytes that the system has taken and the line has not."""
        if self._file is None:
            return 0
        try:
            return int.from_bytes(fcntl.ioctl(self._file, termios.TIOCOUTQ, bytes(4)), sys.byteorder)
        except OSError:
            return 0  # not every line tells

    def _write(self, data: bytes) -> bool:
        """Write; what does not fit is kept in `_rest`, because half a packet destroys the next one."""
        if self._file is None:
            return False
        if not data:
            return True
        try:
            self._rest = data[os.write(self._file, data) :]
        except BlockingIOError:
            return False
        except OSError:
            self._drop_line(0)
            return False
        return True

    def _drop_line(self, now_ns: int) -> None:
        if self._file is not None:
            with contextlib.suppress(OSError):
                os.close(self._file)
        self._file, self._rest, self._retry_ns = None, b"", now_ns + _REOPEN_NS if now_ns else 0

    def close(self) -> None:
        """Close the line."""
        self._drop_line(0)


def _open_line(path: str, baud: int) -> int:
    descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        if not os.isatty(descriptor):
            raise OSError(errno.ENOTTY, os.strerror(errno.ENOTTY))
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # a second bridge, or a careful ground station
        tty.setraw(descriptor)
        settings = termios.tcgetattr(descriptor)
        speed: int = getattr(termios, f"B{baud}")
        settings[2] = settings[2] & ~termios.CRTSCTS & ~termios.CSTOPB | termios.CLOCAL | termios.CREAD
        settings[4] = settings[5] = speed
        termios.tcsetattr(descriptor, termios.TCSANOW, settings)
        termios.tcflush(descriptor, termios.TCIOFLUSH)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def open_transport(config: MavlinkConfig) -> Transport:
    """Open the link of a robot file. Raises LinkOpenError."""
    if config.serial is not None:
        return SerialTransport(*config.serial)
    return UdpTransport(*config.address, config.local_port)
