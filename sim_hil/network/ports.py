"""Ends of a link for each kind: sockets, pseudo terminals and network interfaces, all non-blocking."""

from __future__ import annotations

import contextlib
import os
import socket
import tty
from collections import OrderedDict
from pathlib import Path
from typing import Final, Protocol

from sim_hil.network.config import LinkConfig, NetworkError, parse_address

LEFT: Final = 0
RIGHT: Final = 1
_MAX_DATAGRAM: Final = 65535 + 64
_MAX_CLIENTS: Final = 32  # clients of one udp link; a new client replaces the one silent for longest
_BATCH: Final = 64  # packets read per call
_SOL_PACKET, _PACKET_VNET_HDR = 263, 15  # <linux/if_packet.h>
_ETH_P_ALL: Final = 3
_CAN_START, _CAN_END = 0xAA, 0xBB  # python-can's serial frame: start, 4 stamp, 1 length, 4 id, data, end
_CAN_FIXED: Final = 11

Packet = tuple[int, bytes, object]  # side of origin, content, and the client for answers


class Ends(Protocol):
    """Both ends of one link."""

    def sources(self) -> list[int]:
        """Return the file descriptors to poll for input."""
        ...

    def take(self, descriptor: int) -> list[Packet]:
        """Return packets that have arrived at a descriptor, a limited number, without waiting."""
        ...

    def give(self, packet: Packet) -> None:
        """Send a packet out at the opposite side; it is lost if the output is full."""
        ...

    def close(self) -> None:
        """Close both ends."""
        ...


class UdpEnds:
    """UDP ends: a socket for clients, and one socket per client towards the other address."""

    def __init__(self, left: str, right: str) -> None:
        self._right = parse_address(right)
        self._listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._listener.setblocking(False)
        try:
            self._listener.bind(parse_address(left))
        except OSError as error:
            self._listener.close()
            raise OSError(f"{left}: expected a free local address, {error.strerror}") from error
        self._clients: OrderedDict[object, socket.socket] = OrderedDict()

    @property
    def address(self) -> tuple[str, int]:
        """Address to which clients send."""
        host, port = self._listener.getsockname()
        return host, port

    def sources(self) -> list[int]:
        return [self._listener.fileno(), *(out.fileno() for out in self._clients.values())]

    def take(self, descriptor: int) -> list[Packet]:
        owners = {out.fileno(): (client, out) for client, out in self._clients.items()}
        owner, end = owners.get(descriptor, (None, self._listener))
        packets: list[Packet] = []
        # An unreachable address is an error here, but on a network there would be no answer.
        with contextlib.suppress(OSError):
            for _ in range(_BATCH):
                data, sender = end.recvfrom(_MAX_DATAGRAM)
                packets.append((LEFT, data, sender) if owner is None else (RIGHT, data, owner))
        return packets

    def give(self, packet: Packet) -> None:
        side, data, client = packet
        with contextlib.suppress(OSError):
            if side == RIGHT:
                assert isinstance(client, tuple)
                self._listener.sendto(data, client)
            else:
                self._towards(client).send(data)

    def _towards(self, client: object) -> socket.socket:
        if client not in self._clients:
            if len(self._clients) >= _MAX_CLIENTS:
                self._clients.popitem(last=False)[1].close()
            out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            out.setblocking(False)
            try:
                out.connect(self._right)
            except OSError:
                out.close()
                raise
            self._clients[client] = out
        self._clients.move_to_end(client)
        return self._clients[client]

    def close(self) -> None:
        self._listener.close()
        for out in self._clients.values():
            out.close()
        self._clients.clear()


class SerialEnds:
    """Serial ends: two pseudo terminals; with `can` the bytes are split into python-can's serial frames."""

    def __init__(self, left: str, right: str, *, can: bool) -> None:
        self._can = can
        self._partial = [b"", b""]
        self._links = [Path(left), Path(right)]
        self._made: list[Path] = []
        self._masters: list[int] = []
        self._slaves: list[int] = []
        try:
            for link in self._links:
                master, slave = os.openpty()
                self._masters.append(master)
                self._slaves.append(slave)  # kept open: without a reader, the master returns errors
                tty.setraw(slave)
                os.set_blocking(master, False)
                link.symlink_to(os.ttyname(slave))
                self._made.append(link)
        except OSError as error:
            self.close()
            raise OSError(f"{left}, {right}: expected two paths that do not exist yet, {error.strerror}") from error

    def sources(self) -> list[int]:
        return list(self._masters)

    def take(self, descriptor: int) -> list[Packet]:
        side = self._masters.index(descriptor)
        try:
            data = os.read(descriptor, 4096)
        except BlockingIOError:
            return []
        if not self._can:
            return [(side, data, None)]
        frames, self._partial[side] = can_frames(self._partial[side] + data)
        return [(side, frame, None) for frame in frames]

    def give(self, packet: Packet) -> None:
        side, data, _ = packet
        with contextlib.suppress(BlockingIOError):
            os.write(self._masters[RIGHT if side == LEFT else LEFT], data)

    def close(self) -> None:
        for link in self._made:
            link.unlink(missing_ok=True)
        for descriptor in (*self._masters, *self._slaves):
            os.close(descriptor)
        self._made, self._masters, self._slaves = [], [], []


def can_frames(data: bytes) -> tuple[list[bytes], bytes]:
    """Split `data` into frames of python-can's serial interface and the rest; invalid bytes pass separately."""
    frames = []
    while data:
        start = data.find(bytes([_CAN_START]))
        if start != 0:
            noise = data if start < 0 else data[:start]
            frames.append(noise)
            data = data[len(noise) :]
            continue
        if len(data) < 6:
            break
        length = _CAN_FIXED + data[5]
        if data[5] > 8:
            frames.append(data[:1])
            data = data[1:]
        elif len(data) < length:
            break
        else:
            whole = length if data[length - 1] == _CAN_END else 1
            frames.append(data[:whole])
            data = data[whole:]
    return frames, data


class FrameEnds:
    """Two network interfaces as the ends of one cable. Raises OSError without permission (CAP_NET_RAW).

    With PACKET_VNET_HDR, each frame carries the description of offloaded checksums and segments; without it, the
    receiver would drop every UDP datagram.
    """

    def __init__(self, left: str, right: str) -> None:
        self._sockets: list[socket.socket] = []
        try:
            for interface in (left, right):
                end = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(_ETH_P_ALL))
                self._sockets.append(end)
                end.setsockopt(_SOL_PACKET, _PACKET_VNET_HDR, 1)
                end.bind((interface, _ETH_P_ALL))
                end.setblocking(False)
        except OSError as error:
            self.close()
            raise OSError(f"{left}, {right}: expected two accessible interfaces, {error.strerror}") from error

    def sources(self) -> list[int]:
        return [end.fileno() for end in self._sockets]

    def take(self, descriptor: int) -> list[Packet]:
        side = self.sources().index(descriptor)
        packets: list[Packet] = []
        for _ in range(_BATCH):
            try:
                data, origin = self._sockets[side].recvfrom(_MAX_DATAGRAM)
            except OSError:  # no more packets, or the interface is down
                break
            if origin[2] != socket.PACKET_OUTGOING:  # ignore packets sent by this relay
                packets.append((side, data, None))
        return packets

    def give(self, packet: Packet) -> None:
        side, data, _ = packet
        with contextlib.suppress(OSError):  # the interface is down or its queue full: lost, as on a cable
            self._sockets[RIGHT if side == LEFT else LEFT].send(data)

    def close(self) -> None:
        for end in self._sockets:
            end.close()
        self._sockets = []


def open_ends(link: LinkConfig) -> Ends:
    """Open the ends of a link. Raises NetworkError or OSError."""
    if link.kind == "udp":
        return UdpEnds(link.left, link.right)
    if link.kind == "frames":
        return FrameEnds(link.left, link.right)
    if link.left == link.right:
        raise NetworkError(f"link {link.name!r}: expected two different paths, found {link.left!r} twice")
    return SerialEnds(link.left, link.right, can=link.kind == "can-serial")
