"""A UDP socket that learns who talks to it: packets go to a few fixed addresses and to those heard of late."""

from __future__ import annotations

import contextlib
import select
import socket
from typing import Final

Address = tuple[str, int]
MAX_LEARNED: Final = 4  # a station, an observer, and either once more from another port after a restart
FORGET_S: Final = 10.0
_MAX_BYTES: Final = 2048
_MAX_A_SERVE: Final = 64


def parse_address(text: str) -> Address:
    """`HOST:PORT`, an IPv4 address. Raises ValueError."""
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
    """Datagrams in and out; never waits but in `wait`."""

    def __init__(self, bind: Address, fixed: tuple[Address, ...]) -> None:
        """`fixed`: who is called without having been heard. Raises OSError with one clear line."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(bind)
        except OSError as error:
            self._socket.close()
            raise OSError(f"mavlink: {bind[0]}:{bind[1]}: expected a free UDP port, {error.strerror}") from error
        self._socket.setblocking(False)
        self._fixed = fixed
        self._heard_s: dict[Address, float] = {}
        self.turned_away = 0
        self.unsent = 0
        self.sent = 0

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._socket.getsockname()[1])

    def wait(self, left_ns: int) -> None:
        """Until something arrives, at most `left_ns`."""
        select.select([self._socket], [], [], left_ns / 1e9)

    def receive(self) -> list[tuple[bytes, Address]]:
        """What has arrived, a limited number at once."""
        arrived = []
        with contextlib.suppress(BlockingIOError, ConnectionError):
            for _ in range(_MAX_A_SERVE):
                data, (host, port) = self._socket.recvfrom(_MAX_BYTES)
                arrived.append((data, (host, port)))
        return arrived

    def accept(self, address: Address, now_s: float) -> bool:
        """Note that a whole packet came from there; False when too many others are there already."""
        if address not in self._heard_s and len(self._heard_s) >= MAX_LEARNED:
            self._heard_s = {who: at_s for who, at_s in self._heard_s.items() if now_s - at_s <= FORGET_S}
            if len(self._heard_s) >= MAX_LEARNED:
                self.turned_away += 1
                return False
        self._heard_s[address] = now_s
        return True

    def listeners(self, now_s: float) -> list[Address]:
        """Who has been heard of late."""
        return [who for who, at_s in self._heard_s.items() if now_s - at_s <= FORGET_S]

    def send(self, data: bytes, now_s: float, *, call: bool = False) -> None:
        """To everybody who was heard of late; with `call` to the fixed addresses too."""
        addresses = self.listeners(now_s)
        if call:
            addresses += [address for address in self._fixed if address not in addresses]
        for address in addresses:
            try:
                self._socket.sendto(data, address)
                self.sent += 1
            except OSError:  # nobody there, or no room: the next report comes soon
                self.unsent += 1

    def close(self) -> None:
        """Close the socket; may be called twice."""
        self._socket.close()
