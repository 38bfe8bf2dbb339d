"""UDP link that learns its peers: packets go to recent senders, heartbeats also to fixed addresses.

An impairment degrades the link in both directions. With the same seed, the n-th packet of a direction is lost,
duplicated, reordered and delayed in the same way at any time.
"""

from __future__ import annotations

import contextlib
import heapq
import select
import socket
from dataclasses import dataclass
from typing import Final, Generic, TypeVar

import numpy as np

T = TypeVar("T")
Address = tuple[str, int]
Packet = tuple[bytes, Address]
MAX_LEARNED: Final = 4  # a station and an observer, each also with a second port after a restart
FORGET_S: Final = 10.0
_MAX_BYTES: Final = 2048
_MAX_A_SERVE: Final = 64
_MAX_DELAYED: Final = 4096  # packets under way in one direction; more are lost
_MOST_IMPAIRED: Final = 60_000.0
_FORGOTTEN_S: Final = 1e9


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


@dataclass(frozen=True)
class Impairment:
    """Impairment of both directions of a link; the defaults describe a perfect link.

    `loss_percent` of packets are lost, in bursts of `loss_burst` packets on average (1: independently). A packet
    arrives after `delay_ms` with `jitter_ms` (standard deviation), in order of sending, except for the
    `reorder_percent` that arrive `reorder_ms` later. `duplicate_percent` arrive twice.
    """

    loss_percent: float = 0.0
    loss_burst: float = 1.0
    delay_ms: float = 0.0
    jitter_ms: float = 0.0
    duplicate_percent: float = 0.0
    reorder_percent: float = 0.0
    reorder_ms: float = 20.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            low = 1.0 if name == "loss_burst" else 0.0
            high = 100.0 if name.endswith("percent") else _MOST_IMPAIRED
            if not low <= value <= high:
                raise ValueError(f"{name}: expected {low:g} to {high:g}, found {value}")


PERFECT: Final = Impairment()


class ImpairedDirection(Generic[T]):
    """One direction of an impaired link: `put` packets in and `take` the arriving ones, with a monotonic clock, s."""

    def __init__(self, seed: int, direction: int) -> None:
        """Create one direction; the faults of both are independent."""
        self._rng = np.random.default_rng((seed, 0xDA7A, direction))
        self._losing = False
        self._last_s = -_FORGOTTEN_S
        self._waiting: list[tuple[float, int, T]] = []
        self._order = 0

    def put(self, packet: T, plan: Impairment, now_s: float) -> None:
        """Send a packet."""
        # Always the same draws, so that one fault does not change the random numbers of the others.
        chance, duplicate, reorder = (float(value) for value in self._rng.random(3))
        wobble, late_wobble = (float(value) for value in self._rng.standard_normal(2))
        if self._loses(plan, chance) or len(self._waiting) >= _MAX_DELAYED:
            return
        arrives_s = now_s + 1e-3 * max(plan.delay_ms + plan.jitter_ms * wobble, 0.0)
        if 100.0 * reorder < plan.reorder_percent:
            arrives_s += 1e-3 * plan.reorder_ms
        else:
            arrives_s = self._last_s = max(arrives_s, self._last_s)
        self._queue(packet, arrives_s)
        if 100.0 * duplicate < plan.duplicate_percent:
            self._queue(packet, arrives_s + 1e-3 * abs(plan.jitter_ms * late_wobble))

    def take(self, now_s: float) -> list[T]:
        """Return the packets that have arrived."""
        arrived = []
        while self._waiting and self._waiting[0][0] <= now_s:
            arrived.append(heapq.heappop(self._waiting)[2])
        return arrived

    def _queue(self, packet: T, arrives_s: float) -> None:
        self._order += 1
        heapq.heappush(self._waiting, (arrives_s, self._order, packet))

    def _loses(self, plan: Impairment, chance: float) -> bool:
        """Return whether a packet is lost, by Gilbert's two-state model with the given loss share and burst length."""
        share = 0.01 * plan.loss_percent
        if share in (0.0, 1.0):
            self._losing = share == 1.0
        elif plan.loss_burst == 1.0:
            self._losing = chance < share
        elif self._losing:
            self._losing = chance >= 1.0 / plan.loss_burst
        else:
            self._losing = chance < min(share / (1.0 - share) / plan.loss_burst, 1.0)
        return self._losing


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
