"""UDP link that learns its peers: packets go to recent senders, heartbeats also to fixed addresses."""

from __future__ import annotations

import contextlib
import select
import socket
from typing import Final

Address = tuple[str, int]
MAX_LEARNED: Final = 4  # a station and an observer, each also with a second port after a restart
FORGET_S: Final = 10.0
_MAX_BYTES: Final = 2048
_MAX_A_SERVE: Final = 64


def parse_address(text: str) -> Address:
    """Parse `HOST:PORT` with an IPv4 address. Raises ValueError."""
    host, colon, port = text.rpartition(":")
    try:
        socket.inet_aton(host)
        number = int(port) if port.isascii() and port.isdecimal() else -1
    except OSError:
        number = -1
    if not colon or host.count(".") != 3 or not 0 <= number <= 65535:
        raise ValueError(f"expected HOST:PORT such as 127.0.0.1:14580, found {text!r}")
    return host, number


class UdpLink:
    """UDP link; only `wait` blocks."""

    def __init__(self, bind: Address, fixed: tuple[Address, ...]) -> None:
        """Bind the socket; `fixed`: addresses that get heartbeats before they send. Raises OSError with one line."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(bind)
        except OSError as error:
            self._socket.close()
            raise OSError(f"mavlink: {bind[0]}:{bind[1]}: expected a free UDP port, {error.strerror}") from error
        self._socket.setblocking(False)
        self._fixed = fixed
        self._last_packet_s: dict[Address, float] = {}
        self.turned_away = 0
        self.unsent = 0
        self.sent = 0

    @property
    def port(self) -> int:
        """UDP port of the socket."""
        return int(self._socket.getsockname()[1])

    def wait(self, left_ns: int) -> None:
        """Wait until a datagram arrives, at most `left_ns`."""
        select.select([self._socket], [], [], left_ns / 1e9)

    def receive(self) -> list[tuple[bytes, Address]]:
        """Return the received datagrams and their senders, a limited number per call."""
        arrived = []
        with contextlib.suppress(BlockingIOError, ConnectionError):
            for _ in range(_MAX_A_SERVE):
                data, (host, port) = self._socket.recvfrom(_MAX_BYTES)
                arrived.append((data, (host, port)))
        return arrived

    def accept(self, address: Address, now_s: float) -> bool:
        """Register the sender of a valid packet; False if there are already MAX_LEARNED other recent senders."""
        if address not in self._last_packet_s and len(self._last_packet_s) >= MAX_LEARNED:
            self._last_packet_s = {peer: self._last_packet_s[peer] for peer in self.listeners(now_s)}
            if len(self._last_packet_s) >= MAX_LEARNED:
                self.turned_away += 1
                return False
        self._last_packet_s[address] = now_s
        return True

    def listeners(self, now_s: float) -> list[Address]:
        """Return the addresses that sent a packet within FORGET_S."""
        return [peer for peer, at_s in self._last_packet_s.items() if now_s - at_s <= FORGET_S]

    def send(self, data: bytes, now_s: float, *, call: bool = False) -> None:
        """Send to all recent senders; with `call` also to the fixed addresses."""
        addresses = self.listeners(now_s)
        if call:
            addresses += [address for address in self._fixed if address not in addresses]
        for address in addresses:
            try:
                self._socket.sendto(data, address)
                self.sent += 1
            except OSError:  # no receiver or no buffer space: the next report follows soon
                self.unsent += 1

    def close(self) -> None:
        """Close the socket; may be called twice."""
        self._socket.close()
