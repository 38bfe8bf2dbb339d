"""UDP link that learns its peers: packets go to recent senders, heartbeats also to fixed addresses.

An impairment degrades the link in both directions (`sim_hil/protocols/impairment.py`).
"""

from __future__ import annotations

import contextlib
import select
import socket
from typing import Final

from sim_hil.protocols.impairment import PERFECT, ImpairedDirection, Impairment

Address = tuple[str, int]
Packet = tuple[bytes, Address]
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
    """UDP link; only `wait` blocks. Delayed packets move on each call of `receive` and `send`."""

    def __init__(
        self, bind: Address, fixed: tuple[Address, ...], impairment: Impairment = PERFECT, seed: int = 0
    ) -> None:
        """Bind the socket; `fixed`: addresses that get heartbeats before they send. Raises OSError with one line."""
        self.impairment = impairment
        """Current impairment; may be replaced at any time."""
        self._inwards = ImpairedDirection[Packet](seed, 0)
        self._outwards = ImpairedDirection[Packet](seed, 1)
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

    def receive(self, now_s: float) -> list[Packet]:
        """Return the arrived datagrams and their senders, a limited number per call; `now_s`: the robot's clock."""
        with contextlib.suppress(BlockingIOError, ConnectionError):
            for _ in range(_MAX_A_SERVE):
                data, (host, port) = self._socket.recvfrom(_MAX_BYTES)
                self._inwards.put((data, (host, port)), self.impairment, now_s)
        self._send_arrived(now_s)
        return self._inwards.take(now_s)

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
            self._outwards.put((data, address), self.impairment, now_s)
        self._send_arrived(now_s)

    def _send_arrived(self, now_s: float) -> None:
        for data, address in self._outwards.take(now_s):
            try:
                self._socket.sendto(data, address)
                self.sent += 1
            except OSError:  # no receiver or no buffer space: the next report follows soon
                self.unsent += 1

    def close(self) -> None:
        """Close the socket; may be called twice."""
        self._socket.close()
